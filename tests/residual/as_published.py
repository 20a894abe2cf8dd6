"""The sparse GP as published: inputs and outputs as they are, no part but those that a test names."""

from typing import Any

import torch

from torch_ekm.residual import DeepKernelSOGP, ResidualLearner, SparseOnlineGP, SquaredExponential


def sogp(in_features: int, out_features: int, **options: Any) -> SparseOnlineGP:
    kernel = SquaredExponential(in_features, batch_shape=options.get("batch_shape", ()))
    chosen: dict[str, Any] = {"kernel": kernel, "noise_variance": 0.01, "parts": (), "standardize": False}
    return SparseOnlineGP(in_features, out_features, **{**chosen, **options})


def deep_sogp(in_features: int, out_features: int, **options: Any) -> SparseOnlineGP:
    base = SquaredExponential(in_features, batch_shape=options.get("batch_shape", ()))
    chosen: dict[str, Any] = {"base": base, "noise_variance": 0.01, "parts": (), "standardize": False}
    return DeepKernelSOGP(in_features, out_features, **{**chosen, **options})


def in_turn(learner: ResidualLearner, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Errors of predictions that come before learning; a fleet takes all its streams at once."""
    errors = []
    for x_t, y_t in zip(x, y, strict=True):
        errors.append(y_t - learner(x_t))
        learner.update(x_t, y_t)
    return torch.stack(errors)


def share_left(learner: ResidualLearner, x: torch.Tensor, y: torch.Tensor) -> float:
    """Their size over that of the model alone."""
    return float((in_turn(learner, x, y).square().mean() / y.square().mean()).sqrt())
