"""Every learner by name, for any stream and for a grasp, and the enhanced model around one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from .. import interop, residual
from .._recorded import describe
from ..enhanced.grasp_learner import NOISE_VARIANCE, grasp_kernel
from ..exceptions import UnknownNameError
from ..residual import ResidualLearner

#: Outputs: translation [mm] and rotation [deg] of the object in the hand frame.
N_OUT = 6

Factory = Callable[..., ResidualLearner]


class _Written(str):
    """Code, not a text."""

    __repr__ = str.__str__


_KERNEL = _Written("SquaredExponential(d)")
#: Inputs and outputs of the order of 1 are taken as they are.
_AS_GIVEN: dict[str, Any] = {"noise_variance": NOISE_VARIANCE, "standardize": False}


def constructor_call(factory: Factory) -> str:
    """How a user makes the learner of this factory, of d inputs and m outputs; "" where it does not tell."""
    return getattr(factory, "call", "")


def _told(factory: Factory, make: Factory, **figures: Any) -> Factory:
    """The factory, with the call that it stands for."""
    arguments = ["d", "m", *(f"{name}={value!r}" for name, value in figures.items())]
    vars(factory)["call"] = f"{make.__name__}({', '.join(arguments)})"
    return factory


def _kind(make: Factory, capacity_is: str = "", kernel_is: str = "", **figures: Any) -> Factory:
    """A kind of learner; ``capacity_is``, ``kernel_is`` name those of its arguments which are such."""

    def factory(
        d: int, m: int, *, n_actions: int = 0, capacity: int = 100, **options: Any
    ) -> ResidualLearner:
        size: dict[str, Any] = {capacity_is: capacity} if capacity_is else {}
        kernel = {kernel_is: residual.SquaredExponential(d)} if kernel_is else {}
        return make(d, m, **{**figures, **size, **kernel, **options})

    size = {capacity_is: 100} if capacity_is else {}
    return _told(factory, make, **{**figures, **size, **({kernel_is: _KERNEL} if kernel_is else {})})


def _sogp(make: Factory = residual.SparseOnlineGP, kernel_is: str = "kernel", **figures: Any) -> Factory:
    """A sparse online GP that distrusts and forgets by two figures, and has other parts."""

    def factory(d: int, m: int, *, n_actions: int = 0, **options: Any) -> ResidualLearner:
        chosen = {"capacity": 100, "noise_variance": NOISE_VARIANCE, "robust": None, "forgetting_factor": 1.0}
        chosen |= {"parts": (), "standardize": False, kernel_is: residual.SquaredExponential(d)}
        chosen |= {**figures, **options}
        robust, factor, parts = (chosen.pop(name) for name in ("robust", "forgetting_factor", "parts"))
        weight = [] if robust is None else [residual.RobustWeight(robust)]
        fading = [] if factor == 1.0 else [residual.ForgettingFactor(factor)]
        return make(d, m, parts=[*weight, *fading, *parts], **chosen)

    told = {"capacity": 100, **_AS_GIVEN, kernel_is: _KERNEL, **figures}
    robust, factor, parts = (told.pop(name, None) for name in ("robust", "forgetting_factor", "parts"))
    named = [f"RobustWeight({robust})"] if robust else []
    named += [f"ForgettingFactor({factor})"] if factor else []
    return _told(factory, make, **told, parts=_Written(f"[{', '.join([*named, *map(repr, parts or ())])}]"))


def _rbf(d: int, m: int, *, n_actions: int = 0, **options: Any) -> ResidualLearner:
    """Takes up the dead zone, too: smooth over 15 mm and 15 deg of the state and 8 deg of an actuator."""
    lengthscale = torch.tensor([15.0] * (d - n_actions) + [4.0] * n_actions, dtype=torch.float64)
    kernel = residual.SquaredExponential(d, lengthscale=lengthscale, variance=4.0)
    return _sogp(robust=3.0, forgetting_factor=0.995, kernel=kernel)(d, m, **options)


def _action_linear(d: int, m: int, *, n_actions: int = 0, **options: Any) -> ResidualLearner:
    """The learner of :meth:`EnhancedModel.for_grasp`."""
    kernel = grasp_kernel(d - n_actions, n_actions)
    return _sogp(robust=3.0, forgetting_factor=0.995, kernel=kernel)(d, m, **options)


_STILL = _sogp(residual.DeepKernelSOGP, "base", robust=3.0)
_WANDERING = _sogp(robust=3.0, parts=[residual.ProcessNoise(0.003), residual.LearnHyperparameters()])


def _mixture(d: int, m: int, **options: Any) -> ResidualLearner:
    """One that stands still and learns features, one that wanders: evidence decides."""
    return residual.MixtureResidual([_STILL(d, m, **options), _WANDERING(d, m, **options)])


vars(_mixture)["call"] = f"MixtureResidual([{constructor_call(_STILL)}, {constructor_call(_WANDERING)}])"


_FRESH: dict[str, Any] = {**_AS_GIVEN, "forgetting_factor": 0.99, "robust": 3.0}
_LEARNING = [residual.LearnHyperparameters()]

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
    "window GP": _kind(residual.WindowGP, "window", "kernel", robust=3.0, **_AS_GIVEN),
    "local GPs": _kind(residual.LocalGPs, "window", "kernel", experts=40, **_AS_GIVEN),
    "KRLS-T": _kind(residual.KRLSTracker, "capacity", "kernel", forgetting_factor=0.99, **_AS_GIVEN),
    "MLP": _kind(residual.ReplayMLP, standardize=False),
    "MLP ensemble": _kind(residual.ReplayMLP, members=3, standardize=False),
    "SOGP default": _kind(residual.SparseOnlineGP, "capacity"),
    "SOGP plain": _sogp(),  # as in the paper: nothing forgotten, every sample trusted
    "SOGP": _sogp(forgetting_factor=0.99, robust=3.0),
    "SOGP adaptive": _sogp(forgetting_factor=0.99, robust=3.0, parts=[residual.CalibrateNoise(), *_LEARNING]),
    "SOGP detecting": _sogp(
        robust=3.0, parts=[residual.CalibrateNoise(), residual.DetectChanges(), *_LEARNING]
    ),
    # no forgetting: what features are learned from is the past
    "SOGP deep": _sogp(
        residual.DeepKernelSOGP,
        "base",
        robust=3.0,
        parts=[residual.CalibrateNoise(), residual.DetectChanges()],
    ),
    "SOGP mixture": _mixture,
    "river forest": _kind(interop.RiverResidual),
    "GPyTorch window": _kind(interop.GPyTorchWindow, "window", noise_variance=NOISE_VARIANCE),
    "GPyTorch SVGP": _kind(interop.GPyTorchSVGP, "inducing", memory=500, minibatch=20),
}
#: Learners of other libraries: ten to a hundred times as slow, and in an extra of their own.
PEERS = ("river forest", "GPyTorch window", "GPyTorch SVGP")
#: The default learner, and the sparse online GP in its forms.
OURS = ("default", *(name for name in LEARNERS if name.startswith("SOGP")))
#: What a comparison takes if nobody says otherwise: not those that want to know which inputs are an action.
COMPARED = tuple(name for name in LEARNERS if name not in (*PEERS, "rbf", "action-linear"))
#: What demo and experiments take if nobody names another.
DEFAULT_LEARNER = "action-linear"
#: Those that the ablation of a hand compares.
HAND_LEARNERS = (
    "action-linear", "rbf", "SOGP plain", "SOGP deep", "linear RLS", "random features", "window GP", "MLP",
    "model alone",
)  # fmt: skip
#: What a hand wants other than any stream: it wears slowly, and a motion says little of a slope.
_ON_A_HAND: dict[str, dict[str, Any]] = {
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
        capacity: basis vectors, window or random frequencies; networks and RLS have no such figure.
        options: instead of the factory's own choices.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    options = {"capacity": capacity, **_ON_A_HAND.get(name, {}), **options}
    return learner_factory(name)(n_s + n_a, N_OUT, n_actions=n_a, **options)


def learner_figures(name: str, capacity: int, **options: Any) -> dict[str, Any]:
    """What a learner is made with, defaults included, by one with one state and action."""
    return describe(make_learner(name, 1, 1, capacity, **options))
