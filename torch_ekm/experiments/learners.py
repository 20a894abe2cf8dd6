"""Learners by name: of any stream, which are compared, and of a hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from .. import interop, residual
from ..enhanced.grasp import ACTION_VARIANCE, NOISE_VARIANCE, grasp_kernel
from ..exceptions import UnknownNameError
from ..residual import ResidualLearner

#: Outputs: translation [mm] and rotation [deg] of the object in the hand frame.
N_OUT = 6

Factory = Callable[..., ResidualLearner]


#: Inputs and outputs of the order of 1 are taken as they are.
_AS_GIVEN: dict[str, Any] = {"noise_variance": NOISE_VARIANCE, "standardize": False}
_FRESH: dict[str, Any] = {**_AS_GIVEN, "forgetting_factor": 0.99, "robust": 3.0}


def _kind(make: Factory, size: str = "", **figures: Any) -> Factory:
    """A factory ``(in_features, out_features, capacity=100, **options)`` of one kind of learner.

    Args:
        make: its class, or a function.
        size: name of its argument for the capacity; "": it has none.
        figures: its other arguments.
    """

    def factory(d: int, m: int, *, capacity: int = 100, **options: Any) -> ResidualLearner:
        return make(d, m, **{**figures, **({size: capacity} if size else {}), **options})

    return factory


def _sparse(
    make: Factory = residual.SparseOnlineGP, of_kernel: str = "kernel", **own: Any
) -> Callable[..., ResidualLearner]:
    """A sparse online GP that distrusts and forgets by two figures, and has other parts."""

    def factory(d: int, m: int, *, capacity: int = 100, **options: Any) -> ResidualLearner:
        given = {
            **_AS_GIVEN,
            "capacity": capacity,
            of_kernel: residual.SquaredExponential(d),
            **own,
            **options,
        }
        robust, fading = given.pop("robust", None), given.pop("forgetting_factor", 1.0)
        parts = [] if robust is None else [residual.RobustWeight(robust)]
        parts += [] if fading == 1.0 else [residual.ForgettingFactor(fading)]
        return make(d, m, **{**given, "parts": [*parts, *given.get("parts", ())]})

    return factory


def _mixture(d: int, m: int, **options: Any) -> ResidualLearner:
    """One learner that stands still and learns features, one that wanders: evidence decides."""
    return residual.MixtureResidual([kind(d, m, **options) for kind in _MIXED])


_MIXED = (
    _sparse(residual.DeepKernelSOGP, "base", robust=3.0),
    _sparse(robust=3.0, parts=[residual.ProcessNoise(0.003), residual.LearnHyperparameters()]),
)

#: Name -> ``factory(in_features, out_features, capacity=100, **options)``. Inputs and outputs are of the
#: order of 1; all but the first start from the same generic prior: lengthscale sqrt(d), unit variance, and
#: about 100 of whatever they keep.
LEARNERS: dict[str, Factory] = {
    "default": _kind(residual.default_learner, "capacity"),
    "model alone": _kind(residual.ZeroResidual),
    "linear RLS": _kind(residual.RecursiveLeastSquares, **_FRESH),
    "random features": _kind(residual.RandomFeatureRLS, "n_frequencies", **_FRESH),
    "MLP": _kind(residual.ReplayMLP, standardize=False),
    "MLP ensemble": _kind(residual.ReplayMLP, members=3, standardize=False),
    "SOGP default": _kind(residual.SparseOnlineGP, "capacity"),
    "SOGP plain": _sparse(),  # nothing forgotten, every sample trusted
    "SOGP": _sparse(forgetting_factor=0.99, robust=3.0),
    # no forgetting: what features are learned from is the past
    "SOGP deep": _sparse(
        residual.DeepKernelSOGP,
        "base",
        robust=3.0,
        parts=[residual.CalibrateNoise(), residual.DetectChanges()],
    ),
    "SOGP mixture": _mixture,
    "river forest": _kind(interop.RiverResidual),
}
#: The default learner, and the sparse online GP in its forms.
OURS = ("default", *(name for name in LEARNERS if name.startswith("SOGP")))
#: What a comparison takes if nobody says otherwise: not those of other libraries, which are slow.
COMPARED = tuple(name for name in LEARNERS if name != "river forest")


def learner_factory(name: str) -> Factory:
    """The factory of that name.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    if name not in LEARNERS:
        raise UnknownNameError("learner", name, LEARNERS)
    return LEARNERS[name]


def _action_linear(
    n_s: int, n_a: int, action_variance: float = ACTION_VARIANCE, **options: Any
) -> ResidualLearner:
    """The learner of :meth:`EnhancedModel.for_grasp`."""
    return _ON_A_HAND(n_s + n_a, N_OUT, kernel=grasp_kernel(n_s, n_a, action_variance), **options)


def _rbf(n_s: int, n_a: int, **options: Any) -> ResidualLearner:
    """Takes up the dead zone, too: smooth over 15 cm and 4.5 rad of the state and 8 deg of an actuator."""
    lengthscale = torch.tensor([15.0] * n_s + [4.0] * n_a, dtype=torch.float64)
    kernel = residual.SquaredExponential(n_s + n_a, lengthscale=lengthscale, variance=4.0)
    return _ON_A_HAND(n_s + n_a, N_OUT, kernel=kernel, **options)


def _alone(n_s: int, n_a: int, capacity: int) -> ResidualLearner:
    return residual.ZeroResidual(n_s + n_a, N_OUT, noise_variance=NOISE_VARIANCE)


_ON_A_HAND = _sparse(robust=3.0, forgetting_factor=0.995)
#: What demo and experiments take if nobody names another.
DEFAULT_LEARNER = "action-linear"
#: Learners of a hand: name -> ``factory(n_s, n_a, capacity=..., **options)``.
HAND_LEARNERS: dict[str, Factory] = {DEFAULT_LEARNER: _action_linear, "rbf": _rbf, "model alone": _alone}


def make_learner(name: str, n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """A fresh learner of ``[encode(s); da]``.

    Args:
        n_s, n_a: features of the state, actuators.
        capacity: basis vectors; the model alone has none.
        options: instead of the factory's own choices.

    Raises:
        UnknownNameError: no such learner of a hand; the message lists them.
    """
    if name not in HAND_LEARNERS:
        raise UnknownNameError("learner", name, HAND_LEARNERS)
    return HAND_LEARNERS[name](n_s, n_a, capacity=capacity, **options)
