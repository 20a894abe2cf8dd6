"""One code for tensors and numpy arrays, and tensors of any input.

Equations are written in what ``torch`` and ``numpy`` share (:func:`namespace`). Tensors carry batches and
derivatives. One state without a derivative is computed in arrays, in which a small operation costs a third:
:func:`in_numpy` and :func:`in_torch` convert, without a copy.
"""

from __future__ import annotations

import functools
from typing import Any, TypeVar

import numpy as np
import torch
from torch.autograd.forward_ad import unpack_dual

from .exceptions import ParameterError
from .typing import AnyArray, Float, Tensor

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


def as_tensors(**values: object) -> list[Tensor]:
    """Tensors, arrays and nested lists as floating-point tensors of one dtype, without a copy where possible.

    The dtype is the widest of theirs, where lists and integers count as float64.

    Raises:
        ParameterError: something is not made of numbers.
    """
    tensors = [value for value in values.values() if isinstance(value, Tensor)]
    dtypes = {value.dtype for value in tensors}
    dense = all(value.layout is torch.strided for value in tensors)
    if dense and len(tensors) == len(values) and len(dtypes) == 1 and dtypes.pop().is_floating_point:
        return tensors
    try:
        given = [torch.as_tensor(v).dtype if hasattr(v, "dtype") else torch.float64 for v in values.values()]
        if any(dtype.is_complex for dtype in given) or not dense:
            raise TypeError("real, and not sparse")
        wide = [dtype if dtype.is_floating_point else torch.float64 for dtype in given]
        dtype = functools.reduce(torch.promote_types, wide)
        return [torch.as_tensor(value, dtype=dtype) for value in values.values()]
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        valid = f"numbers, in a tensor, an array or nested lists ({error})"
        raise ParameterError(", ".join(values), tuple(values.values()), valid) from None


def null_space(rows: Float[AnyArray, "m n"]) -> Float[Any, "n n_free"]:
    """Orthonormal basis N of ``rows N = 0`` (SVD); all of space where there are no rows.

    Args:
        rows: constraints whose entries compare with 1: angles, or lengths divided by a typical one. Singular
            values up to 1e-9 count as 0.
    """
    _, sigma, Vh = namespace(rows).linalg.svd(rows, full_matrices=True)
    return Vh[int((sigma > 1e-9).sum()) :].mT
