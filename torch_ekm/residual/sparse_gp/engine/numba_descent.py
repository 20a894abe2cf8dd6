"""A step on the lagged prequential loss as compiled loops.

Equations and names are those of :class:`~torch_ekm.residual.sparse_gp.prequential_loss.PrequentialLoss`,
:class:`~torch_ekm.residual.LearnHyperparameters` and the kernels, which stay the reference. A row stands for
a sample: what the loss wants by column is transposed first, since products of rows are the fastest.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .. import plan as P
from ..hyperparameters import BETAS, LEAST, LEAST_NOISE, MOST, NETWORK_DECAY, NETWORK_RATE
from .numba_core import embed_many
from .numba_math import (
    A1,
    A2,
    COMMON,
    EPS,
    I1,
    INNER,
    INT,
    TINY,
    F,
    add_products,
    dot,
    integers_at,
    matrix_at,
    stack_at,
    transposed,
    vector_at,
)  # fmt: skip
from .numba_rebuild import kernel_rows, shared_noise

#: what is found: values and embedding of the basis and them, k, psi, phi, Ck, Qk, mean, derivatives
#: by the mean and by variance, p and u; k(x, x); derivative by the noise
FOUND = types.Tuple((A2, A2, A2, A2, A2, A2, A2, A2, A2, A2, A1, A1))


@njit(INT(I1, INT, INT, INT, INT, A2, A2, A2), **INNER)
def _draw(p, b, n, n_rebuilt, n_taken, values, y, about):
    """Queries in units, see ``LearnHyperparameters.queries``; returns their number.

    ``about``: of each its weight, whether the past state has seen it, and its age.
    """
    d, m, size = p[P.IN], p[P.OUT], p[P.RECENT_SIZE]
    learning = integers_at(p[P.LEARNING], 0, 2)
    new, k = min(max(n - n_rebuilt, 0), learning[0]), learning[1]
    kept = min(n, size)
    stride = max(kept // k, 1) if k > 0 else 1
    first = n_taken % stride
    x_of, y_of = matrix_at(p[P.RECENT_X], b, size, d), matrix_at(p[P.RECENT_Y], b, size, m)
    weight_of = vector_at(p[P.RECENT], b, size)
    shift, scale, reach = (
        vector_at(p[P.SHIFT], b, d),
        vector_at(p[P.SCALE], b, d),
        vector_at(p[P.REACH], 0, d),
    )
    shift_y, scale_y = vector_at(p[P.SHIFT_Y], b, m), vector_at(p[P.SCALE_Y], b, m)
    q = 0
    for i in range(new + k):
        place = (n - new + i) % size if i < new else first + stride * (i - new)
        if place >= kept:
            break
        age = 0 if i < new else (n - 1 - place) % size + 1
        about[q, 1], about[q, 2] = 0.0 if i < new else 1.0, age
        about[q, 0] = weight_of[place] if i < new or n - n_rebuilt < age < size else 0.0
        for j in range(d):
            z = (x_of[place, j] - shift[j]) / scale[j]
            values[q, j] = min(max(z, -reach[j]), reach[j])
        for o in range(m):
            y[q, o] = (y_of[place, o] - shift_y[o]) / scale_y[o]
        q += 1
    return q


@njit(types.void(F, F, F, A2, A2, A1, A1, A2, A2, A2, A1, A2), **INNER)
def _density(robust, factor, s2, mean, y, diagonal, log_noise, kE_u, about, by_mean, by_log_noise, by):
    """Derivatives of the loss, see ``PrequentialLoss._density``; ``by``: variance, p and u of each query."""
    n, m, total = mean.shape[0], mean.shape[1], 0.0
    for q in range(n):
        total += about[q, 0]
    for q in range(n):
        kE, u = kE_u[q, 0], kE_u[q, 1]
        v, p_, share = diagonal[q] + kE, u + kE, about[q, 0] / max(total, TINY)
        held = about[q, 1] * about[q, 0] * factor ** about[q, 2] / s2
        exact, least = 1.0 / max(1.0 - held * p_, EPS), max(p_, TINY)
        most = max(u / least, 1.0)
        bounded = exact > most
        c = most if bounded else exact
        left, each, by_left, by_c = v + p_ * (c - 1.0), 0.5 / m * share, 0.0, 0.0
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


@njit(types.void(I1, INT, A2, A2, A1), **INNER)
def _network_back(p, own, values, by, gradient):
    """Derivatives by weights and biases from those by features; ``values``: of all layers, by point."""
    layers, N = p[P.LAYERS], values.shape[0]
    widths = integers_at(p[P.WIDTHS], 0, layers + 1)
    weights = integers_at(p[P.WEIGHTS], 0, 2 * layers)
    at, end = values.shape[1] - widths[layers], gradient.shape[0] - p[P.OUT]
    for layer in range(layers - 1, -1, -1):
        n_in, n_out = widths[layer], widths[layer + 1]
        at -= n_in
        before, by_t = np.empty((n_in, N)), transposed(by)
        for i in range(N):
            for j in range(n_in):
                before[j, i] = values[i, at + j]
        if layer < layers - 1:
            end -= n_out
            for j in range(n_out):
                for i in range(N):
                    gradient[end + j] += by_t[j, i]
        end -= n_in * n_out
        own_part = gradient[end : end + n_in * n_out].reshape(n_in, n_out)
        add_products(before, by_t, 1.0, own_part, False, False)
        if layer > 0:
            new = np.zeros((N, n_in))
            add_products(by, matrix_at(weights[2 * layer], own, n_in, n_out), 1.0, new, False, False)
            for i in range(N):
                for j in range(n_in):
                    h = values[i, at + j]
                    new[i, j] *= 1.0 - h * h
            by = new


@njit(types.void(I1, INT, A2, A1, A2, A1, A2, A2, A2, A2, A1), **INNER)
def _pull_back(p, b, by, by_diagonal, k, diagonal, psi, phi, values, q, gradient):
    """What follows of derivatives by k for the kernel's own: see ``Kernel.with_pullback``.

    Args:
        by, by_diagonal: by ``k(x_i, x_j)`` of all points i with the first ones j, and by ``k(x_i, x_i)``.
        k, diagonal, psi, phi: of the points, see ``kernel_rows``.
        values, q: points in units, with all layers of a network; and embedded.
    """
    N, M, W, n_a, own = k.shape[0], p[P.SLOTS], p[P.WIDTH], p[P.ACTIONS], b * p[P.OWN]
    d, n_s = p[P.IN], p[P.IN] - n_a
    log_action = vector_at(p[P.LOG_ACTION], own, n_a)
    by_variance, variance = 0.0, math.exp(vector_at(p[P.LOG_VARIANCE], own, 1)[0])
    for i in range(N):
        by_variance += by_diagonal[i] * diagonal[i] + dot(by[i], k[i], M)
    gradient[d] = by_variance
    for j in range(n_a):
        total, column = 0.0, n_s + j
        for i in range(N):
            inner = 0.0
            for r in range(M):
                inner += by[i, r] * phi[i, r] * q[r, column]
            total += q[i, column] * (inner + by_diagonal[i] * variance * q[i, column])
        gradient[column] = total * math.exp(log_action[j])
    if n_s == 0:
        return
    # the kernel depends on differences alone: about one of the points squares are of their size
    a, weights, sums = np.empty((N, W)), np.empty((N, M)), np.zeros(N)
    for i in range(N):
        for j in range(W):
            a[i, j] = q[i, j] - q[0, j]
        for j in range(M):
            weights[i, j] = by[i, j] * psi[i, j]
            sums[i] += weights[i, j]
    pulled, back = np.zeros((N, W)), np.zeros((M, W))
    a_t = transposed(a)
    few_t = np.empty((W, M))
    for j in range(W):
        for i in range(M):
            few_t[j, i] = a_t[j, i]
    add_products(weights, few_t, 1.0, pulled, False, False)
    later, later_a = transposed(weights[M:]), np.empty((W, N - M))
    for j in range(W):
        for i in range(N - M):
            later_a[j, i] = a_t[j, M + i]
    add_products(later, later_a, 1.0, back, False, False)
    for i in range(N):
        for j in range(W):
            pulled[i, j] -= sums[i] * a[i, j]
    for i in range(M):
        total = 0.0
        for r in range(N - M):
            total += later[i, r]
        for j in range(W):  # a pair of basis points counts for both of them
            pulled[i, j] = 2.0 * pulled[i, j] + back[i, j] - total * a[i, j]
    for j in range(n_s):
        total = 0.0
        for i in range(N):
            total -= pulled[i, j] * a[i, j]
        gradient[j] = total
    if p[P.LAYERS] > 0:
        features = np.empty((N, W - d))
        for i in range(N):
            for j in range(W - d):
                features[i, j] = pulled[i, d + j]
        _network_back(p, own, values, features, gradient)


@njit(FOUND(I1, INT, INT, INT, INT), **INNER)
def _predict(p, b, n, n_rebuilt, n_taken):
    """What the past state of model b says of the queries, and the loss' derivatives by that."""
    d, m, M, own = p[P.IN], p[P.OUT], p[P.SLOTS], b * p[P.OWN]
    learning, figures = integers_at(p[P.LEARNING], 0, 2), vector_at(p[P.RATES], 0, 3)
    most = learning[0] + learning[1]
    x, y, about = np.empty((most, d)), np.empty((most, m)), np.empty((most, 3))
    n = _draw(p, b, n, n_rebuilt, n_taken, x, y, about)
    N = M + n
    basis, active = matrix_at(p[P.BASIS], b, M, d), vector_at(p[P.ACTIVE], b, M)
    moments, alpha = stack_at(p[P.MOMENTS], b, 3, M, M), matrix_at(p[P.VECTORS], 2 * b, M, m)
    values, q = np.empty((N, p[P.VALUES])), np.empty((N, p[P.WIDTH]))
    for i in range(N):
        for j in range(d):
            values[i, j] = basis[i, j] if i < M else x[i - M, j]
    embed_many(p, own, values, q)
    k, psi, phi, diagonal = np.empty((N, M)), np.empty((N, M)), np.empty((N, M)), np.empty(N)
    kernel_rows(p, own, q, q[:M], active, k, psi, phi, diagonal)
    cross, E, F_, mean = k[M:], np.zeros((n, M)), np.zeros((n, M)), np.zeros((n, m))
    add_products(cross, moments[0], 1.0, E, False, False)
    add_products(cross, moments[1], 1.0, F_, False, False)
    add_products(cross, transposed(alpha), 1.0, mean, False, False)
    kE_u, by_mean, by_q, by_log_noise = np.empty((n, 2)), np.empty((n, m)), np.empty((n, 3)), np.zeros(m)
    for i in range(n):
        kE_u[i, 0], kE_u[i, 1] = dot(cross[i], E[i], M), dot(cross[i], F_[i], M)
    log_noise = vector_at(p[P.LOG_NOISE], b, m)
    _density(
        figures[1], figures[2], shared_noise(p, b), mean, y, diagonal[M:], log_noise, kE_u, about, by_mean,
        by_log_noise, by_q,
    )  # fmt: skip
    return values, q, k, psi, phi, E, F_, mean, by_mean, by_q, diagonal, by_log_noise


@njit(types.void(I1, INT, FOUND, A1), **INNER)
def _gradient(p, b, found, gradient):
    """Of the loss of model b, from what :func:`_predict` found."""
    values, q, k, psi, phi, E, F_, mean, by_mean, by_q, diagonal, by_log_noise = found
    m, M, N = p[P.OUT], p[P.SLOTS], k.shape[0]
    alpha, n, cross = matrix_at(p[P.VECTORS], 2 * b, M, m), N - M, k[M:]
    by, by_diagonal, by_K, T, by_s2 = np.zeros((N, M)), np.empty(N), np.zeros((M, M)), np.zeros((M, m)), 0.0
    E_t, F_t, by_E, by_F = transposed(E), transposed(F_), np.empty((n, M)), np.empty((n, M))
    add_products(E_t, transposed(by_mean), 1.0, T, False, False)
    add_products(by_mean, alpha, 1.0, by[M:], False, False)
    for i in range(n):
        g_E, g_F = by_q[i, 0] + by_q[i, 1], by_q[i, 1] + by_q[i, 2]
        by_diagonal[M + i] = by_q[i, 0]
        by_s2 += dot(by_mean[i], mean[i], m)
        for j in range(M):
            by_E[i, j] = E[i, j] * g_E
        for j in range(M):
            by_F[i, j] = F_[i, j] * g_F
        by_s2 += dot(by_E[i], cross[i], M)
        row = by[M + i]
        for j in range(M):
            row[j] += 2.0 * (by_E[i, j] + by_F[i, j])
    add_products(E_t, transposed(by_E), 1.0, by_K, True, False)
    jitter = 1.0 + vector_at(p[P.FIGURES], 0, 3)[1]
    for i in range(M):
        for j in range(i + 1):
            by_K[i, j] += 0.5 * (dot(T[i], alpha[j], m) + dot(alpha[i], T[j], m))
            by_s2 += 2.0 * by_K[i, j] * k[i, j] if j < i else by_K[i, i] * diagonal[i] * jitter
    add_products(F_t, transposed(by_F), -1.0, by_K, True, False)
    for i in range(M):
        for j in range(i):
            by[i, j] = by[j, i] = by_K[i, j]
        by_diagonal[i] = by_K[i, i] * jitter
    for o in range(m):
        gradient[gradient.shape[0] - m + o] = by_log_noise[o] - by_s2 / m
    _pull_back(p, b, by, by_diagonal, k, diagonal, psi, phi, values, q, gradient)


@njit(types.boolean(I1, INT, INT, INT), **INNER)
def _counts(p, b, n, n_rebuilt):
    """Whether a sample since the past state does."""
    size, total = p[P.RECENT_SIZE], 0.0
    weight_of = vector_at(p[P.RECENT], b, size)
    for i in range(min(max(n - n_rebuilt, 0), integers_at(p[P.LEARNING], 0, 1)[0])):
        total += weight_of[(n - 1 - i) % size]
    return total > 0.0


@njit(types.void(I1, INT, FOUND), **INNER)
def _step(p, b, found):
    """Of Adam, of model b."""
    learning, rate = integers_at(p[P.LEARNING], 0, 5), vector_at(p[P.RATES], 0, 3)[0]
    gradient, (b1, b2), steps = np.zeros(learning[3]), BETAS, vector_at(p[P.N_STEPS], b, 1)
    _gradient(p, b, found, gradient)
    steps[0] += 1.0
    shrink = max(1.0 / math.sqrt(1.0 + steps[0] / 30.0), 0.1)
    correction = math.sqrt(1.0 - b2 ** steps[0]) / (1.0 - b1 ** steps[0]) * shrink
    decay = NETWORK_DECAY * shrink * min(shared_noise(p, b), 1.0)
    for i in range(learning[2]):
        row = integers_at(learning[4], i, 8)
        size, by, logarithm = row[5], gradient[row[6] :], row[7] > 0
        theta, move = vector_at(row[1], b, size), vector_at(row[2], b, size)
        first, second = vector_at(row[3], b, size), vector_at(row[4], b, size)
        step = (rate if logarithm else NETWORK_RATE) * correction
        for j in range(size):
            g = by[j]
            if not logarithm:
                move[j] -= decay * theta[j]
            if math.isfinite(g):
                first[j] += (1.0 - b1) * (g - first[j])
                second[j] = b2 * second[j] + (1.0 - b2) * g * g
                move[j] -= step * first[j] / (math.sqrt(second[j]) + 1e-8)


@njit(types.void(I1), **COMMON)
def lead_fleet(p):
    """The parameters that the last steps lead to, into the memory where p has them."""
    learning = integers_at(p[P.LEARNING], 0, 5)
    for b in range(p[P.MODELS] if p[P.OWN] else 1):
        for i in range(learning[2]):
            row = integers_at(learning[4], i, 8)
            theta, to = vector_at(row[0], b, row[5]), vector_at(row[1], b, row[5])
            move = vector_at(row[2], b, row[5])
            for j in range(row[5]):
                to[j] = theta[j] + move[j]
                if row[7] > 0:
                    to[j] = min(max(to[j], LEAST_NOISE if row[7] == 2 else LEAST), MOST)


@njit(types.void(I1), **COMMON)
def arrive_fleet(p):
    """The parameters become what :func:`lead_fleet` found."""
    learning = integers_at(p[P.LEARNING], 0, 5)
    for b in range(p[P.MODELS] if p[P.OWN] else 1):
        for i in range(learning[2]):
            row = integers_at(learning[4], i, 8)
            theta, to = vector_at(row[0], b, row[5]), vector_at(row[1], b, row[5])
            move = vector_at(row[2], b, row[5])
            for j in range(row[5]):
                theta[j], move[j] = to[j], 0.0


@njit(FOUND(I1, INT, INT, INT), **COMMON)
def predict_queries(p, n, n_rebuilt, n_taken):
    """The first half of a step of one model, see :func:`descend_fleet`."""
    return _predict(p, 0, n, n_rebuilt, n_taken)


@njit(types.void(I1, INT, INT, FOUND), **COMMON)
def finish_step(p, n, n_rebuilt, found):
    """The second half."""
    if _counts(p, 0, n, n_rebuilt):
        _step(p, 0, found)


@njit(types.void(I1, INT, INT, INT), **COMMON)
def descend_fleet(p, n, n_rebuilt, n_taken):
    """A step of Adam, see ``LearnHyperparameters.descend``, of each model after n samples."""
    for b in range(p[P.MODELS]):
        if _counts(p, b, n, n_rebuilt):
            _step(p, b, _predict(p, b, n, n_rebuilt, n_taken))
