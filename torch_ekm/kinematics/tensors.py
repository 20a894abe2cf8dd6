"""Whatever holds numbers, as tensors of one precision."""

from __future__ import annotations

import functools

import torch

from ..exceptions import ParameterError
from ..typing import Tensor


def as_tensors(**values: object) -> list[Tensor]:
    """Tensors, arrays and nested lists as floating-point tensors of one dtype, without a copy where possible.

    The dtype is the widest of those that come with one, float64 if none does: lists and integers follow.

    Raises:
        ParameterError: something is not made of numbers.
    """
    kinds = [value.dtype if isinstance(value, Tensor) else None for value in values.values()]
    if kinds[0] is not None and kinds.count(kinds[0]) == len(kinds) and kinds[0].is_floating_point:
        return list(values.values())  # type: ignore[arg-type]
    try:
        given = [torch.as_tensor(value).dtype for value in values.values() if hasattr(value, "dtype")]
        wide = [dtype for dtype in given if dtype.is_floating_point]
        dtype = functools.reduce(torch.promote_types, wide) if wide else torch.float64
        return [torch.as_tensor(value, dtype=dtype) for value in values.values()]
    except (TypeError, ValueError, RuntimeError) as error:
        valid = f"numbers, in a tensor, an array or nested lists ({error})"
        raise ParameterError(", ".join(values), tuple(values.values()), valid) from None
