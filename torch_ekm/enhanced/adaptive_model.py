"""Any model with parameters, which adapts while it is used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn

from .._checks import check_shape
from ..estimation.filters import ParameterFilter
from ..exceptions import NoDerivativeError, ParameterError
from ..residual.derivatives import recordable, value_and_jacobian
from ..typing import Float, Tensor

Model = Callable[[Any, Tensor], Tensor]


def differentiated(
    f: Model, state: Any, action: Float[Tensor, "*batch n_a"]
) -> tuple[Float[Tensor, "*batch n_s"], Float[Tensor, "*batch n_s n_a"]]:
    """``(f, df/dda)`` by automatic differentiation; entries of a batch must not depend on each other.

    Raises:
        NoDerivativeError: no derivative comes out of f, or none of an output that moves with the action.
    """
    try:
        value, J = value_and_jacobian(lambda a: f(recordable(state), a), action)
    except (RuntimeError, TypeError) as error:  # numpy does not take tensors that carry a derivative
        with torch.no_grad():
            f(state, action)  # what fails without a derivative, too, says so itself
        raise NoDerivativeError(f"{type(error).__name__}: {error}") from error
    if J is None:
        raise NoDerivativeError("its result is detached from it")
    silent = (J == 0).all(-1)
    if bool(silent.any()):  # nothing moves there, or a part of f carries no derivative
        moved = finite_differences(f, state, action)[silent].abs()
        if bool((moved > 1e-3 * J.abs().max()).any()):
            raise NoDerivativeError("some outputs move with the action and carry none")
    return value, J


@torch.no_grad()
def finite_differences(
    f: Model, state: Any, action: Float[Tensor, "*batch n_a"]
) -> Float[Tensor, "*batch n_s n_a"]:
    """``(f(a + h_j) - f(a - h_j)) / 2 h_j``, ``h_j = eps^(1/3) max(1, |a_j|)``: 2 n_a calls."""
    step = torch.finfo(action.dtype).eps ** (1 / 3) * action.detach().abs().clamp_min(1.0)
    columns = []
    for j in range(action.shape[-1]):
        up, down = action.detach().clone(), action.detach().clone()
        up[..., j] += step[..., j]
        down[..., j] -= step[..., j]
        width = (up[..., j] - down[..., j]).unsqueeze(-1)  # as rounded
        columns.append((f(state, up) - f(state, down)) / width)
    return torch.stack(columns, dim=-1)


class AdaptiveModel(nn.Module):
    """``f(s, da; theta)`` with ``theta`` from a :class:`ParameterFilter`, as f of an enhanced model.

    ::

        f = AdaptiveModel(lambda s, a, theta: theta[0] * a, ParameterFilter(["gain"], [1.0], [0.3]), 0.01)
        model = EnhancedModel(f, learner)

    Args:
        function: ``(state, action, theta) -> increment``, of torch, differentiable by theta.
        parameters: theta; it learns with :meth:`EnhancedModel.update`.
        noise_std: of an increment, what the best theta leaves unexplained: one, or one for each entry.

    Raises:
        ParameterError: the noise is not positive.
    """

    def __init__(
        self,
        function: Callable[[Any, Tensor, Tensor], Tensor],
        parameters: ParameterFilter,
        noise_std: float | Sequence[float] | Float[Tensor, " n_s"],
    ) -> None:
        super().__init__()
        self.function, self.theta = function, parameters
        noise = torch.as_tensor(noise_std).double()
        if not bool((noise > 0).all()) or not bool(noise.isfinite().all()):
            raise ParameterError("noise_std", noise_std, "positive")
        self.noise_std = nn.Buffer(noise)

    def forward(self, state: Any, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_s"]:
        """``f(s, da; m)``."""
        return self.function(state, action, self.theta.mean.to(action))

    def adapt(self, state: Any, action: Float[Tensor, " n_a"], increment: Float[Tensor, " n_s"]) -> float:
        """Learn from one motion; z of the filter.

        Raises:
            NoDerivativeError: f carries no derivative by theta.
            ShapeError, NonFiniteError: nothing is changed.
        """
        fixed = recordable(state), recordable(action.detach())
        predicted, rows = value_and_jacobian(
            lambda theta: self.function(*fixed, theta), self.theta.mean.to(action)
        )
        check_shape("increment", increment, predicted.shape, "as the prediction has")
        if rows is None:
            raise NoDerivativeError("its result carries none by theta")
        if self.noise_std.dim():
            check_shape("noise_std", self.noise_std, predicted.shape, "or one for all")
        return self.theta.update(increment - predicted, rows, self.noise_std.square().expand(len(predicted)))
