"""exp, log and products in compiled loops.

They vectorise where they stand in a loop, as those of the C library do not.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from .numba_memory import A1, A2, INT, F, inner

_EXACT = {"contract"}  # sums in the order in which they stand
_TO_INTEGER = 6755399441055744.0  # 1.5 * 2^52: its last bits are those of what was added
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_MANTISSA, _ONE = 0xFFFFFFFFFFFFF, 0x3FF0000000000000  # bits of a double: the last 52, and those of 1.0
# Taylor's series, the last term first: e^r up to r^13, artanh(s)/s without the 1 up to s^20
_OF_EXP = tuple(1.0 / math.factorial(n) for n in range(13, -1, -1))
_OF_LOG = tuple(1.0 / n for n in range(21, 2, -2))


@inner(F(F), fastmath=_EXACT)
def exp(x):
    """e^x to rounding; what would leave the range of doubles stays at its end."""
    x = min(max(x, -708.0), 709.0)
    n = x * 1.4426950408889634 + _TO_INTEGER
    r = (x - (n - _TO_INTEGER) * _LN2_HIGH) - (n - _TO_INTEGER) * _LN2_LOW
    p = 0.0
    for a in _OF_EXP:  # |r| <= ln(2)/2
        p = p * r + a
    return p * np.int64((np.float64(n).view(np.int64) << 52) + _ONE).view(np.float64)


@inner(F(F), fastmath=_EXACT)
def log(y):
    """ln y of a normal y > 0: ``y = 2^e m``, ``ln m = 2 artanh((m - 1)/(m + 1))``."""
    bits = np.float64(y).view(np.int64)
    e = np.int64((bits >> 52) | 0x4330000000000000).view(np.float64) - 4503599627371519.0
    m = np.int64((bits & _MANTISSA) | _ONE).view(np.float64)
    high = m > 1.4142135623730951
    m, e = (0.5 * m if high else m), (e + 1.0 if high else e)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    p = 0.0
    for a in _OF_LOG:
        p = p * q + a
    return e * 0.6931471805599453 + 2.0 * s * (p * q + 1.0)


@inner(F(A1, A1, INT))
def dot(a, b, n):
    """Of the first n entries."""
    total = 0.0
    for k in range(n):
        total += a[k] * b[k]
    return total


@inner(types.void(A2, A2, F, A2, types.boolean, types.boolean))
def add_products(A, B, a, out, lower, upper):
    """``out += a A B'``, four rows by two at a time: each number that is read serves two to four sums.

    What a row of ``out`` gains is the same to the last bit whatever other rows there are.

    Args:
        lower: only what lies on and below the diagonal (and a little above).
        upper: A is an upper triangle.
    """
    n, m, K = A.shape[0], B.shape[0], A.shape[1]
    for i in range(0, n, 4):
        rows, end, k0 = min(4, n - i), min(m, i + 4) if lower else m, i if upper else 0
        a0, a1 = A[i, k0:], A[min(i + 1, n - 1), k0:]
        a2, a3 = A[min(i + 2, n - 1), k0:], A[min(i + 3, n - 1), k0:]
        for j in range(0, end, 2):
            b, c = B[j, k0:], B[min(j + 1, m - 1), k0:]
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
            for r, (s, t) in enumerate(((s0, t0), (s1, t1), (s2, t2), (s3, t3))):
                if r < rows:
                    out[i + r, j] += a * s
                    if j + 1 < end:
                        out[i + r, j + 1] += a * t


@inner(A2(A2))
def transposed(A):
    """A', in memory of its own."""
    out = np.empty((A.shape[1], A.shape[0]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[j, i] = A[i, j]
    return out
