"""Learners by name, in the units of a grasp, and the enhanced model around them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from ..enhanced import EnhancedModel, GraspEncoding
from ..exceptions import UnknownNameError
from ..kinematics import GraspState
from ..model import KinematicModel
from ..residual import (
    ActionLinearKernel,
    DeepKernelSOGP,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    ResidualLearner,
    SparseOnlineGP,
    SquaredExponential,
    WindowGP,
    ZeroResidual,
)

_MM, _DEG = 1e-3, math.pi / 180
#: Outputs: translation [mm] and rotation [deg] of the object in the hand frame.
N_OUT = 6
#: s2 of a motion in these units: what camera, servo and play leave unexplained.
NOISE_VARIANCE = 0.1


def _action_linear(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    state = SquaredExponential(n_s, lengthscale=6.0)
    kernel = ActionLinearKernel(n_s + n_a, n_a, state_kernel=state, action_variance=0.1)
    chosen = {"noise_variance": NOISE_VARIANCE, "robust": 3.0, "forgetting": 0.995, **options}
    return SparseOnlineGP(n_s + n_a, N_OUT, capacity=capacity, kernel=kernel, **chosen)


def _paper(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """As in the paper: squared exponential, one lengthscale; nothing forgotten, every sample trusted."""
    chosen = {"noise_variance": NOISE_VARIANCE, **options}
    return SparseOnlineGP(n_s + n_a, N_OUT, capacity=capacity, **chosen)


def _rbf(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """Squared exponential, smooth over 15 mm, 15 deg of the state and 8 deg of an actuator.

    It takes up the dead zone, which no kernel that is linear in the action can.
    """
    lengthscale = torch.tensor([15.0] * n_s + [4.0] * n_a, dtype=torch.float64)
    kernel = SquaredExponential(n_s + n_a, lengthscale=lengthscale, variance=4.0)
    chosen = {"noise_variance": NOISE_VARIANCE, "robust": 3.0, "forgetting": 0.995, **options}
    return SparseOnlineGP(n_s + n_a, N_OUT, capacity=capacity, kernel=kernel, **chosen)


def _deep(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    chosen = {"noise_variance": NOISE_VARIANCE, "robust": 3.0, "forgetting": 0.995, **options}
    return DeepKernelSOGP(n_s + n_a, N_OUT, capacity=capacity, **chosen)


def _rls(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    chosen = {"noise_variance": NOISE_VARIANCE, "forgetting": 0.995, "robust": 3.0, **options}
    return RecursiveLeastSquares(n_s + n_a, N_OUT, weight_variance=0.1, **chosen)


def _rff(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    chosen = {"noise_variance": NOISE_VARIANCE, "forgetting": 0.995, "robust": 3.0, **options}
    return RandomFeatureRLS(n_s + n_a, N_OUT, n_frequencies=capacity, **chosen)


def _window(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    return WindowGP(
        n_s + n_a, N_OUT, window=capacity, **{"noise_variance": NOISE_VARIANCE, "robust": 3.0, **options}
    )


def _mlp(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    return ReplayMLP(n_s + n_a, N_OUT, **options)


def _none(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    return ZeroResidual(n_s + n_a, N_OUT, noise_variance=NOISE_VARIANCE, **options)


#: What demo and experiments take unless told otherwise.
DEFAULT_LEARNER = "rbf"

#: Name -> ``factory(n_s, n_a, capacity, **options)``; n_s features of the state, n_a actuators.
LEARNERS: dict[str, Callable[..., ResidualLearner]] = {
    "rbf": _rbf,
    "action-linear": _action_linear,
    "paper": _paper,
    "deep": _deep,
    "rls": _rls,
    "rff": _rff,
    "window": _window,
    "mlp": _mlp,
    "none": _none,
}


def make_learner(name: str, n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """A fresh learner of ``[encode(s); da]``.

    Args:
        name: a key of :data:`LEARNERS`.
        n_s, n_a: features of the state, actuators.
        capacity: basis points, window or random frequencies; networks and RLS have no such figure.
        options: instead of the factory's own choices.

    Raises:
        UnknownNameError: no such learner; the message lists them.
    """
    if name not in LEARNERS:
        raise UnknownNameError("learner", name, LEARNERS)
    return LEARNERS[name](n_s, n_a, capacity, **options)


def learner_figures(name: str, capacity: int, **options: Any) -> dict[str, Any]:
    """Kind, kernel and switches of a learner as plain figures, by an example with one state and action."""
    learner = make_learner(name, 1, 1, capacity, **options)
    figures: dict[str, Any] = {"kind": type(learner).__name__}
    for key, value in vars(learner).items():
        if not key.startswith("_") and isinstance(value, bool | int | float | str | tuple | None):
            figures[key] = value
    kernel = getattr(learner, "kernel", None)
    if kernel is not None:
        parameters = {k: p.tolist() for k, p in kernel.named_parameters() if "log_" in k}
        figures["kernel"] = {"kind": type(kernel).__name__, **parameters}
    noise = getattr(learner, "noise_variance", None)
    if noise is not None:
        figures["noise_variance"] = torch.as_tensor(noise).tolist()
    return figures


def grasping_joints(model: KinematicModel, state: GraspState) -> list[int]:
    """Joints that can move a finger which touches the object."""
    hand, contacts = model.hand, model.contacts(state)
    upstream = model.kinematics.get_buffer("upstream")
    moved = torch.zeros(hand.n_q, dtype=torch.bool)
    for link in contacts.link:
        moved |= upstream[model.link_names.index(link)]
    free = torch.from_numpy(hand.joint_upper > hand.joint_lower)
    return torch.nonzero(moved & free).flatten().tolist()


def make_encoding(model: KinematicModel, reference: GraspState) -> GraspEncoding:
    """Inputs of a learner: the grasping fingers' joints and the object's pose, about ``reference``."""
    return GraspEncoding(reference, grasping_joints(model, reference))


def enhance(model: KinematicModel, learner: ResidualLearner, encoding: GraspEncoding) -> EnhancedModel:
    """``f + g`` with g on the object's six rows, actions in units of 2 deg, residuals in mm and deg."""
    scale = torch.tensor([1 / _MM] * 3 + [1 / _DEG] * 3, dtype=torch.float64)
    rows = list(range(model.hand.n_q, model.hand.n_q + N_OUT))
    return EnhancedModel(
        model, learner, encode=encoding, outputs=rows, action_scale=1 / (2 * _DEG), output_scale=scale
    )


def make_enhanced(
    model: KinematicModel, reference: GraspState, capacity: int, learner: str = DEFAULT_LEARNER
) -> EnhancedModel:
    """An E-KM that has learned nothing yet, with a learner of :data:`LEARNERS`."""
    encoding = make_encoding(model, reference)
    return enhance(model, make_learner(learner, encoding.n_features, model.hand.n_a, capacity), encoding)
