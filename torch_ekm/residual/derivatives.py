"""Derivatives by autograd, whatever mode the caller is in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from ..typing import Float, Tensor


def recordable(x: Any) -> Any:
    """Outside of inference mode its tensors as ones that autograd takes, also within tuples, lists and dicts;
    all else as it is."""
    if type(x) is dict:
        return {name: recordable(value) for name, value in x.items()}
    if type(x) in (tuple, list):
        return type(x)(map(recordable, x))
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return type(x)(*map(recordable, x))
    if isinstance(x, Tensor) and x.is_inference() and not torch.is_inference_mode_enabled():
        return x.clone()
    return x


def value_and_jacobian(
    f: Callable[[Tensor], Tensor], x: Float[Tensor, "*any in"]
) -> tuple[Float[Tensor, "*any out"], Float[Tensor, "*any out in"] | None]:
    """``(f(x), df/dx)`` by autograd, under ``no_grad`` and in inference mode too; entries of a batch must not
    depend on each other. None: f carries no derivative."""
    with torch.inference_mode(False), torch.enable_grad():
        at = x.detach().clone().requires_grad_(True)
        value = f(at)
        if not value.requires_grad:
            return value, None
        rows = [  # one backward pass per output
            torch.autograd.grad(one.sum(), at, retain_graph=True, materialize_grads=True)[0]
            if one.requires_grad
            else torch.zeros_like(at)
            for one in value.unbind(-1)
        ]
    return value.detach(), torch.stack(rows, dim=-2)
