"""The recursion of a sparse GP as compiled loops for one model.

Equations and names are those of :mod:`~torch_ekm.residual.sparse_gp.engine.recursion`, which stays the
reference. Most arrays are the learner's own memory, changed in place.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from .. import plan as P
from ..monitor import DISTRUSTED, DISTRUSTED_MOST, RATE
from .numba_memory import A1, A2, A3, EPS, I1, INT, TINY, F, inner, integers_at, stack_at, vector_at
from .recursion import LEAST_NOVELTY, TIE, TIE_KL


@inner(types.void(A2, A1, A1))
def times(A, vector, out):
    """``out = A vector``."""
    n = vector.shape[0]
    for i in range(n):
        row, total = A[i], 0.0
        for j in range(n):
            total += row[j] * vector[j]
        out[i] = total


@inner(types.void(A2, F, A1))
def _add_square(A, a, u):
    """``A += a u u'``."""
    n = u.shape[0]
    for i in range(n):
        row, b = A[i], a * u[i]
        for j in range(n):
            row[j] += b * u[j]


@inner(F(F, F))
def _remaining(c, q):
    """``c + q``, which rounding must not turn negative."""
    return max(c + q, 100.0 * EPS * q)


@inner(INT(F, A1, A1, A1, A3, A3))
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


@inner(types.void(A3, A3, A1, A1, A1, A1, F, F, INT, F))
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


@inner(INT(I1, INT, F, F, A1, A1, A1, A1, A1))
def absorb(p, b, prior, s2, k, Ck, t, figures, error):
    """One sample of model b, see ``recursion.absorb``; returns the event. Its input is in the free slot.

    Args:
        prior: k(x, x).
        Ck: is overwritten.
        figures: novelty, nis, weight and latent variance.
        error: innovation.
    """
    M, m = k.shape[0], t.shape[0]
    active, count = vector_at(p[P.ACTIVE], b, M), integers_at(p[P.COUNT], b, 1)
    slot_, level = integers_at(p[P.SLOT], b, 1), vector_at(p[P.DISTRUSTED], b, 1)
    moments, vectors = stack_at(p[P.MOMENTS], b, 3, M, M), stack_at(p[P.VECTORS], b, 2, M, m)
    constants = vector_at(p[P.FIGURES], 0, 3)
    threshold, jitter, robust = constants[0], constants[1], constants[2]
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
