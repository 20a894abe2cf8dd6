"""A sparse GP, or a fleet of them, as compiled loops on its own memory: queries, updates, notes of its parts.

``p`` is a row of sizes and addresses, see :mod:`~torch_ekm.residual.sparse_gp.plan`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ...base import FARTHEST
from .. import monitor as N
from .. import plan as P
from .numba_kernels import embed, kernel_row, kernel_slopes, network_back, turn_weights
from .numba_math import exp
from .numba_memory import A1, A2, COMMON, I1, INT, ON, F, inner, integers_at, matrix_at, vector_at
from .numba_recursion import absorb, times


@njit(types.void(I1), **COMMON)
def embed_fleet(p):
    """The bases as the kernels see them, after torch has changed them or the kernels."""
    d, M = p[P.IN], p[P.SLOTS]
    for b in range(p[P.MODELS]):
        basis, values = matrix_at(p[P.BASIS], b, M, d), matrix_at(p[P.LAYERED], b, M, p[P.VALUES])
        turn_weights(p, b)
        for i in range(M):
            for j in range(d):
                values[i, j] = basis[i, j]
        embed(p, b, values, matrix_at(p[P.EMBEDDED], b, M, p[P.WIDTH]))


@inner(F(I1, INT, A1, A1, A1, A1, A1, A1))
def look(p, b, x, values, q, k, psi, phi):
    """k between x and the basis of model b, and what its slopes need; returns k(x, x).

    ``values`` begins with z, x in the learner's units; ``q`` is z as the kernel sees it.
    """
    d, M = p[P.IN], p[P.SLOTS]
    shift, scale = vector_at(p[P.SHIFT], b, d), vector_at(p[P.SCALE], b, d)
    reach = vector_at(p[P.REACH], 0, d)
    for j in range(d):
        values[j] = min(max((x[j] - shift[j]) / scale[j], -reach[j]), reach[j])
    embed(p, b, values.reshape(1, values.shape[0]), q.reshape(1, q.shape[0]))
    basis = matrix_at(p[P.EMBEDDED], b, M, p[P.WIDTH])
    return kernel_row(p, b, q, basis, vector_at(p[P.ACTIVE], b, M), k, psi, phi)


@inner(F(I1, INT, F, A1, A1, A1))
def mean_and_variance(p, b, prior, k, Ck, mean):
    """The mean in the units of y, not yet cut; returns the latent variance in the learner's. Makes Ck."""
    M, m = p[P.SLOTS], p[P.OUT]
    alpha = matrix_at(p[P.VECTORS], 2 * b, M, m)
    for o in range(m):
        mean[o] = 0.0
    for i in range(M):
        row, a = alpha[i], k[i]
        for o in range(m):
            mean[o] += row[o] * a
    shift, scale = vector_at(p[P.SHIFT_Y], b, m), vector_at(p[P.SCALE_Y], b, m)
    for o in range(m):
        mean[o] = mean[o] * scale[o] + shift[o]
    times(matrix_at(p[P.MOMENTS], 3 * b, M, M), k, Ck)
    v = prior
    for i in range(M):
        v += Ck[i] * k[i]
    return max(v, 0.0)


@inner(types.void(I1, INT, A1, A1))
def cut(p, b, mean, inside):
    """The mean, cut at twice the largest y; ``inside`` is 0 where it was, else 1."""
    largest = vector_at(p[P.LARGEST], b, p[P.OUT])
    for o in range(mean.shape[0]):
        most = FARTHEST * largest[o]
        inside[o] = 1.0 if abs(mean[o]) <= most else 0.0
        mean[o] = min(max(mean[o], -most), most)


@inner(F(I1, INT))
def shared_noise(p, b):
    """See ``Host.shared_noise``."""
    m, total = p[P.OUT], 0.0
    log_noise = vector_at(p[P.LOG_NOISE], b, m)
    for o in range(m):
        total += log_noise[o]
    return math.exp(total / m)


@inner(types.void(I1, INT, A1))
def noise_of(p, b, noise):
    """Observation noise of each output in squared units of y, as calibrated."""
    m = p[P.OUT]
    log_noise, scale = vector_at(p[P.LOG_NOISE], b, m), vector_at(p[P.SCALE_Y], b, m)
    for o in range(m):
        noise[o] = math.exp(log_noise[o]) * scale[o] * scale[o]
    if p[P.FACTOR]:
        factor = vector_at(p[P.FACTOR], b, m)
        for o in range(m):
            noise[o] *= math.exp(factor[o])


@njit(types.void(I1, types.boolean, INT, INT, INT, INT, INT), **COMMON)
def query_fleet(p, noisy, x, mean, variance, J, dv):
    """One query per model, all given by their addresses (0: not wanted), see ``SparseOnlineGP``.

    Args:
        noisy: whether the variance is that of y.
    """
    d, m, M, W, n_a = p[P.IN], p[P.OUT], p[P.SLOTS], p[P.WIDTH], p[P.ACTIONS]
    values, q, inside, noise = np.empty(p[P.VALUES]), np.empty(W), np.empty(m), np.zeros(m)
    k, psi, Ck, phi = np.empty(M), np.empty(M), np.empty(M), np.empty(M if n_a > 0 else 0)
    rows = (m + 1 if dv else m) if J else 0
    left, slopes, by = np.empty((M, rows)), np.empty((rows, W)), np.empty((rows, W - d))
    reach = vector_at(p[P.REACH], 0, d)
    for b in range(p[P.MODELS]):
        mean_ = vector_at(mean, b, m)
        prior = look(p, b, vector_at(x, b, d), values, q, k, psi, phi)
        v = mean_and_variance(p, b, prior, k, Ck, mean_)
        cut(p, b, mean_, inside)
        scale, scale_y = vector_at(p[P.SCALE], b, d), vector_at(p[P.SCALE_Y], b, m)
        if noisy:
            noise_of(p, b, noise)
        for o in range(m if variance else 0):
            vector_at(variance, b, m)[o] = v * scale_y[o] * scale_y[o] + noise[o]
        if rows == 0:
            continue
        alpha = matrix_at(p[P.VECTORS], 2 * b, M, m)
        for i in range(M):
            for o in range(m):
                left[i, o] = alpha[i, o]
            for o in range(m, rows):
                left[i, o] = 2.0 * Ck[i]
        kernel_slopes(p, b, q, matrix_at(p[P.EMBEDDED], b, M, W), psi, phi, left, slopes)
        log_variance = vector_at(p[P.LOG_VARIANCE], b, 1)[0]
        log_action = vector_at(p[P.LOG_ACTION], b, n_a)
        for o in range(m, rows):  # k(x, x) of an action-linear kernel
            for j in range(n_a):
                slopes[o, d - n_a + j] += 2.0 * q[d - n_a + j] * math.exp(log_variance + log_action[j])
        log_lengthscale = vector_at(p[P.LOG_LENGTHSCALE], b, d - n_a)
        for j in range(d - n_a):
            by_q = exp(-log_lengthscale[j])
            for r in range(rows):
                slopes[r, j] *= by_q
        if d < W:
            for r in range(rows):
                for j in range(W - d):
                    by[r, j] = slopes[r, d + j]
            network_back(p, b, values.reshape(1, values.shape[0]), by, slopes, np.empty(0))
        for j in range(d):
            by_x = 1.0 / scale[j] if abs(values[j]) < reach[j] else 0.0
            for o in range(m):
                matrix_at(J, b, m, d)[o, j] = slopes[o, j] * scale_y[o] * by_x * inside[o]
            for o in range(m, rows):
                for to in range(m):
                    matrix_at(dv, b, m, d)[to, j] = slopes[o, j] * scale_y[to] * scale_y[to] * by_x


@inner(types.UniTuple(A1, 5)(I1, INT))
def room_of(p, b):
    """What an update of model b finds: z with all layers, and as the kernel sees it, k, Ck, k(x, x)."""
    n, W, M = p[P.VALUES], p[P.WIDTH], p[P.SLOTS]
    at = p[P.ROOM] + 8 * b * (n + W + 2 * M + 1)
    k = at + 8 * (n + W)
    return (
        vector_at(at, 0, n), vector_at(at + 8 * n, 0, W), vector_at(k, 0, M), vector_at(k, 1, M),
        vector_at(k + 16 * M, 0, 1),
    )  # fmt: skip


@inner(INT(I1, INT, A1, A1, A1))
def learn(p, b, y, figures, error):
    """Learn the sample whose k, k(x, x) and Ck are in the room; returns the event."""
    d, m, M = p[P.IN], p[P.OUT], p[P.SLOTS]
    values, q, k, Ck, prior = room_of(p, b)
    shift, scale, t = vector_at(p[P.SHIFT_Y], b, m), vector_at(p[P.SCALE_Y], b, m), np.empty(m)
    for o in range(m):
        t[o] = (y[o] - shift[o]) / scale[o]
    slot, basis = integers_at(p[P.SLOT], b, 1)[0], matrix_at(p[P.BASIS], b, M, d)
    for j in range(d):
        basis[slot, j] = values[j]
    embedded = matrix_at(p[P.EMBEDDED], b, M, p[P.WIDTH])
    for j in range(q.shape[0]):
        embedded[slot, j] = q[j]
    return absorb(p, b, prior[0], shared_noise(p, b), k, Ck, t, figures, error)


@inner(types.void(I1, ON, INT))
def grow_largest(p, on, y):
    """The largest y so far takes these in."""
    m = p[P.OUT]
    for b in range(p[P.MODELS]):
        if on[b]:
            largest, y_ = vector_at(p[P.LARGEST], b, m), vector_at(y, b, m)
            for o in range(m):
                largest[o] = max(largest[o], abs(y_[o]))


@inner(types.boolean(I1, INT, ON, INT, A2, A2))
def changed(p, n, on, y, figures, errors):
    """What DetectChanges notes of the sample after n per model; whether a model faces another system."""
    m, alarm = p[P.OUT], False
    for b in range(p[P.MODELS]):
        level, misled = vector_at(p[P.CHANGED], b, 1), vector_at(p[P.MISLED], b, 1)
        if on[b]:
            y_, wrong, size = vector_at(y, b, m), 0.0, 0.0
            shift, scale = vector_at(p[P.SHIFT_Y], b, m), vector_at(p[P.SCALE_Y], b, m)
            for o in range(m):
                t = (y_[o] - shift[o]) / scale[o]
                wrong, size = wrong + errors[b, o] * errors[b, o], size + t * t
            level[0] += N.RATE * ((1.0 if figures[1, b] > N.LARGE else 0.0) - level[0])
            misled[0] += N.MISLED_RATE * ((1.0 if wrong > N.WORSE * size else 0.0) - misled[0])
        vector_at(p[P.LEVELS], n % N.RING_SIZE * p[P.MODELS] + b, 1)[0] = level[0] if on[b] else N.NO_SAMPLE
        alarm |= level[0] > N.ALARM or misled[0] > N.ALARM
    return alarm


@inner(types.boolean(I1, INT, ON, INT, INT, A2, A2))
def note(p, n, on, x, y, figures, errors):
    """All notes of the sample after n per model; whether a model faces another system."""
    d, m = p[P.IN], p[P.OUT]
    grow_largest(p, on, y)
    for b in range(p[P.MODELS]):
        one, at = 1.0 if on[b] else 0.0, b * p[P.RECENT_SIZE] + n % p[P.RECENT_SIZE]
        for kept, new, width in ((p[P.RECENT_X], x, d), (p[P.RECENT_Y], y, m)):
            to, values = vector_at(kept, at, width), vector_at(new, b, width)
            for j in range(width):
                to[j] = values[j]
        vector_at(p[P.RECENT_ON], at, 1)[0] = one
        vector_at(p[P.RECENT], at, 1)[0] = figures[2, b] * one
        vector_at(p[P.PENDING], b, 1)[0] += one
        if p[P.FACTOR] and on[b]:
            factor, log_noise = vector_at(p[P.FACTOR], b, m), vector_at(p[P.LOG_NOISE], b, m)
            for o in range(m):
                variance = figures[3, b] + math.exp(log_noise[o]) * math.exp(factor[o])
                missed = 1.0 if errors[b, o] * errors[b, o] > N.Z90_SQUARED * variance else 0.0
                moved = factor[o] + N.CALIBRATION_RATE * (missed - 0.1)
                factor[o] = min(max(moved, N.FACTOR_LEAST), N.FACTOR_MOST)
    return p[P.CHANGED] != 0 and changed(p, n, on, y, figures, errors)


@inner(types.boolean(I1, INT, INT))
def are_finite(p, x, y):
    """Whether the squares of a sample per model are."""
    n, m, total = p[P.MODELS] * p[P.IN], p[P.MODELS] * p[P.OUT], 0.0
    x_, y_ = vector_at(x, 0, n), vector_at(y, 0, m)
    for j in range(n):
        total += x_[j] * x_[j]
    for o in range(m):
        total += y_[o] * y_[o]
    return math.isfinite(total)


@njit(INT(I1, INT, ON, INT, INT, A2, I1), **COMMON)
def update_fleet(p, n, on, x, y, figures, event):
    """The sample after n per model where ``on``, given by addresses.

    Returns:
        1 where a model faces another system, else 0; -1: a sample is not finite, and nothing was done.

    Args:
        figures: novelty, nis, weight and latent variance of each model; as they are where not ``on``.
    """
    if not are_finite(p, x, y):
        return -1
    d, m, M = p[P.IN], p[P.OUT], p[P.SLOTS]
    psi, phi, found, errors = np.empty(M), np.empty(M), np.empty(4), np.empty((on.shape[0], m))
    for b in range(p[P.MODELS]):
        if not on[b]:
            continue
        values, q, k, Ck, prior = room_of(p, b)
        prior[0] = look(p, b, vector_at(x, b, d), values, q, k, psi, phi)
        times(matrix_at(p[P.MOMENTS], 3 * b, M, M), k, Ck)
        event[b] = learn(p, b, vector_at(y, b, m), found, errors[b])
        for r in range(4):
            figures[r, b] = found[r]
    return int(note(p, n, on, x, y, figures, errors))
