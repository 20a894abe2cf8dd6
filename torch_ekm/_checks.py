"""Checks of arguments: each raises a typed error that names the argument and says what would be right."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from .exceptions import NonFiniteError, ParameterError, ShapeError
from .typing import Tensor

T = TypeVar("T")


def check_kind(name: str, value: object, kind: type[T], valid: str = "") -> T:
    """``value``, or ParameterError if it is no ``kind``."""
    if not isinstance(value, kind):
        raise ParameterError(name, value, valid or f"a {kind.__name__}")
    return value


def check_count(name: str, value: int, least: int = 1) -> int:
    """``value`` as an int of at least ``least``, or ParameterError."""
    try:
        good = not isinstance(value, bool) and int(value) == value and value >= least
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ParameterError(name, value, f"an integer of at least {least}")
    return int(value)


def check_counts(name: str, values: Iterable[int]) -> tuple[int, ...]:
    """``values`` as a tuple of positive ints, or ParameterError."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ParameterError(name, values, "a tuple of positive integers")
    return tuple(check_count(name, value) for value in values)


def check_positive(name: str, value: float) -> float:
    """``value`` as a positive finite float, or ParameterError."""
    return _checked(name, value, lambda x: math.isfinite(x) and x > 0, "positive and finite")


def check_sizes(name: str, values: float | Sequence[float] | Tensor, n: int) -> list[float]:
    """n finite floats of 0 or more, of one or of n; or ParameterError."""
    valid = f"one number or {n}, finite and not negative"
    try:
        found = [float(value) for value in (values if isinstance(values, Iterable) else [values] * n)]
    except (TypeError, ValueError):
        raise ParameterError(name, values, valid) from None
    if len(found) != n or not all(math.isfinite(value) and value >= 0 for value in found):
        raise ParameterError(name, values, valid)
    return found


def check_fraction(name: str, value: float) -> float:
    """``value`` as a float in (0, 1], or ParameterError."""
    return _checked(name, value, lambda x: 0 < x <= 1, "in (0, 1]")


def check_share(name: str, value: float) -> float:
    """``value`` as a float in (0, 1), or ParameterError."""
    return _checked(name, value, lambda x: 0 < x < 1, "in (0, 1)")


def _checked(name: str, value: float, good: Callable[[float], bool], valid: str) -> float:
    try:
        if good(value):
            return float(value)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ParameterError(name, value, valid)


def check_shape(name: str, value: Tensor, shape: Sequence[int], hint: str = "") -> None:
    """ShapeError, with the hint, if ``value`` has any other shape, ParameterError if it is no tensor."""
    check_kind(name, value, Tensor, "a tensor: torch.as_tensor(...)")
    if tuple(value.shape) != tuple(shape):
        raise ShapeError(name, str(tuple(shape)), value.shape, hint)


def check_last(name: str, value: Any, n: int, hint: str = "") -> None:
    """ShapeError, with the hint, unless ``value`` is ``(*batch, n)``."""
    if tuple(value.shape[-1:]) != (n,):
        raise ShapeError(name, f"(*batch, {n})", value.shape, hint)


def check_finite(name: str, value: Tensor) -> None:
    """NonFiniteError, with the first places, if an entry of ``value`` or its square is NaN or infinite."""
    if math.isfinite(value.detach().square().sum()):
        return
    good = value.square().isfinite()
    if not bool(good.all()):
        raise NonFiniteError(name, [tuple(place) for place in (~good).nonzero()[:5].tolist()])
