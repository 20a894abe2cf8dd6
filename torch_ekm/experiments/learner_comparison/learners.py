"""Every learner of torch_ekm.residual, by name, with one choice of figures for all streams.

Inputs and outputs are of the order of 1; all start from the same generic prior: lengthscale sqrt(d), unit
variance, noise variance 0.1, and about 100 of whatever they keep.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...exceptions import UnknownNameError
from ...residual import (
    DeepKernelSOGP,
    GPyTorchSVGP,
    GPyTorchWindow,
    KRLSTracker,
    LocalGPs,
    MixtureResidual,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    ResidualLearner,
    RiverResidual,
    SparseOnlineGP,
    WindowGP,
    ZeroResidual,
)

Factory = Callable[[int, int], ResidualLearner]
_NOISE = 0.1
_FRESH: dict[str, Any] = {"noise_variance": _NOISE, "forgetting": 0.99, "robust": 3.0}


def _sogp(**options: Any) -> Factory:
    return lambda d, m: SparseOnlineGP(d, m, capacity=100, **{"noise_variance": _NOISE, **options})


def _mixture(d: int, m: int) -> ResidualLearner:
    """One that stands still and learns features, one that wanders: evidence decides."""
    common: dict[str, Any] = {"capacity": 100, "noise_variance": _NOISE, "robust": 3.0}
    still = DeepKernelSOGP(d, m, **common)
    return MixtureResidual([still, SparseOnlineGP(d, m, adapt=True, diffusion=0.003, **common)])


def _deep(d: int, m: int) -> ResidualLearner:
    # no forgetting: what features are learned from is the past
    return DeepKernelSOGP(
        d, m, capacity=100, noise_variance=_NOISE, robust=3.0, calibrate=True, detect_changes=True
    )


#: Name -> ``factory(in_features, out_features)``.
CONTENDERS: dict[str, Factory] = {
    "model alone": lambda d, m: ZeroResidual(d, m),
    "linear RLS": lambda d, m: RecursiveLeastSquares(d, m, **_FRESH),
    "random features": lambda d, m: RandomFeatureRLS(d, m, n_frequencies=100, **_FRESH),
    "window GP": lambda d, m: WindowGP(d, m, window=100, noise_variance=_NOISE, robust=3.0),
    "local GPs": lambda d, m: LocalGPs(d, m, experts=40, window=100, noise_variance=_NOISE),
    "KRLS-T": lambda d, m: KRLSTracker(d, m, capacity=100, noise_variance=_NOISE, forgetting=0.99),
    "MLP": lambda d, m: ReplayMLP(d, m),
    "MLP ensemble": lambda d, m: ReplayMLP(d, m, members=3),
    "SOGP plain": _sogp(),
    "SOGP": _sogp(forgetting=0.99, robust=3.0),
    "SOGP adaptive": _sogp(forgetting=0.99, robust=3.0, adapt=True, calibrate=True),
    "SOGP detecting": _sogp(robust=3.0, adapt=True, calibrate=True, detect_changes=True),
    "SOGP deep": _deep,
    "SOGP mixture": _mixture,
    "river forest": lambda d, m: RiverResidual(d, m),
    "GPyTorch window": lambda d, m: GPyTorchWindow(d, m, window=100, noise_variance=_NOISE),
    "GPyTorch SVGP": lambda d, m: GPyTorchSVGP(d, m, inducing=100, memory=500, minibatch=20),
}
#: Learners of other libraries: ten to a hundred times as slow, and in an extra of their own.
PEERS = ("river forest", "GPyTorch window", "GPyTorch SVGP")
#: The sparse online GP in its forms.
OURS = tuple(name for name in CONTENDERS if name.startswith("SOGP"))
#: What is compared if nobody says otherwise.
DEFAULT = tuple(name for name in CONTENDERS if name not in PEERS)


def contender(name: str) -> Factory:
    """The factory of that name.

    Raises:
        UnknownNameError: there is none; the message lists all.
    """
    if name not in CONTENDERS:
        raise UnknownNameError("learner", name, CONTENDERS)
    return CONTENDERS[name]
