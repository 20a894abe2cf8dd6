"""What compiled loops are made of: types, options, and memory at an address."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import carray, njit, types
from numba.extending import intrinsic

EPS, TINY = np.finfo(np.float64).eps, np.finfo(np.float64).tiny
# NaN and infinity keep their meaning: samples are tested for them in compiled loops
COMMON = {
    "cache": True, "nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
}  # fmt: skip
A1, A2, A3 = (types.Array(types.float64, n, "C") for n in (1, 2, 3))
I1, I2 = types.Array(types.int64, 1, "C"), types.Array(types.int64, 2, "C")
F, INT, ON = types.float64, types.int64, types.boolean[::1]


def inner(signature: Any, **options: Any) -> Callable[[Callable], Any]:
    """A loop that loops alone call: it is compiled, or found again, when a caller is compiled.

    A caller that is found again has its code: to load it, too, takes a quarter of all loading.
    """
    options = {**COMMON, "no_cpython_wrapper": True, **options}

    def decorate(function: Callable) -> Any:
        loop: Any = njit(**options)(function)
        template = loop.get_call_template

        def called(*types: Any) -> Any:
            if not loop.signatures:
                loop.compile(signature)
                loop.disable_compile()
            return template(*types)

        loop.get_call_template = called
        return loop

    return decorate


made: Any = intrinsic  # which passes the context itself


@made
def _pointer(context, address):
    """An address as a pointer."""

    def generate(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@njit(inline="always")
def vector_at(address, b, n):
    """The b-th n doubles at an address."""
    return carray(_pointer(address + 8 * b * n), (n,), np.float64)


@njit(inline="always")
def matrix_at(address, b, n, m):
    """The b-th matrix ``(n, m)`` of doubles at an address."""
    return carray(_pointer(address + 8 * b * n * m), (n, m), np.float64)


@njit(inline="always")
def stack_at(address, b, r, n, m):
    """The b-th r matrices."""
    return carray(_pointer(address + 8 * b * r * n * m), (r, n, m), np.float64)


@njit(inline="always")
def integers_at(address, b, n):
    """The b-th n integers at an address."""
    return carray(_pointer(address + 8 * b * n), (n,), np.int64)
