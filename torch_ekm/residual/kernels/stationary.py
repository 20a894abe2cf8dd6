"""Kernels of the distance between two points."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch

from ..._checks import check_count
from ...typing import Float, Tensor
from .kernel import Kernel, log_parameter

LARGE = 1e7  # square whose rounding, 1e-9, is a distance between points that nearly coincide


def squared_distances(x: Float[Tensor, "*any n d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
    """``|x_i - z_j|^2``, ``(*batch, n, m)``."""
    if x.shape[-2] == 1:  # differences are exact; products are faster for many queries
        return (z - x).square().sum(-1).unsqueeze(-2)
    # about one of the points: far from 0 the difference of large squares would be all rounding
    centre = z[..., :1, :].detach()
    a, c = x - centre, z - centre
    a2, c2 = a.square().sum(-1), c.square().sum(-1)
    # a basis with a point far out needs differences; on a GPU looking would mean waiting
    if x is z and not (x.is_cuda or torch.compiler.is_compiling()) and bool((c2 > LARGE).any()):
        return (z.unsqueeze(-3) - x.unsqueeze(-2)).square().sum(-1)
    return (a2.unsqueeze(-1) + c2.unsqueeze(-2) - 2.0 * a @ c.mT).clamp_min(0.0)


class StationaryKernel(Kernel):
    """``k = v phi(|x - z|^2_L)``, ``dk/dx = v psi L^-2 (z - x)`` with ``psi = -2 phi'``.

    Subclasses give phi and psi as functions of the squared scaled distance.

    Args:
        in_features: width d of x.
        lengthscale: L, one number or one per input; default ``sqrt(d)``.
        variance: v.
    """

    starts = ("lengthscale", "variance")

    def __init__(
        self,
        in_features: int,
        *,
        lengthscale: float | Sequence[float] | Tensor | None = None,
        variance: float | Tensor = 1.0,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        d = check_count("in_features", in_features)
        factory = {"dtype": dtype, "device": device}
        lengthscale = math.sqrt(d) if lengthscale is None else lengthscale
        self.log_lengthscale = log_parameter("lengthscale", lengthscale, (*batch_shape, d), **factory)
        self.log_variance = log_parameter("variance", variance, tuple(batch_shape), **factory)

    @property
    def lengthscale(self) -> Tensor:
        """L, in units of the (normalised) inputs, ``(*batch_shape, d)``."""
        return self.log_lengthscale.exp()

    @property
    def variance(self) -> Tensor:
        """v = k(x, x), in the squared unit of the (normalised) outputs, ``(*batch_shape)``."""
        return self.log_variance.exp()

    @staticmethod
    @abstractmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        """Correlation phi and ``psi = -2 dphi/d(d2)`` at the squared scaled distance."""

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        w = self.log_lengthscale.neg().exp().unsqueeze(-2)
        scaled = x * w
        d2 = squared_distances(scaled, scaled if z is x else z * w)
        return self.log_variance.exp()[..., None, None] * self.phi_psi(d2)[0]

    def diagonal(self, x: Tensor) -> Tensor:
        return self.log_variance.exp().expand(x.shape[:-1])

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        w = self.log_lengthscale.neg().exp().unsqueeze(-2)
        u = (z - x.unsqueeze(-2)) * w
        phi, psi = self.phi_psi(u.square().sum(-1))
        v = self.log_variance.exp().unsqueeze(-1)
        return v * phi, (v * psi).unsqueeze(-1) * (u * w)

    def shift_invariant(self, in_features: int) -> list[bool]:
        return [True] * in_features

    def extra_repr(self) -> str:
        return f"in_features={self.log_lengthscale.shape[-1]}"


class SquaredExponential(StationaryKernel):
    """``k = v exp(-1/2 |x - z|^2_L)``."""

    @staticmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        phi = torch.exp(-0.5 * d2)
        return phi, phi


# sqrt has no derivative at 0; below this squared distance the correlation is 1 to rounding anyway
_TINY = 1e-30


class Matern32(StationaryKernel):
    """``k = v (1 + sqrt(3) r) exp(-sqrt(3) r)``, ``r = |x - z|_L``."""

    @staticmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        r = (3.0 * d2.clamp_min(_TINY)).sqrt()
        decay = torch.exp(-r)
        return (1.0 + r) * decay, 3.0 * decay
