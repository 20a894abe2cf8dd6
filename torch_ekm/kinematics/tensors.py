"""Tensors of any input, and the null space of a matrix."""

from __future__ import annotations

import functools
from typing import Any

import torch

from .._arrays import namespace
from ..exceptions import ParameterError
from ..typing import AnyArray, Float, Tensor


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
