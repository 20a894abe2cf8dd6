"""How a user's model changes with the action: differentiated, or by finite differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from ..exceptions import NoDerivativeError
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
