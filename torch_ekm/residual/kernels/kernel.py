"""Covariance functions with closed-form gradients, on ``(*batch, n, d)`` tensors.

A kernel gives four things: the matrix ``k(X, Z)``, its diagonal ``k(x, x)``, and the derivatives
of both with respect to a query x. Hyperparameters are logarithms with the shape of the fleet in
front, ``(*batch_shape, ...)``; they are Parameters without ``requires_grad``, since only the
learner's own adaptation moves them (a plain optimiser would leave its caches stale).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import nn

from ...exceptions import ParameterError
from ...typing import Float, Tensor
from ..base import check_count


class Kernel(nn.Module, ABC):
    """A covariance function k(x, z)."""

    @abstractmethod
    def forward(self, x: Float[Tensor, "*batch n d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
        """Matrix k(x_i, z_j), ``(*batch, n, m)``."""

    @abstractmethod
    def diagonal(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch"]:
        """k(x, x) of one point per model; further axes go in front."""

    @abstractmethod
    def with_gradient(
        self, x: Float[Tensor, "*batch d"], z: Float[Tensor, "*batch m d"]
    ) -> tuple[Tensor, Tensor]:
        """``(k(x, z_j), d k(x, z_j)/dx)``: shapes ``(*batch, m)`` and ``(*batch, m, d)``."""

    @abstractmethod
    def diagonal_gradient(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """d k(x, x)/dx."""

    def vector(self, x: Float[Tensor, "*batch d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
        """k(x, z_j) for one query per model, ``(*batch, m)``."""
        return self(x.unsqueeze(-2), z).squeeze(-2)

    def diagonal_of_set(self, x: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n"]:
        """k(x_i, x_i) of n points per model."""
        return self.diagonal(x.movedim(-2, 0)).movedim(0, -1)

    def shift_invariant(self, in_features: int) -> list[bool]:
        """Columns of x whose origin does not matter; a normaliser may centre these and no others."""
        return [False] * in_features

    def __add__(self, other: Kernel) -> SumKernel:
        return SumKernel(self, other)

    def __mul__(self, other: Kernel) -> ProductKernel:
        return ProductKernel(self, other)


def log_parameter(
    name: str, value: float | Sequence[float] | Tensor, shape: tuple[int, ...], **factory
) -> nn.Parameter:
    """``log(value)``, broadcast to ``shape``.

    Raises:
        ParameterError: a value is not positive and finite, or does not broadcast.
    """
    try:
        values = torch.as_tensor(value, **factory)
    except (TypeError, ValueError, RuntimeError):
        raise ParameterError(name, value, "one number or numbers") from None
    if not bool(((values > 0) & values.isfinite()).all()):
        raise ParameterError(name, values.tolist(), "positive and finite")
    try:
        values = values.expand(shape)
    except RuntimeError:
        raise ParameterError(name, values.tolist(), f"one number or of shape {tuple(shape)}") from None
    return nn.Parameter(values.log().contiguous(), requires_grad=False)


def check_kernel(kernel: Kernel, in_features: int, batch_shape: tuple[int, ...]) -> Kernel:
    """The kernel, if it takes inputs of that width and is one for all models or one for each.

    Raises:
        ParameterError: it is none, or of another width or fleet.
    """
    valid = f"a Kernel of {in_features} inputs, for one model or a fleet of {tuple(batch_shape)}"
    if not isinstance(kernel, Kernel):
        raise ParameterError("kernel", type(kernel).__name__, valid)
    try:
        shape = _shape_of(kernel, in_features)
    except RuntimeError:
        raise ParameterError("kernel", repr(kernel), valid) from None
    if shape not in ((), tuple(batch_shape)):
        raise ParameterError("kernel", repr(kernel), valid)
    return kernel


def is_shared(kernel: Kernel, in_features: int) -> bool:
    """Whether the kernel is one for all models of a fleet."""
    return _shape_of(kernel, in_features) == ()


def _shape_of(kernel: Kernel, in_features: int) -> tuple[int, ...]:
    like = next(kernel.parameters(), torch.empty(0, dtype=torch.float64))
    x = like.new_zeros(1, in_features)
    return tuple(kernel(x, x).shape[:-2])


def squared_distances(x: Float[Tensor, "*batch n d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
    """``|x_i - z_j|^2`` by one product, ``(*batch, n, m)``: for points near 0, see StationaryKernel."""
    d2 = x.square().sum(-1).unsqueeze(-1) + z.square().sum(-1).unsqueeze(-2)
    return (d2 - 2.0 * x @ z.mT).clamp_min(0.0)


class StationaryKernel(Kernel):
    """``k = v phi(|x - z|^2_L)``, ``dk/dx = v psi L^-2 (z - x)`` with ``psi = -2 phi'``.

    Subclasses give phi and psi as functions of the squared scaled distance.

    Args:
        in_features: width d of x.
        lengthscale: L, one number or one per input; default ``sqrt(d)``.
        variance: v.
    """

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
        """v = k(x, x), ``(*batch_shape)``."""
        return self.log_variance.exp()

    @staticmethod
    @abstractmethod
    def phi(d2: Tensor) -> Tensor:
        """Correlation at squared scaled distance ``d2``."""

    @staticmethod
    @abstractmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        """Correlation and ``-2 dphi/d(d2)``."""

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        w = self.log_lengthscale.neg().exp().unsqueeze(-2)
        if x.shape[-2] == 1:  # differences are exact; products are faster for many queries
            d2 = ((z - x) * w).square().sum(-1).unsqueeze(-2)
        else:
            # about one of the points: far from 0 the difference of large squares would be all rounding
            centre = z[..., :1, :].detach()
            d2 = squared_distances((x - centre) * w, (z - centre) * w)
        return self.log_variance.exp()[..., None, None] * self.phi(d2)

    def vector(self, x: Tensor, z: Tensor) -> Tensor:
        w = self.log_lengthscale.neg().exp().unsqueeze(-2)
        u = torch.addcmul(x.unsqueeze(-2) * w, z, w, value=-1.0)
        # In a large fleet fresh memory costs more than arithmetic. The norm takes none, but it has no
        # second derivative at 0.
        d2 = u.square().sum(-1) if torch.is_grad_enabled() else torch.linalg.vector_norm(u, dim=-1).square()
        return self.log_variance.exp().unsqueeze(-1) * self.phi(d2)

    def diagonal(self, x: Tensor) -> Tensor:
        return self.log_variance.exp().expand(x.shape[:-1])

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        w = self.log_lengthscale.neg().exp().unsqueeze(-2)
        u = (z - x.unsqueeze(-2)) * w
        phi, psi = self.phi_psi(u.square().sum(-1))
        v = self.log_variance.exp().unsqueeze(-1)
        return v * phi, (v * psi).unsqueeze(-1) * (u * w)

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def shift_invariant(self, in_features: int) -> list[bool]:
        return [True] * in_features

    def extra_repr(self) -> str:
        return f"in_features={self.log_lengthscale.shape[-1]}"


class SquaredExponential(StationaryKernel):
    """``k = v exp(-1/2 |x - z|^2_L)``."""

    @staticmethod
    def phi(d2: Tensor) -> Tensor:
        return torch.exp(-0.5 * d2)

    @staticmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        phi = torch.exp(-0.5 * d2)
        return phi, phi


# sqrt has no derivative at 0; below this squared distance the correlation is 1 to rounding anyway
_TINY = 1e-30


class Matern32(StationaryKernel):
    """``k = v (1 + sqrt(3) r) exp(-sqrt(3) r)``, r = |x - z|_L."""

    @staticmethod
    def phi(d2: Tensor) -> Tensor:
        r = (3.0 * d2.clamp_min(_TINY)).sqrt()
        return (1.0 + r) * torch.exp(-r)

    @staticmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        r = (3.0 * d2).sqrt()
        decay = torch.exp(-r)
        return (1.0 + r) * decay, 3.0 * decay


class Matern52(StationaryKernel):
    """``k = v (1 + sqrt(5) r + 5/3 r^2) exp(-sqrt(5) r)``, r = |x - z|_L."""

    @staticmethod
    def phi(d2: Tensor) -> Tensor:
        r = (5.0 * d2.clamp_min(_TINY)).sqrt()
        return (1.0 + r + r * r / 3.0) * torch.exp(-r)

    @staticmethod
    def phi_psi(d2: Tensor) -> tuple[Tensor, Tensor]:
        r = (5.0 * d2).sqrt()
        decay = torch.exp(-r)
        return (1.0 + r + r * r / 3.0) * decay, (5.0 / 3.0) * (1.0 + r) * decay


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


class SumKernel(Kernel):
    """``k = k_1 + k_2``."""

    def __init__(self, first: Kernel, second: Kernel) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        return self.first(x, z) + self.second(x, z)

    def diagonal(self, x: Tensor) -> Tensor:
        return self.first.diagonal(x) + self.second.diagonal(x)

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        (k1, g1), (k2, g2) = self.first.with_gradient(x, z), self.second.with_gradient(x, z)
        return k1 + k2, g1 + g2

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        return self.first.diagonal_gradient(x) + self.second.diagonal_gradient(x)

    def shift_invariant(self, in_features: int) -> list[bool]:
        pairs = zip(
            self.first.shift_invariant(in_features), self.second.shift_invariant(in_features), strict=True
        )
        return [a and b for a, b in pairs]


class ProductKernel(Kernel):
    """``k = k_1 k_2``."""

    def __init__(self, first: Kernel, second: Kernel) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        return self.first(x, z) * self.second(x, z)

    def diagonal(self, x: Tensor) -> Tensor:
        return self.first.diagonal(x) * self.second.diagonal(x)

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        (k1, g1), (k2, g2) = self.first.with_gradient(x, z), self.second.with_gradient(x, z)
        return k1 * k2, g1 * k2.unsqueeze(-1) + g2 * k1.unsqueeze(-1)

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        k1, k2 = self.first.diagonal(x).unsqueeze(-1), self.second.diagonal(x).unsqueeze(-1)
        return self.first.diagonal_gradient(x) * k2 + self.second.diagonal_gradient(x) * k1

    def shift_invariant(self, in_features: int) -> list[bool]:
        pairs = zip(
            self.first.shift_invariant(in_features), self.second.shift_invariant(in_features), strict=True
        )
        return [a and b for a, b in pairs]
