"""The learner that learns nothing: what every other is measured against."""

from __future__ import annotations

import torch
from torch.distributions import Normal

from ...typing import Tensor
from ..base import ResidualLearner
from ..checks import check_positive
from ..report import UpdateEvent, UpdateReport


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
        x = self._check_query(x)
        return (0.0 * x[..., :1]).expand(*x.shape[:-1], self.out_features)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(0, 0) (to rounding) or N(0, noise)."""
        mean = self(x)
        floor = torch.finfo(mean.dtype).tiny ** 0.5
        deviation = self.noise_variance**0.5 if observation else floor
        return Normal(mean, torch.full_like(mean, deviation), validate_args=False)

    def reset(self) -> None:
        """Only the count of refused samples is state."""
        self.n_refused.zero_()

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        one = torch.ones_like(y[..., 0])
        event = torch.full_like(one, UpdateEvent.ABSORBED, dtype=torch.int64)
        nis = y.square().mean(-1) / self.noise_variance
        return UpdateReport(event if mask is None else event * mask, 0.0 * one, nis, one)
