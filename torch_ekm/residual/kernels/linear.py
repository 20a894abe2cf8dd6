"""The kernel of linear functions."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ...typing import Tensor
from ..checks import check_count
from .kernel import Kernel, log_parameter


class LinearKernel(Kernel):
    """``k = x' V z`` with ``V = diag(variance)``: the mean is linear in x and 0 at x = 0."""

    def __init__(
        self,
        in_features: int,
        *,
        variance: float | Sequence[float] | Tensor = 1.0,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        d = check_count("in_features", in_features)
        self.log_variance = log_parameter("variance", variance, (*batch_shape, d), dtype=dtype, device=device)

    @property
    def variance(self) -> Tensor:
        """Prior variance of the slopes, ``(*batch_shape, d)``."""
        return self.log_variance.exp()

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        return (x * self.variance.unsqueeze(-2)) @ z.mT

    def diagonal(self, x: Tensor) -> Tensor:
        return (x * x * self.variance).sum(-1)

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        slope = z * self.variance.unsqueeze(-2)
        slope = slope.expand(*x.shape[:-1], *slope.shape[-2:])
        return (slope @ x.unsqueeze(-1)).squeeze(-1), slope

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        return 2.0 * x * self.variance
