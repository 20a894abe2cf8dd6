"""Whatever holds numbers, as tensors of one precision."""

from __future__ import annotations

import functools

import torch

from ..exceptions import NonFiniteError, ParameterError
from ..typing import Tensor


def as_tensors(**values: object) -> list[Tensor]:
    """Tensors, arrays and nested lists as floating-point tensors of one dtype, without a copy where possible.

    The dtype is the widest of theirs, where lists and integers count as float64.

    Raises:
        ParameterError: something is not made of numbers.
    """
    kinds = [value.dtype if isinstance(value, Tensor) else None for value in values.values()]
    if kinds[0] is not None and kinds.count(kinds[0]) == len(kinds) and kinds[0].is_floating_point:
        return list(values.values())  # type: ignore[arg-type]
    try:
        given = [torch.as_tensor(v).dtype if hasattr(v, "dtype") else torch.float64 for v in values.values()]
        wide = [dtype if dtype.is_floating_point else torch.float64 for dtype in given]
        dtype = functools.reduce(torch.promote_types, wide)
        return [torch.as_tensor(value, dtype=dtype) for value in values.values()]
    except (TypeError, ValueError, RuntimeError) as error:
        valid = f"numbers, in a tensor, an array or nested lists ({error})"
        raise ParameterError(", ".join(values), tuple(values.values()), valid) from None


def check_finite(name: str, value: Tensor) -> None:
    """No entry is NaN or infinite.

    Raises:
        NonFiniteError: with the first places of those that are.
    """
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        raise NonFiniteError(name, torch.nonzero(~finite)[:3].tolist())
