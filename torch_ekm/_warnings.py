"""Warnings that show the user's line."""

from __future__ import annotations

import sys
import warnings

_PASSED = ("torch_ekm", "torch", "jaxtyping", "beartype")


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Name the line that led here: the first outside this package, torch and type checks."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _PASSED:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
