"""Every learner by name, for any stream and for a grasp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from .. import interop, residual
from ..enhanced.grasp_learner import ACTION_VARIANCE, NOISE_VARIANCE, grasp_kernel
from ..exceptions import UnknownNameError
from ..residual import ResidualLearner

#: Outputs: translation [mm] and rotation [deg] of the object in the hand frame.
N_OUT = 6

Factory = Callable[..., ResidualLearner]


#: Inputs and outputs of the order of 1 are taken as they are.
_AS_GIVEN: dict[str, Any] = {"noise_variance": NOISE_VARIANCE, "standardize": False}


def _kind(make: Factory, size: str = "", kernel: str = "", **figures: Any) -> Factory:
    """A factory ``(in_features, out_features, n_actions=0, capacity=100, **options)`` of one kind of learner.

    Args:
        make: its class, or a function.
        size, kernel: names of its arguments for the capacity and the kernel; "": it has none.
        figures: its other arguments.
    """

    def factory(
        d: int, m: int, *, n_actions: int = 0, capacity: int = 100, **options: Any
    ) -> ResidualLearner:
        given = {size: capacity, kernel: residual.SquaredExponential(d)}
        return make(d, m, **{**figures, **{name: given[name] for name in given if name}, **options})

    return factory


def _sparse(
    make: Factory = residual.SparseOnlineGP, kernel: str = "kernel", parts: Any = (), **figures: Any
) -> Factory:
    """A sparse online GP that distrusts and forgets by two figures, and has other parts."""
    plain = _kind(make, "capacity", kernel, **_AS_GIVEN)
    own = {"robust": None, "forgetting_factor": 1.0, "parts": parts, **figures}

    def factory(d: int, m: int, **options: Any) -> ResidualLearner:
        chosen = {name: options.pop(name, value) for name, value in own.items()}
        return plain(d, m, **options, parts=_parts(**chosen))

    return factory


def _parts(robust: float | None, forgetting_factor: float, parts: Any) -> list[Any]:
    weight = [] if robust is None else [residual.RobustWeight(robust)]
    fading = [] if forgetting_factor == 1.0 else [residual.ForgettingFactor(forgetting_factor)]
    return [*weight, *fading, *parts]


def _mixture(d: int, m: int, **options: Any) -> ResidualLearner:
    """One learner that stands still and learns features, one that wanders: evidence decides."""
    return residual.MixtureResidual([kind(d, m, **options) for kind in _MIXED])


def _rbf(d: int, m: int, *, n_actions: int = 0, **options: Any) -> ResidualLearner:
    """Takes up the dead zone, too: smooth over 15 cm and 4.5 rad of the state and 8 deg of an actuator."""
    lengthscale = torch.tensor([15.0] * (d - n_actions) + [4.0] * n_actions, dtype=torch.float64)
    kernel = residual.SquaredExponential(d, lengthscale=lengthscale, variance=4.0)
    return _ON_A_HAND(d, m, **{"kernel": kernel, **options})


def _action_linear(
    d: int, m: int, *, n_actions: int = 0, action_variance: float = ACTION_VARIANCE, **options: Any
) -> ResidualLearner:
    """The learner of :meth:`EnhancedModel.for_grasp`."""
    kernel = grasp_kernel(d - n_actions, n_actions, action_variance)
    return _ON_A_HAND(d, m, **{"kernel": kernel, **options})


_MIXED = (
    _sparse(residual.DeepKernelSOGP, "base", robust=3.0),
    _sparse(robust=3.0, parts=[residual.ProcessNoise(0.003), residual.LearnHyperparameters()]),
)
_ON_A_HAND = _sparse(robust=3.0, forgetting_factor=0.995)
_FRESH: dict[str, Any] = {**_AS_GIVEN, "forgetting_factor": 0.99, "robust": 3.0}

#: Name -> ``factory(in_features, out_features, n_actions=0, capacity=100, **options)``; the last n_actions
#: inputs are an action. Inputs and outputs are of the order of 1; all but the first three start from the same
#: generic prior: lengthscale sqrt(d), unit variance, and about 100 of whatever they keep.
LEARNERS: dict[str, Factory] = {
    "default": _kind(residual.default_learner, "capacity"),
    "action-linear": _action_linear,
    "rbf": _rbf,
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
#: Learners of other libraries: ten to a hundred times as slow, and in an extra of their own.
PEERS = ("river forest",)
#: The default learner, and the sparse online GP in its forms.
OURS = ("default", *(name for name in LEARNERS if name.startswith("SOGP")))
#: What a comparison takes if nobody says otherwise: not those that want to know which inputs are an action.
COMPARED = tuple(name for name in LEARNERS if name not in (*PEERS, "rbf", "action-linear"))
#: What demo and experiments take if nobody names another.
DEFAULT_LEARNER = "action-linear"
#: What a hand wants other than any stream: it wears slowly, and a motion says little of a slope.
_HAND_FIGURES: dict[str, dict[str, Any]] = {
    "SOGP deep": {"forgetting_factor": 0.995, "parts": ()},
    "linear RLS": {"forgetting_factor": 0.995, "weight_variance": 0.1},
    "random features": {"forgetting_factor": 0.995},
    "model alone": {"noise_variance": NOISE_VARIANCE},
}


def learner_factory(name: str) -> Factory:
    """The factory of that name.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    if name not in LEARNERS:
        raise UnknownNameError("learner", name, LEARNERS)
    return LEARNERS[name]


def make_learner(name: str, n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """A fresh learner of ``[encode(s); da]``.

    Args:
        n_s, n_a: features of the state, actuators.
        capacity: basis vectors or random frequencies; networks and RLS have no such figure.
        options: instead of the factory's own choices.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    options = {"capacity": capacity, **_HAND_FIGURES.get(name, {}), **options}
    return learner_factory(name)(n_s + n_a, N_OUT, n_actions=n_a, **options)
