"""One code for tensors and numpy arrays.

Equations are written in what ``torch`` and ``numpy`` share (:func:`namespace`). Tensors carry batches and
derivatives. One state without a derivative is computed in arrays, in which a small operation costs a third:
:func:`in_numpy` and :func:`in_torch` convert, without a copy.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch.autograd.forward_ad import unpack_dual

from .typing import AnyArray, Tensor

T = TypeVar("T")


def namespace(x: AnyArray) -> Any:
    """``torch`` or ``numpy``: the module whose functions take x."""
    return torch if isinstance(x, Tensor) else np


def is_plain(*values: Tensor) -> bool:
    """Numbers alone: float64 on the CPU, without a derivative, and none that stand for others (vmap)."""
    for x in values:
        if type(x) is not Tensor or x.dtype is not torch.float64 or not x.is_cpu or x.requires_grad:
            return False
        if unpack_dual(x).tangent is not None:
            return False
        try:
            x.data_ptr()
        except RuntimeError:
            return False
    return True


def zeros(like: AnyArray, *shape: int) -> Any:
    """Zeros of the kind of ``like``."""
    return like.new_zeros(shape) if isinstance(like, Tensor) else np.zeros(shape)


def eye(like: AnyArray, n: int) -> Any:
    """The unit matrix of the kind of ``like``."""
    return torch.eye(n, dtype=like.dtype, device=like.device) if isinstance(like, Tensor) else np.eye(n)


def norm(x: AnyArray) -> Any:
    """``|x|`` along the last axis."""
    return torch.linalg.vector_norm(x, dim=-1) if isinstance(x, Tensor) else np.sqrt((x * x).sum(-1))


def like(value: Tensor, other: AnyArray) -> Any:
    """A tensor as it is, or as an array where ``other`` is one."""
    return value if isinstance(other, Tensor) else value.detach().numpy()


def in_numpy(data: T) -> T:
    """A dataclass, whose fields were checked, with arrays in place of its tensors."""
    return _converted(data, Tensor, lambda x: x.detach().numpy())


def in_torch(data: T) -> T:
    """A dataclass with tensors in place of its arrays."""
    return _converted(data, np.ndarray, torch.from_numpy)


def _converted(data: T, kind: type, convert: Any) -> T:
    fields = {name: convert(x) if isinstance(x, kind) else x for name, x in vars(data).items()}
    return of_fields(type(data), **fields)


def of_fields(of: type[T], **fields: Any) -> T:
    """A dataclass, unchecked: its fields may be arrays in place of tensors."""
    made = object.__new__(of)
    made.__dict__.update(fields)
    return made
