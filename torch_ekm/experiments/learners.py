"""Learners by name, in the units of a grasp, and the enhanced model around them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from ..enhanced.grasp_learner import NOISE_VARIANCE, grasp_learner
from ..exceptions import UnknownNameError
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

#: Outputs: translation [mm] and rotation [deg] of the object in the hand frame.
N_OUT = 6


def _action_linear(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    state = SquaredExponential(n_s, lengthscale=6.0)
    kernel = ActionLinearKernel(n_s + n_a, n_a, state_kernel=state, action_variance=0.1)
    chosen = {"noise_variance": NOISE_VARIANCE, "robust": 3.0, "forgetting": 0.995, **options}
    return SparseOnlineGP(n_s + n_a, N_OUT, capacity=capacity, kernel=kernel, **chosen)


def _paper(n_s: int, n_a: int, capacity: int, **options: Any) -> ResidualLearner:
    """As in the paper: squared exponential, one lengthscale; nothing forgotten, every sample trusted."""
    chosen = {"noise_variance": NOISE_VARIANCE, **options}
    return SparseOnlineGP(n_s + n_a, N_OUT, capacity=capacity, **chosen)


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
    "rbf": grasp_learner,
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
