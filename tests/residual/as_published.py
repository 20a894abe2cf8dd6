"""The sparse GP as published: inputs and outputs as they are, no part but those that a test names."""

from __future__ import annotations

from typing import Any

from torch_ekm.residual import DeepKernelSOGP, SparseOnlineGP, SquaredExponential


def sogp(in_features: int, out_features: int, **options: Any) -> SparseOnlineGP:
    kernel = SquaredExponential(in_features, batch_shape=options.get("batch_shape", ()))
    chosen: dict[str, Any] = {"kernel": kernel, "noise_variance": 0.01, "parts": (), "standardize": False}
    return SparseOnlineGP(in_features, out_features, **{**chosen, **options})


def deep_sogp(in_features: int, out_features: int, **options: Any) -> SparseOnlineGP:
    base = SquaredExponential(in_features, batch_shape=options.get("batch_shape", ()))
    chosen: dict[str, Any] = {"base": base, "noise_variance": 0.01, "parts": (), "standardize": False}
    return DeepKernelSOGP(in_features, out_features, **{**chosen, **options})
