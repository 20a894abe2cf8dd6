"""The kernel whose mean is linear in the action, so that a controller's problem stays a convex QP."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..._checks import check_count
from ...exceptions import ParameterError
from ...typing import Tensor
from .kernel import Kernel, log_parameter
from .stationary import SquaredExponential


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
        ParameterError: no column is left for the state.
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
        self.state_kernel = state_kernel
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
