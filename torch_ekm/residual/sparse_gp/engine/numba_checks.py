"""Checks of samples and of caches as compiled loops, see the module ``numba_kernels``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .numba_kernels import _A1, _A2, _A3, _A4, _COMMON, _F, _HYPER, _I1, _TINY, _kernel, _times


@njit(_F(_I1, _A3, _A2, _A4, _A4, *_HYPER, _A2, _F), **_COMMON)
def drift_fleet(
    flags, basis, active, moments, vectors, log_lengthscale, log_variance, log_action, log_noise, jitter
):  # fmt: skip
    """The largest of all models, see ``SparsePosterior.drift``."""
    B, M, m, largest = basis.shape[0], basis.shape[1], vectors.shape[3], 0.0
    K, none, row, alpha, h = np.zeros((M, M)), np.empty((0, 0)), np.empty(M), np.empty(M), np.empty(M)
    f, missing, moved, again = np.empty(M), np.empty(M), np.empty(M), np.empty(M)
    for b in range(B):
        own, point = min(b, log_variance.shape[0] - 1), 0
        log_s2, C, Q, W = 0.0, moments[b, 0], moments[b, 1], moments[b, 2]
        for o in range(m):
            log_s2 += log_noise[b, o]
        s2 = math.exp(log_s2 / m)
        for i in range(M):
            alpha[i] = h[i] = 0.0
            for o in range(m):
                alpha[i] += vectors[b, 0, i, o]
                h[i] += vectors[b, 1, i, o]
            if Q[i, i] > Q[point, point]:
                point = i
            K[i, :] = 0.0
            K[i, i] = 1.0
            if active[b, i] == 0.0:
                continue
            # points up to this one: the matrix is symmetric
            K[i, i] = (1.0 + jitter) * _kernel(
                flags, basis[b, i], basis[b, :i], active[b, :i], log_lengthscale[own], log_variance[own],
                log_action[own], row[:i], none, False,
            )  # fmt: skip
            K[i, :i] = row[:i]
        for i in range(M):
            for j in range(i):
                K[j, i] = K[i, j]
        _times(K, alpha, f)
        _times(W, f, missing)
        for i in range(M):
            missing[i] = (h[i] - missing[i]) / s2 - alpha[i]
        _times(K, missing, moved)
        _times(C, moved, again)
        for i in range(M):
            missing[i] += again[i]
        _times(K, missing, moved)
        _times(Q, K[point], again)
        wrong, most, inverse = 0.0, _TINY, 0.0
        for i in range(M):
            wrong, most = max(wrong, abs(moved[i])), max(most, abs(f[i]))
            unit = 1.0 if i == point else 0.0
            inverse = max(inverse, abs(again[i] - unit) * active[b, i])
        # a NaN must not pass for a small drift
        if not (wrong / most <= largest and inverse <= largest):
            largest = max(wrong / most, inverse) if wrong + inverse < np.inf else np.inf
    return largest


@njit(types.boolean(_A1, _A1), **_COMMON)
def have_squares(x, y):
    """Whether all squares are finite. (``isfinite`` is x - x == x - x, which reassociation may call true.)"""
    total = 0.0
    for value in x:
        total += value * value
    for value in y:
        total += value * value
    return total < np.inf
