"""A step on the lagged prequential loss as compiled loops.

Equations and names are those of :class:`~torch_ekm.residual.LearnHyperparameters` and its
:class:`~torch_ekm.residual.sparse_gp.hyperparameters.PrequentialLoss`, which torch differentiates itself.
Here, with ``E = Ck``, ``F = Qk`` and the loss' derivatives ``g`` by mean, variance ``v = k** + k'Ck``,
``p = u + k'Ck`` and u of each query::

    by K:  E (g_mean alpha' + diag(g_v + g_p) E') - F diag(g_p + g_u) F'
    by k:  alpha g_mean' + 2 E diag(g_v + g_p) + 2 F diag(g_p + g_u)
    by ln s2:  -sum g_mean (mean + E'K alpha) - sum (g_v + g_p) diag(k'E + E'KE)

A row stands for a sample: what the loss wants by column is transposed first, since products of rows are the
fastest. ``n``, ``n_rebuilt`` and ``n_taken`` are numbers of samples, of those that the past state has seen,
and of turns through the memory.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .. import plan as P
from ..hyperparameters import BETAS, LEAST, LEAST_NOISE, MOST, NETWORK_DECAY, NETWORK_RATE
from .numba_core import shared_noise
from .numba_kernels import embed, kernel_rows, network_back
from .numba_math import add_products, dot, transposed
from .numba_memory import (
    A1,
    A2,
    COMMON,
    EPS,
    I1,
    INT,
    TINY,
    F,
    inner,
    integers_at,
    matrix_at,
    stack_at,
    vector_at,
)

#: of the queries so far: derivatives by K through E and through F, by alpha, by basis points; by all
#: parameters; by ln s2, and weight of all and of those that the past state has not seen
SUMS = types.Tuple((A2, A2, A2, A2, A1, A1))


@inner(SUMS(I1, INT))
def _sums(p, b):
    """Memory of them."""
    M, W, m, n = p[P.SLOTS], p[P.WIDTH], p[P.OUT], integers_at(p[P.LEARNING], 0, 4)[3]
    at = p[P.SUMS] + 8 * b * (M * (2 * M + m + W) + n + 3)
    by_alpha = at + 16 * M * M
    back, gradient = by_alpha + 8 * M * m, by_alpha + 8 * M * (m + W)
    return (
        matrix_at(at, 0, M, M), matrix_at(at, 1, M, M), matrix_at(by_alpha, 0, M, m),
        matrix_at(back, 0, M, W), vector_at(gradient, 0, n), vector_at(gradient + 8 * n, 0, 3),
    )  # fmt: skip


@inner(INT(I1, INT, INT, INT, INT, A2, A2, A2))
def _draw(p, b, n, n_rebuilt, n_taken, values, y, about):
    """Queries in units, see ``LearnHyperparameters.queries``; returns their number.

    Those that the past state has not seen come last: the first part of a step may begin before there is the
    last of them. ``about``: of each its weight, and its age if the past state has seen it, else 0.
    """
    d, m, size = p[P.IN], p[P.OUT], p[P.RECENT_SIZE]
    learning = integers_at(p[P.LEARNING], 0, 2)
    new, k = min(max(n - n_rebuilt, 0), learning[0]), learning[1]
    kept = min(n, size)
    stride = max(kept // k, 1) if k > 0 else 1
    first = n_taken % stride
    x_of, y_of = matrix_at(p[P.RECENT_X], b, size, d), matrix_at(p[P.RECENT_Y], b, size, m)
    weight_of = vector_at(p[P.RECENT], b, size)
    shift, scale = vector_at(p[P.SHIFT], b, d), vector_at(p[P.SCALE], b, d)
    reach = vector_at(p[P.REACH], 0, d)
    shift_y, scale_y = vector_at(p[P.SHIFT_Y], b, m), vector_at(p[P.SCALE_Y], b, m)
    q = 0
    for i in range(k + new):
        place = first + stride * i if i < k else (n - new + i - k) % size
        if place >= kept and i < k:
            continue
        age = (n - 1 - place) % size + 1 if i < k else 0
        about[q, 1] = age
        about[q, 0] = weight_of[place] if i >= k or n - n_rebuilt < age < size else 0.0
        for j in range(d):
            z = (x_of[place, j] - shift[j]) / scale[j]
            values[q, j] = min(max(z, -reach[j]), reach[j])
        for o in range(m):
            y[q, o] = (y_of[place, o] - shift_y[o]) / scale_y[o]
        q += 1
    return q


@inner(types.void(I1, INT, A2, A2, A1, A2, A2, A2, A1, A2))
def _density(p, b, mean, y, diagonal, kE_u, about, by_mean, by_log_noise, by):
    """Derivatives of the loss times all weights, see ``PrequentialLoss._density``.

    ``by``: those by variance, p and u of each query.
    """
    n, m, s2 = mean.shape[0], mean.shape[1], shared_noise(p, b)
    log_noise, figures = vector_at(p[P.LOG_NOISE], b, m), vector_at(p[P.RATES], 0, 3)
    robust, factor = figures[1], figures[2]
    for q in range(n):
        kE, u = kE_u[q, 0], kE_u[q, 1]
        v, p_ = diagonal[q] + kE, u + kE
        held = about[q, 0] * factor ** about[q, 1] / s2 if about[q, 1] > 0.0 else 0.0
        exact, least = 1.0 / max(1.0 - held * p_, EPS), max(p_, TINY)
        most = max(u / least, 1.0)
        bounded = exact > most
        c = most if bounded else exact
        left, each, by_left, by_c = v + p_ * (c - 1.0), 0.5 / m * about[q, 0], 0.0, 0.0
        for o in range(m):
            noise, residual = math.exp(log_noise[o]), y[q, o] - mean[q, o]
            variance = max(left, 0.0) + noise
            z2 = (residual * c) ** 2 / variance
            by_z2 = each * (robust + 1.0) / (robust + z2) if robust > 0.0 else each
            pull = 2.0 * by_z2 * residual * c / variance
            by_variance = (each - by_z2 * z2) / variance
            by_left += by_variance
            by_c += pull * residual
            by_mean[q, o] = -pull * c
            by_log_noise[o] += by_variance * noise
        by_left = by_left if left >= 0.0 else 0.0
        by_c += by_left * p_
        by_exact = 0.0 if bounded else by_c * exact * exact * held
        by_most = by_c / least if bounded and u >= least else 0.0
        for o in range(m):
            by_log_noise[o] -= by_exact * p_ / m
        by[q, 0], by[q, 2] = by_left, by_most
        by[q, 1] = by_left * (c - 1.0) + by_exact - by_most * most


@inner(types.void(I1, INT, A2, A1, A2, A1, A2, A2, A2, A2, A2, A2, types.boolean))
def _pull_back(p, b, by, by_diagonal, k, diagonal, psi, phi, values, q, basis, back, of_basis):
    """What follows of derivatives by k for the kernel's parameters.

    Args:
        by, by_diagonal: by ``k(x_i, z_j)`` of points i with the basis, and by ``k(x_i, x_i)``.
        k, diagonal, psi, phi: of the points, see ``kernel_rows``.
        values, q: points in units, with all layers of a network; and embedded.
        back: derivatives by the basis points, which other points add to.
        of_basis: whether the points are these: a pair of them counts for both.
    """
    N, M, W, n_a = k.shape[0], p[P.SLOTS], p[P.WIDTH], p[P.ACTIONS]
    d, n_s, gradient = p[P.IN], p[P.IN] - n_a, _sums(p, b)[4]
    log_action = vector_at(p[P.LOG_ACTION], b, n_a)
    variance = math.exp(vector_at(p[P.LOG_VARIANCE], b, 1)[0])
    for i in range(N):
        gradient[d] += by_diagonal[i] * diagonal[i] + dot(by[i], k[i], M)
    for j in range(n_a):
        total, column = 0.0, n_s + j
        for i in range(N):
            inner = 0.0
            for r in range(M):
                inner += by[i, r] * phi[i, r] * basis[r, column]
            total += q[i, column] * (inner + by_diagonal[i] * variance * q[i, column])
        gradient[column] += total * math.exp(log_action[j])
    if n_s == 0:
        return
    # the kernel depends on differences alone: about one of the points squares are of their size
    a, c_t, weights, sums = np.empty((N, W)), np.empty((W, M)), np.empty((N, M)), np.zeros(N)
    for i in range(N):
        for j in range(W):
            a[i, j] = q[i, j] - basis[0, j]
        for j in range(M):
            weights[i, j] = by[i, j] * psi[i, j]
            sums[i] += weights[i, j]
    for j in range(W):
        for i in range(M):
            c_t[j, i] = basis[i, j] - basis[0, j]
    pulled = np.zeros((N, W))
    add_products(weights, c_t, 1.0, pulled, False, False)
    for i in range(N):
        for j in range(W):
            pulled[i, j] -= sums[i] * a[i, j]
    if of_basis:
        for i in range(N):
            for j in range(W):
                pulled[i, j] = 2.0 * pulled[i, j] + back[i, j]
    else:
        later = transposed(weights)
        add_products(later, transposed(a), 1.0, back, False, False)
        for i in range(M):
            total = 0.0
            for r in range(N):
                total += later[i, r]
            for j in range(W):
                back[i, j] -= total * c_t[j, i]
    for i in range(N):
        for j in range(n_s):
            gradient[j] -= pulled[i, j] * a[i, j]
    if d < W:
        features = np.empty((N, W - d))
        for i in range(N):
            for j in range(W - d):
                features[i, j] = pulled[i, d + j]
        network_back(p, b, values, features, np.empty((0, 0)), gradient)


@njit(types.void(I1, INT, INT, INT, F, F), **COMMON)
def gather_fleet(p, n, n_rebuilt, n_taken, begin, end):
    """A part of a step: what the past states, whose basis is embedded, say of the queries, into the sums.

    ``begin``, ``end``: of the queries, as shares of all.
    """
    d, m, M, W, learning = p[P.IN], p[P.OUT], p[P.SLOTS], p[P.WIDTH], integers_at(p[P.LEARNING], 0, 4)
    most = learning[0] + learning[1]
    x, y_, about_ = np.empty((most, d)), np.empty((most, m)), np.empty((most, 2))
    for b in range(p[P.MODELS]):
        by_K, less, by_alpha, back, gradient, rest = _sums(p, b)
        if begin == 0.0:
            by_K[:, :] = less[:, :] = by_alpha[:, :] = back[:, :] = 0.0
            gradient[:] = rest[:] = 0.0
        found = _draw(p, b, n, n_rebuilt, n_taken, x, y_, about_)
        first, last = int(begin * found), int(end * found)
        y, about, N = y_[first:last], about_[first:last], last - first
        active, basis = vector_at(p[P.ACTIVE], b, M), matrix_at(p[P.EMBEDDED], b, M, W)
        moments, alpha = stack_at(p[P.MOMENTS], b, 3, M, M), matrix_at(p[P.VECTORS], 2 * b, M, m)
        values, q = np.empty((N, p[P.VALUES])), np.empty((N, W))
        for i in range(N):
            for j in range(d):
                values[i, j] = x[first + i, j]
        embed(p, b, values, q)
        k, psi, phi, diagonal = np.empty((N, M)), np.empty((N, M)), np.empty((N, M)), np.empty(N)
        kernel_rows(p, b, q, basis, active, k, psi, phi, diagonal)
        E, F_, mean = np.zeros((N, M)), np.zeros((N, M)), np.zeros((N, m))
        add_products(k, moments[0], 1.0, E, False, False)
        add_products(k, moments[1], 1.0, F_, False, False)
        add_products(k, transposed(alpha), 1.0, mean, False, False)
        kE_u, by_mean, by_q = np.empty((N, 2)), np.empty((N, m)), np.empty((N, 3))
        for i in range(N):
            kE_u[i, 0], kE_u[i, 1] = dot(k[i], E[i], M), dot(k[i], F_[i], M)
        _density(p, b, mean, y, diagonal, kE_u, about, by_mean, gradient[gradient.shape[0] - m :], by_q)
        by, by_diagonal, by_E, by_F = np.zeros((N, M)), np.empty(N), np.empty((N, M)), np.empty((N, M))
        add_products(by_mean, alpha, 1.0, by, False, False)
        for i in range(N):
            rest[1] += about[i, 0]
            rest[2] += about[i, 0] if about[i, 1] == 0.0 else 0.0
            g_E, g_F = by_q[i, 0] + by_q[i, 1], by_q[i, 1] + by_q[i, 2]
            by_diagonal[i] = by_q[i, 0]
            for j in range(M):
                by_E[i, j] = E[i, j] * g_E
            for j in range(M):
                by_F[i, j] = F_[i, j] * g_F
            rest[0] += dot(by_mean[i], mean[i], m) + dot(by_E[i], k[i], M)
            row = by[i]
            for j in range(M):
                row[j] += 2.0 * (by_E[i, j] + by_F[i, j])
        E_t = transposed(E)
        add_products(E_t, transposed(by_mean), 1.0, by_alpha, False, False)
        add_products(E_t, transposed(by_E), 1.0, by_K, True, False)
        add_products(transposed(F_), transposed(by_F), 1.0, less, True, False)
        _pull_back(p, b, by, by_diagonal, k, diagonal, psi, phi, values, q, basis, back, False)


@inner(types.void(I1, INT))
def _step(p, b):
    """Of Adam, of model b."""
    gradient, rest = _sums(p, b)[4:]
    (b1, b2), steps = BETAS, vector_at(p[P.N_STEPS], b, 1)
    rate = vector_at(p[P.RATES], 0, 3)[0]
    steps[0] += 1.0
    shrink = max(1.0 / math.sqrt(1.0 + steps[0] / 30.0), 0.1)
    correction = math.sqrt(1.0 - b2 ** steps[0]) / (1.0 - b1 ** steps[0]) * shrink
    decay = NETWORK_DECAY * shrink * min(shared_noise(p, b), 1.0)
    for i in range(integers_at(p[P.LEARNING], 0, 3)[2]):
        row = integers_at(p[P.PARAMETERS], i, 6)
        size, by, kind = row[3], gradient[row[4] :], row[5]
        theta, first = vector_at(row[0], b, size), vector_at(row[1], b, size)
        second = vector_at(row[2], b, size)
        step = (rate if kind > 0 else NETWORK_RATE) * correction
        for j in range(size):
            g = by[j] / rest[1]
            if kind == 0:
                theta[j] -= decay * theta[j]
            if math.isfinite(g):
                first[j] += (1.0 - b1) * (g - first[j])
                second[j] = b2 * second[j] + (1.0 - b2) * g * g
                theta[j] -= step * first[j] / (math.sqrt(second[j]) + 1e-8)
            if kind > 0:
                theta[j] = min(max(theta[j], LEAST_NOISE if kind == 2 else LEAST), MOST)


@njit(types.void(I1), **COMMON)
def step_fleet(p):
    """The rest of a step: the part of K in the gradient of each model, and Adam's move."""
    m, M, W = p[P.OUT], p[P.SLOTS], p[P.WIDTH]
    k, psi, phi, diagonal = np.empty((M, M)), np.empty((M, M)), np.empty((M, M)), np.empty(M)
    jitter = 1.0 + vector_at(p[P.FIGURES], 0, 3)[1]
    for b in range(p[P.MODELS]):
        by_K, less, T, back, gradient, rest = _sums(p, b)
        if rest[2] == 0.0:
            continue
        alpha = matrix_at(p[P.VECTORS], 2 * b, M, m)
        basis, values = matrix_at(p[P.EMBEDDED], b, M, W), matrix_at(p[P.LAYERED], b, M, p[P.VALUES])
        kernel_rows(p, b, basis, basis, vector_at(p[P.ACTIVE], b, M), k, psi, phi, diagonal)
        by, by_diagonal, by_s2 = np.zeros((M, M)), np.empty(M), rest[0]
        for i in range(M):
            for j in range(i + 1):
                a = by_K[i, j] + 0.5 * (dot(T[i], alpha[j], m) + dot(alpha[i], T[j], m))
                by_s2 += 2.0 * a * k[i, j] if j < i else a * diagonal[i] * jitter
                by[i, j] = by[j, i] = a - less[i, j] if j < i else 0.0
                by_diagonal[i] = (a - less[i, j]) * jitter
        for o in range(m):
            gradient[gradient.shape[0] - m + o] -= by_s2 / m
        _pull_back(p, b, by, by_diagonal, k, diagonal, psi, phi, values, basis, basis, back, True)
        _step(p, b)
