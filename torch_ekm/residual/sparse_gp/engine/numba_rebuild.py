"""The caches of a sparse GP from its natural form as compiled loops.

Equations and names are those of :func:`~torch_ekm.residual.sparse_gp.posterior.posterior_from_natural` and
:class:`~torch_ekm.residual.ProcessNoise`, which stay the reference.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .. import plan as P
from .numba_core import shared_noise
from .numba_kernels import kernel_rows
from .numba_math import add_products, dot, transposed
from .numba_memory import A1, A2, COMMON, EPS, I1, INT, F, inner, matrix_at, stack_at, vector_at


@inner(types.void(A2))
def _mirror(A):
    """The lower half is the upper one, too."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[j, i] = A[i, j]


@inner(types.void(A2))
def _factorise(A):
    """A's lower half becomes L, ``A = LL'``, the upper one 0; what rounding leaves no root of stays tiny."""
    n = A.shape[0]
    for i in range(0, n, 4):  # four rows at a time: each entry waits for the one before
        rows = min(4, n - i)
        r0, r1, r2, r3 = A[i], A[min(i + 1, n - 1)], A[min(i + 2, n - 1)], A[min(i + 3, n - 1)]
        for j in range(i if rows == 4 else 0):
            other, s0, s1, s2, s3 = A[j], 0.0, 0.0, 0.0, 0.0
            for k in range(j):
                s0 += r0[k] * other[k]
                s1 += r1[k] * other[k]
                s2 += r2[k] * other[k]
                s3 += r3[k] * other[k]
            by = 1.0 / other[j]
            r0[j], r1[j] = (r0[j] - s0) * by, (r1[j] - s1) * by
            r2[j], r3[j] = (r2[j] - s2) * by, (r3[j] - s3) * by
        for r in range(i, i + rows):
            row, least = A[r], EPS * abs(A[r, r])
            for j in range(i if rows == 4 else 0, r):
                row[j] = (row[j] - dot(row, A[j], j)) / A[j, j]
            row[r] = math.sqrt(max(row[r] - dot(row, row, r), least, 1e-300))
            for j in range(r + 1, n):
                row[j] = 0.0


@inner(types.void(A2, A2, types.boolean))
def _solve(L, B, lower):
    """B becomes ``L^-1 B``; ``lower``: B is a lower triangle."""
    m = B.shape[1]
    for i in range(L.shape[0]):
        row, k, end = B[i], 0, i + 1 if lower else m
        for k in range(0, i - 3, 4):
            a, b, c, d = L[i, k], L[i, k + 1], L[i, k + 2], L[i, k + 3]
            r, s, t, u = B[k], B[k + 1], B[k + 2], B[k + 3]
            for j in range(min(k + 4, end) if lower else m):
                row[j] -= a * r[j] + b * s[j] + c * t[j] + d * u[j]
        for k in range(i - i % 4, i):
            a, r = L[i, k], B[k]
            for j in range(k + 1 if lower else m):
                row[j] -= a * r[j]
        by = 1.0 / L[i, i]
        for j in range(end):
            row[j] *= by


@inner(A2(I1, INT, A2, A1))
def _gram(p, b, embedded, active):
    """K between the points in use, embedded, with the jitter; 1 on the diagonal of free slots."""
    M, jitter = active.shape[0], 1.0 + vector_at(p[P.FIGURES], 0, 3)[1]
    K, psi, phi, diagonal = np.empty((M, M)), np.empty((M, M)), np.empty((M, M)), np.empty(M)
    kernel_rows(p, b, embedded, embedded, active, K, psi, phi, diagonal)
    for i in range(M):
        for j in range(M):
            K[i, j] *= active[i]
        K[i, i] = diagonal[i] * jitter if active[i] else 1.0
    return K


@inner(types.void(A2, A2, A2, A2, A2, F, F))
def _wander(Lt, LW, LWL, precision, information, kept, s2):
    """See :class:`~torch_ekm.residual.ProcessNoise`; ``LW``: L'W, is overwritten."""
    M, m, lost = Lt.shape[0], information.shape[1], 1.0 - kept
    R, h = lost * LWL, np.zeros((M, m))
    for i in range(M):
        R[i, i] += 1.0
    add_products(Lt, transposed(information), 1.0, h, False, True)
    _factorise(R)
    _solve(R, LW, False)
    _solve(R, h, False)
    Gt = transposed(LW)
    add_products(Gt, Gt, -lost * s2, precision, True, False)
    for i in range(M):
        for j in range(i + 1):
            precision[i, j] *= kept
        for o in range(m):
            information[i, o] *= math.sqrt(kept)
    _mirror(precision)
    add_products(Gt, transposed(h), -lost * math.sqrt(kept), information, False, False)


@njit(types.void(I1, F), **COMMON)
def rebuild_fleet(p, share):
    """alpha, C and Q of each model from its natural form; their bases are embedded.

    Args:
        share: of ProcessNoise, by which the natural form changes, too; 0: it does not. Mean and covariance
            of g become ``sqrt(kept)`` and ``kept`` times theirs, but for the prior's, and so do their caches.
    """
    M, m, W = p[P.SLOTS], p[P.OUT], p[P.WIDTH]
    for b in range(p[P.MODELS]):
        active, s2 = vector_at(p[P.ACTIVE], b, M), shared_noise(p, b)
        moments, vectors = stack_at(p[P.MOMENTS], b, 3, M, M), stack_at(p[P.VECTORS], b, 2, M, m)
        L = _gram(p, b, matrix_at(p[P.EMBEDDED], b, M, W), active)
        _factorise(L)
        Lt, A, LW = transposed(L), np.zeros((M, M)), np.zeros((M, M))
        add_products(Lt, moments[2], 1.0 / s2, LW, False, True)
        add_products(Lt, LW, 1.0, A, True, True)
        inverse, right = np.zeros((M, M)), np.zeros((M, m))
        kept = (1.0 - share) ** vector_at(p[P.PENDING], b, 1)[0]
        add_products(Lt, transposed(vectors[1]), math.sqrt(kept) / s2, right, False, True)
        if share > 0.0:
            _wander(Lt, LW, A, moments[2], vectors[1], kept, s2)
        for i in range(M):
            A[i, i] += 1.0
            inverse[i, i] = 1.0
        _factorise(A)
        _solve(L, inverse, True)
        inverse_t, alpha, C, Q = transposed(inverse), vectors[0], moments[0], moments[1]
        _solve(A, inverse, True)  # G
        _solve(A, right, False)
        Gt = transposed(inverse)
        alpha[:, :] = C[:, :] = Q[:, :] = 0.0
        add_products(inverse_t, inverse_t, 1.0, Q, True, True)
        add_products(Gt, Gt, 1.0, C, True, True)
        for i in range(M):
            for j in range(i + 1):
                C[i, j] = kept * (C[i, j] - Q[i, j])
                Q[i, j] *= active[i] * active[j]
        add_products(Gt, transposed(right), 1.0, alpha, False, True)
        _mirror(Q)
        _mirror(C)
