"""What compiled loops are made of: types and options, memory at an address, exp, log, products.

The functions of this module vectorise where they stand in a loop, as those of the C library do not.
"""

from __future__ import annotations

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
INNER = {**COMMON, "no_cpython_wrapper": True}  # called from loops alone
_EXACT = {**INNER, "fastmath": {"contract"}}  # sums in the order in which they stand
A1, A2, A3 = (types.Array(types.float64, n, "C") for n in (1, 2, 3))
I1, I2, F, INT = (
    types.Array(types.int64, 1, "C"),
    types.Array(types.int64, 2, "C"),
    types.float64,
    types.int64,
)
ON = types.boolean[::1]

_TO_INTEGER = 6755399441055744.0  # 1.5 * 2^52: its last bits are those of what was added
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_MANTISSA, _ONE = 0xFFFFFFFFFFFFF, 0x3FF0000000000000  # bits of a double: the last 52, and those of 1.0


made: Any = intrinsic  # which passes the context itself


@made
def _pointer(context, address):
    """An address as a pointer."""

    def generate(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@made
def _as_float(context, bits):
    """The double of these bits."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(types.float64))

    return types.float64(types.int64), generate


@made
def _bits(context, value):
    """The bits of a double."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(types.int64))

    return types.int64(types.float64), generate


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


@njit(F(F), **_EXACT)
def exp(x):
    """e^x to rounding; what would leave the range of doubles stays at its end."""
    x = min(max(x, -708.0), 709.0)
    n = x * 1.4426950408889634 + _TO_INTEGER
    r = (x - (n - _TO_INTEGER) * _LN2_HIGH) - (n - _TO_INTEGER) * _LN2_LOW
    p = 1.0 / 6227020800.0  # Taylor's series up to r^13, |r| <= ln(2)/2
    p = p * r + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return p * _as_float((_bits(n) << 52) + _ONE)


@njit(F(F), **_EXACT)
def log(y):
    """ln y of a normal y > 0: ``y = 2^e m``, ``ln m = 2 artanh((m - 1)/(m + 1))``."""
    bits = _bits(y)
    e = _as_float((bits >> 52) | 0x4330000000000000) - 4503599627371519.0
    m = _as_float((bits & _MANTISSA) | _ONE)
    high = m > 1.4142135623730951
    m, e = (0.5 * m if high else m), (e + 1.0 if high else e)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    p = 1.0 / 21.0
    p = p * q + 1.0 / 19.0
    p = p * q + 1.0 / 17.0
    p = p * q + 1.0 / 15.0
    p = p * q + 1.0 / 13.0
    p = p * q + 1.0 / 11.0
    p = p * q + 1.0 / 9.0
    p = p * q + 1.0 / 7.0
    p = p * q + 0.2
    p = p * q + 1.0 / 3.0
    return e * 0.6931471805599453 + 2.0 * s * (p * q + 1.0)


@njit(F(A1, A1, INT), **INNER)
def dot(a, b, n):
    """Of the first n entries."""
    total = 0.0
    for k in range(n):
        total += a[k] * b[k]
    return total


@njit(types.void(A2, A2, F, A2, types.boolean, types.boolean), **INNER)
def add_products(A, B, a, out, lower, upper):
    """``out += a A B'``, four rows by two at a time: each number that is read serves two to four sums.

    Args:
        lower: only what lies on and below the diagonal (and a little above).
        upper: A is an upper triangle.
    """
    n, m, K = A.shape[0], B.shape[0], A.shape[1]
    for i in range(0, n - n % 4, 4):
        end, k0 = min(m, i + 4) if lower else m, i if upper else 0
        a0, a1, a2, a3 = A[i, k0:], A[i + 1, k0:], A[i + 2, k0:], A[i + 3, k0:]
        for j in range(0, end - end % 2, 2):
            b, c = B[j, k0:], B[j + 1, k0:]
            s0 = s1 = s2 = s3 = t0 = t1 = t2 = t3 = 0.0
            for k in range(K - k0):
                s0 += a0[k] * b[k]
                s1 += a1[k] * b[k]
                s2 += a2[k] * b[k]
                s3 += a3[k] * b[k]
                t0 += a0[k] * c[k]
                t1 += a1[k] * c[k]
                t2 += a2[k] * c[k]
                t3 += a3[k] * c[k]
            out[i, j] += a * s0
            out[i + 1, j] += a * s1
            out[i + 2, j] += a * s2
            out[i + 3, j] += a * s3
            out[i, j + 1] += a * t0
            out[i + 1, j + 1] += a * t1
            out[i + 2, j + 1] += a * t2
            out[i + 3, j + 1] += a * t3
        for j in range(end - end % 2, end):
            for r in range(i, i + 4):
                out[r, j] += a * dot(A[r], B[j], K)
    for i in range(n - n % 4, n):
        for j in range(min(m, i + 1) if lower else m):
            out[i, j] += a * dot(A[i], B[j], K)


@njit(A2(A2), **INNER)
def transposed(A):
    """A', in memory of its own."""
    out = np.empty((A.shape[1], A.shape[0]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[j, i] = A[i, j]
    return out
