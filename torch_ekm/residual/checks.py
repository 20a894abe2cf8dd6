"""Checks of arguments that all learners share."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ..exceptions import NonFiniteError, ParameterError
from ..typing import Tensor


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
    """``values`` as positive ints, or ParameterError."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ParameterError(name, values, "a tuple of positive integers")
    return tuple(check_count(name, value) for value in values)


def check_positive(name: str, value: float) -> float:
    """``value`` as a positive finite float, or ParameterError."""
    try:
        good = math.isfinite(value) and value > 0
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ParameterError(name, value, "positive and finite")
    return float(value)


def check_factor(name: str, value: float) -> float:
    """``value`` as a float in (0, 1], or ParameterError."""
    if not 0 < value <= 1:
        raise ParameterError(name, value, "in (0, 1]")
    return float(value)


def check_finite(name: str, value: Tensor) -> None:
    """NonFiniteError, with the first places, if a square in ``value`` is not finite."""
    where = (~value.square().isfinite()).nonzero()
    if len(where):
        raise NonFiniteError(name, [tuple(place) for place in where[:5].tolist()])
