from __future__ import annotations

import torch
from torch.distributions import Normal

from ..._checks import check_positive
from ...typing import Tensor
from ..base import ResidualLearner
from ..report import UpdateReport


class ZeroResidual(ResidualLearner):
    """``g(x) = 0``, ``y ~ N(0, noise_variance)``: the model alone.

    Args:
        noise_variance: of y, in squared units.
        options: see ResidualLearner.
    """

    def __init__(
        self, in_features: int, out_features: int, *, noise_variance: float = 1.0, **options
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.noise_variance = check_positive("noise_variance", noise_variance)

    def forward(self, x: Tensor) -> Tensor:
        """Zeros that depend on x, so that gradients exist and are 0."""
        x = self.check_query(x)
        return (0.0 * x[..., :1]).expand(*x.shape[:-1], self.out_features)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(0, 0) (to rounding) or N(0, noise)."""
        mean = self(x)
        floor = torch.finfo(mean.dtype).tiny ** 0.5
        deviation = self.noise_variance**0.5 if observation else floor
        return Normal(mean, torch.full_like(mean, deviation), validate_args=False)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        return UpdateReport.of(y.square().mean(-1) / self.noise_variance, mask)
