"""Kernels whose functions are linear in x, or in an action: then a controller's problem stays a convex QP."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..._checks import check_count
from ...exceptions import ParameterError
from ...typing import Float, Tensor
from .kernel import Kernel, check_kernel, log_parameter
from .stationary import SquaredExponential


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


class ActionLinearKernel(Kernel):
    """``k((s, a), (s', a')) = (a^T Lambda a') k_s(s, s')``, ``Lambda = diag(action_variance)``.

    A function drawn from this prior is ``g(s, a) = G(s) a`` with each entry of the matrix G a GP
    over the state: zero at zero action, linear in the action, variance quadratic in it. The action
    is the last ``action_features`` columns of x.

    Args:
        in_features: width of x = [s, a].
        action_features: width of a.
        state_kernel: k_s over the first ``in_features - action_features`` columns;
            squared exponential by default.
        action_variance: diagonal of Lambda, one number or one per action.

    Raises:
        ParameterError: no column is left for the state, or its kernel is of another width or fleet.
    """

    starts = ("action_variance",)

    def __init__(
        self,
        in_features: int,
        action_features: int,
        *,
        state_kernel: Kernel | None = None,
        action_variance: float | Sequence[float] | Tensor = 1.0,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.action_features = check_count("action_features", action_features)
        self.state_features = check_count("in_features", in_features) - self.action_features
        if self.state_features < 1:
            raise ParameterError("action_features", action_features, f"below in_features = {in_features}")
        factory = {"dtype": dtype, "device": device}
        if state_kernel is None:
            state_kernel = SquaredExponential(self.state_features, batch_shape=batch_shape, **factory)
        self.state_kernel = check_kernel(state_kernel, self.state_features, batch_shape)
        shape = *batch_shape, self.action_features
        self.log_action_variance = log_parameter("action_variance", action_variance, shape, **factory)

    @property
    def action_variance(self) -> Tensor:
        """Diagonal of Lambda, the variance of each action's slope, ``(*batch_shape, action_features)``."""
        return self.log_action_variance.exp()

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x as its state and its action, the last ``action_features`` columns."""
        return x[..., : self.state_features], x[..., self.state_features :]

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        (s, a), (sz, az) = self.split(x), self.split(z)
        return self.state_kernel(s, sz) * ((a * self.action_variance.unsqueeze(-2)) @ az.mT)

    def diagonal(self, x: Tensor) -> Tensor:
        s, a = self.split(x)
        return self.state_kernel.diagonal(s) * (a * a * self.action_variance).sum(-1)

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        (s, a), (sz, az) = self.split(x), self.split(z)
        ks, gs = self.state_kernel.with_gradient(s, sz)
        slope = az * self.action_variance.unsqueeze(-2)
        inner = (slope * a.unsqueeze(-2)).sum(-1)
        gradient = torch.cat([gs * inner.unsqueeze(-1), ks.unsqueeze(-1) * slope], dim=-1)
        return ks * inner, gradient

    def diagonal_gradient(self, x: Tensor) -> Tensor:
        s, a = self.split(x)
        ks = self.state_kernel.diagonal(s).unsqueeze(-1)
        norm = (a * a * self.action_variance).sum(-1, keepdim=True)
        by_state = self.state_kernel.diagonal_gradient(s) * norm
        return torch.cat([by_state, 2.0 * ks * a * self.action_variance], dim=-1)

    def shift_invariant(self, in_features: int) -> list[bool]:
        state = self.state_kernel.shift_invariant(self.state_features)
        return state + [False] * self.action_features

    def grows(self, in_features: int) -> list[bool]:
        return self.state_kernel.grows(self.state_features) + [True] * self.action_features
