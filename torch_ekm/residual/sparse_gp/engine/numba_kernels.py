"""The recursion of a sparse GP, and its kernels, as compiled loops for one model.

Equations and names are those of :mod:`~torch_ekm.residual.sparse_gp.engine.recursion`,
:mod:`~torch_ekm.residual.kernels` and :mod:`~torch_ekm.residual.sparse_gp.posterior`, which stay the
reference. All arrays are C-contiguous and float64, and most are the learner's own memory, changed in place.
No call holds the GIL, none is parallel: numba and other libraries may not share one OpenMP runtime.

Loops over the last axis touch two or three arrays each: with more the compiler gives up proving that they
do not overlap, and does not vectorise. Entries are assigned one by one: an assignment of an array to a slice
can fail, and numba compiles the message with it, for seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ..monitor import DISTRUSTED, DISTRUSTED_MOST, RATE
from .numba_math import A1, A2, A3, EPS, I1, INNER, INT, TINY, F, exp
from .recursion import LEAST_NOVELTY, TIE, TIE_KL

#: what a kernel's ``kind`` means
SQUARED_EXPONENTIAL, MATERN32 = 0, 1
_FAR = 1e10  # squared scaled distance beyond which a kernel is 0


@njit(types.void(INT, F, A1, A1, A1), **INNER)
def _correlations(kind, variance, active, k, psi):
    """From squared scaled distances in ``k``: k and ``v psi`` at points in use, 0 elsewhere, see
    StationaryKernel."""
    n = k.shape[0]
    for i in range(n):
        k[i] = min(k[i], _FAR)
    if kind == SQUARED_EXPONENTIAL:
        for i in range(n):
            k[i] = variance * exp(-0.5 * k[i])
        for i in range(n):
            psi[i] = k[i]
    else:
        for i in range(n):
            k[i] = math.sqrt(3.0 * k[i])
        for i in range(n):
            psi[i] = variance * exp(-k[i])
        for i in range(n):
            k[i] = (1.0 + k[i]) * psi[i]
            psi[i] *= 3.0
    for i in range(n):
        k[i] = k[i] if active[i] != 0.0 else 0.0
        psi[i] = psi[i] if active[i] != 0.0 else 0.0


@njit(F(INT, INT, A1, A2, A1, F, A1, A1, A1, A1), **INNER)
def of_distances(kind, n_a, q, basis, active, log_variance, log_action, k, psi, phi):
    """See :func:`kernel_row`; k begins as squared distances."""
    n, n_s = basis.shape[0], q.shape[0] - n_a
    start = 0.0 if n_s > 0 else 1.0  # without a state it is a LinearKernel, which has a constant
    variance = math.exp(log_variance)
    _correlations(kind, variance, active, k, psi)
    if n_a == 0:
        return variance
    norm, by = start, np.empty(n_a)
    for j in range(n_a):
        by[j] = q[n_s + j] * math.exp(log_action[j])
        norm += q[n_s + j] * by[j]
    for i in range(n):
        inner = start
        for j in range(n_a):
            inner += by[j] * basis[i, n_s + j]
        phi[i] = k[i]
        k[i] = phi[i] * inner if active[i] != 0.0 else 0.0
        psi[i] *= inner
    return variance * norm


@njit(F(INT, INT, A1, A2, A1, F, A1, A1, A1, A1), **INNER)
def kernel_row(kind, n_a, q, basis, active, log_variance, log_action, k, psi, phi):
    """k between q and the basis, both as the kernel sees them; returns k(q, q).

    ``psi`` and ``phi`` make the derivatives: ``dk/dq = psi (basis - q)`` of a state, ``phi Lambda basis`` of
    an action.
    """
    n_s = q.shape[0] - n_a
    for i in range(basis.shape[0]):
        d2, point = 0.0, basis[i]
        for j in range(n_s):
            u = point[j] - q[j]
            d2 += u * u
        k[i] = d2
    return of_distances(kind, n_a, q, basis, active, log_variance, log_action, k, psi, phi)


@njit(types.void(A1, A2, A1, A1, A1, A2, A2), **INNER)
def kernel_slopes(q, basis, psi, phi, log_action, left, out):
    """``out = left' dk/dq``, ``left (slots, rows)``."""
    n_a = log_action.shape[0]
    n_s, rows, u = q.shape[0] - n_a, out.shape[0], np.empty(q.shape[0])
    out[:] = 0.0
    for i in range(basis.shape[0]):
        if psi[i] == 0.0 and (n_a == 0 or phi[i] == 0.0):
            continue
        point, a = basis[i], psi[i]
        for j in range(n_s):
            u[j] = a * (point[j] - q[j])
        for j in range(n_s, n_s + n_a):
            u[j] = phi[i] * point[j]
        for r in range(rows):
            to, b = out[r], left[i, r]
            for j in range(u.shape[0]):
                to[j] += b * u[j]
    for j in range(n_a):
        lam = math.exp(log_action[j])
        for r in range(rows):
            out[r, n_s + j] *= lam


@njit(types.void(A2, A1, A1), **INNER)
def times(A, vector, out):
    """``out = A vector``."""
    n = vector.shape[0]
    for i in range(n):
        row, total = A[i], 0.0
        for j in range(n):
            total += row[j] * vector[j]
        out[i] = total


@njit(types.void(A2, F, A1), **INNER)
def _add_square(A, a, u):
    """``A += a u u'``."""
    n = u.shape[0]
    for i in range(n):
        row, b = A[i], a * u[i]
        for j in range(n):
            row[j] += b * u[j]


@njit(F(F, F), **INNER)
def _remaining(c, q):
    """``c + q``, which rounding must not turn negative."""
    return max(c + q, 100.0 * EPS * q)


@njit(INT(F, A1, A1, A1, A3, A3), **INNER)
def _least_loss(s2, active, c_diag, q_diag, moments, vectors):
    """The point that loses least when it is pruned, see ``pruning_loss``."""
    best, m, losses = np.inf, vectors.shape[2], np.empty(active.shape[0])
    for i in range(active.shape[0]):
        losses[i] = np.inf
        if active[i] == 0.0:
            continue
        q = q_diag[i]
        rest = _remaining(c_diag[i], q)
        loss = 0.0
        for o in range(m):
            loss += vectors[0, i, o] * vectors[0, i, o]
        loss = loss / rest + m * (moments[2, i, i] / s2 / q + math.log(rest / q))
        losses[i] = loss
        best = min(best, loss)
    best += TIE * abs(best) + TIE_KL * m
    for i in range(active.shape[0]):
        if losses[i] <= best:
            return i
    return 0


@njit(types.void(A3, A3, A1, A1, A1, A1, F, F, INT, F), **INNER)
def _add_and_prune(moments, vectors, s, p, work_c, work_q, gain, grow, i, w):
    """Add the new point to C and Q and prune point i of all three, in one pass.

    ``work_c`` and ``work_q`` hold the columns i of C and Q with the new point in them, ``w`` its entry in
    Omega.
    """
    M, m = s.shape[0], vectors.shape[2]
    c, q = work_c[i], work_q[i]
    work_c[i] = work_q[i] = 0.0
    q_inv, cq_inv = 1.0 / q, 1.0 / _remaining(c, q)
    C, Q, W = moments[0], moments[1], moments[2]
    cq, e, u = np.empty(M), np.empty(M), np.empty(M)
    for j in range(M):
        cq[j] = work_c[j] + work_q[j]
        e[j] = -work_q[j] * q_inv
    for j in range(M):
        u[j] = W[i, j] + 0.5 * w * e[j]
    u[i] = 0.5 * w * e[i]
    for j in range(M):
        row, a, b, d = C[j], -gain * s[j], -e[j], -cq[j] * cq_inv
        for n in range(M):
            row[n] += a * s[n] + b * work_q[n] + d * cq[n]
        row, a, b = Q[j], grow * p[j], e[j]
        for n in range(M):
            row[n] += a * p[n] + b * work_q[n]
        row, a, b = W[j], u[j], e[j]
        for n in range(M):
            row[n] += a * e[n] + b * u[n]
    for j in range(M):
        for o in range(m):
            vectors[0, j, o] -= cq[j] * cq_inv * vectors[0, i, o]
            vectors[1, j, o] += e[j] * vectors[1, i, o]
    # the slot becomes free: its rows and columns are 0 by definition, not by cancellation
    for r in range(3):
        moments[r, i, :] = 0.0
        for j in range(M):
            moments[r, j, i] = 0.0
    for r in range(2):
        vectors[r, i, :] = 0.0


@njit(
    INT(A1, F, F, A1, A1, A1, I1, I1, A3, A3, F, A1, F, F, A1, A1),
    **INNER,
)
def absorb(
    t, prior, s2, k, Ck, active, count, slot_, moments, vectors, robust, level, threshold, jitter,
    figures, error,
):  # fmt: skip
    """One sample of one model, see ``recursion.absorb``; returns the event. Its input is in the free slot.

    Args:
        Ck: is overwritten.
        robust, level: square of a robust weight's threshold (0: none), share of samples distrusted.
        figures: novelty, nis, weight and latent variance.
        error: innovation.
    """
    M, m = k.shape[0], t.shape[0]
    capacity, slot = M - 1, slot_[0]
    C, Q, W = moments[0], moments[1], moments[2]
    prior *= 1.0 + jitter
    e = np.empty(M)
    times(Q, k, e)
    kCk, ke = 0.0, 0.0
    for i in range(M):
        kCk, ke = kCk + Ck[i] * k[i], ke + e[i] * k[i]
    gamma, v = max(prior - ke, 0.0), prior + kCk
    for o in range(m):
        error[o] = t[o]
    for i in range(M):
        for o in range(m):
            error[o] -= k[i] * vectors[0, i, o]
    nis = 0.0
    for o in range(m):
        nis += error[o] * error[o]
    nis /= m * (s2 + v)
    noise, weight = s2, 1.0
    if robust > 0.0:
        distrusted = 1.0 if nis > robust else 0.0
        if distrusted:
            trust = (DISTRUSTED_MOST - level[0]) / (DISTRUSTED_MOST - DISTRUSTED)
            weight = (robust / nis) ** min(max(trust, 0.0), 1.0)
        level[0] += RATE * (distrusted - level[0])
        noise = (s2 + v) / weight - v
    full = count[0] == capacity
    novel = gamma > max(threshold * prior, LEAST_NOVELTY * s2)
    dropped = 0.0 if novel else gamma
    gain, precision = 1.0 / (noise + v - dropped), s2 / noise
    figures[0], figures[1], figures[2], figures[3] = gamma / max(prior, TINY), nis, weight, v

    s = Ck
    if novel:
        s[slot] += 1.0
        W[slot, slot] += precision
        for o in range(m):
            vectors[1, slot, o] += t[o] * precision
    else:
        _add_square(W, precision, e)
        for i in range(M):
            s[i] += e[i]
            for o in range(m):
                vectors[1, i, o] += e[i] * t[o] * precision
    for i in range(M):
        for o in range(m):
            vectors[0, i, o] += s[i] * error[o] * gain
    if not (novel and full):
        _add_square(C, -gain, s)
    if not novel:
        return 1
    active[slot] = 1.0
    e[slot] -= 1.0  # p of the recursion
    grow = 1.0 / gamma
    if not full:
        _add_square(Q, grow, e)
        count[0] += 1
        slot_[0] += 1
        return 2
    # what decides which point goes are the diagonals of the sum, what is left of it one of its columns
    c, q = np.empty(M), np.empty(M)
    for j in range(M):
        c[j] = C[j, j] - gain * s[j] * s[j]
        q[j] = Q[j, j] + grow * e[j] * e[j]
    i = _least_loss(s2, active, c, q, moments, vectors)
    for j in range(M):
        c[j] = C[i, j] - gain * s[i] * s[j]
        q[j] = Q[i, j] + grow * e[i] * e[j]
    _add_and_prune(moments, vectors, s, e, c, q, gain, grow, i, W[i, i])
    active[i] = 0.0
    slot_[0] = i
    return 3
