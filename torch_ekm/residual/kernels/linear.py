from __future__ import annotations

from collections.abc import Sequence

import torch

from ..._checks import check_count
from ...typing import Float, Tensor
from .kernel import Kernel, log_parameter


class LinearKernel(Kernel):
    """``k(x, z) = v (1 + x^T Lambda z)``, ``Lambda = diag(slope_variance)``.

    A function drawn from this prior is ``g(x) = w^T x + w_0``, ``w_0 ~ N(0, v)`` and ``w ~ N(0, v Lambda)``:
    Bayesian linear regression (Rasmussen and Williams, Gaussian processes for machine learning, 2006, 2.1).
    ``in_features + 1`` basis vectors say all of it.

    Args:
        in_features: width d of x.
        slope_variance: diagonal of Lambda, one number or one per input.
        variance: v.
    """

    starts = ("slope_variance", "variance")

    def __init__(
        self,
        in_features: int,
        *,
        slope_variance: float | Sequence[float] | Tensor = 1.0,
        variance: float | Tensor = 1.0,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        shape = *batch_shape, check_count("in_features", in_features)
        factory = {"dtype": dtype, "device": device}
        self.log_slope_variance = log_parameter("slope_variance", slope_variance, shape, **factory)
        self.log_variance = log_parameter("variance", variance, tuple(batch_shape), **factory)

    @property
    def slope_variance(self) -> Float[Tensor, "*batch in_features"]:
        """Diagonal of Lambda, the variance of each slope in units of v."""
        return self.log_slope_variance.exp()

    @property
    def variance(self) -> Float[Tensor, "*batch"]:
        """v = k(0, 0), in the squared unit of the (normalised) outputs."""
        return self.log_variance.exp()

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        return self.variance[..., None, None] * (1.0 + (x * self.slope_variance.unsqueeze(-2)) @ z.mT)

    def diagonal(self, x: Tensor) -> Tensor:
        return self.variance * (1.0 + (x * x * self.slope_variance).sum(-1))

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        slope = z * (self.variance.unsqueeze(-1) * self.slope_variance).unsqueeze(-2)
        value = self.variance.unsqueeze(-1) + (slope * x.unsqueeze(-2)).sum(-1)
        return value, slope.expand(*value.shape, x.shape[-1])

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        return 2.0 * self.variance.unsqueeze(-1) * self.slope_variance * x

    def shift_invariant(self, in_features: int) -> list[bool]:
        # the constant takes up any shift: affine functions of x stay affine
        return [True] * in_features

    def grows(self, in_features: int) -> list[bool]:
        return [True] * in_features
