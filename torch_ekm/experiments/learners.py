"""Learners by name: of any stream, which are compared, and of a hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
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


def _sparse(make: Factory = residual.SparseOnlineGP, of_kernel: str = "kernel", **own: Any) -> Factory:
    """A sparse online GP that distrusts and forgets by two figures, and has other parts."""

    def factory(d: int, m: int, **options: Any) -> ResidualLearner:
        given = {**_AS_GIVEN, of_kernel: residual.SquaredExponential(d), **own, **options}
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

#: Name -> ``factory(in_features, out_features, **options)``. Inputs and outputs are of the order of 1; all
#: but the first start from the same generic prior: lengthscale sqrt(d), unit variance, and about 100 of
#: whatever they keep.
LEARNERS: dict[str, Factory] = {
    "default": residual.default_learner,
    "model alone": residual.ZeroResidual,
    "linear RLS": partial(residual.RecursiveLeastSquares, **_FRESH),
    "random features": partial(residual.RandomFeatureRLS, **_FRESH),
    "MLP": partial(residual.ReplayMLP, standardize=False),
    "MLP ensemble": partial(residual.ReplayMLP, members=3, standardize=False),
    "SOGP default": residual.SparseOnlineGP,
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
    "river forest": interop.RiverResidual,
}
#: What a comparison takes if nobody says otherwise: not those of other libraries, which are slow.
COMPARED = tuple(name for name in LEARNERS if name != "river forest")


def learner_factory(name: str, known: Mapping[str, Factory] = LEARNERS) -> Factory:
    """The factory of that name.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    if name not in known:
        raise UnknownNameError("learner", name, known)
    return known[name]


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
    return learner_factory(name, HAND_LEARNERS)(n_s, n_a, capacity=capacity, **options)
