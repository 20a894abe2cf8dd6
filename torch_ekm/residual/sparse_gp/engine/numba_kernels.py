"""The recursion of a sparse GP and its predictions as compiled loops over a fleet (extra ``fast``).

Equations and names are those of :mod:`~torch_ekm.residual.sparse_gp.engine.recursion` and
:mod:`~torch_ekm.residual.sparse_gp.posterior`, which stay the reference. All arrays are C-contiguous and
float64, the fleet's axis first; most are views of the learner's buffers and change in place. What all
models share (a kernel, plain units) has length 1 there. No call holds the GIL, none is parallel: numba
and other libraries may not share one OpenMP runtime.

Loops over the last axis touch two or three arrays each: with more the compiler gives up proving that they
do not overlap, and does not vectorise. Entries are assigned one by one: an assignment of an array to a slice
can fail, and numba compiles the message with it, for seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from ..monitor import DISTRUSTED, DISTRUSTED_MOST, RATE
from .recursion import TIE, TIE_KL

#: what a kernel's ``kind`` means; GIVEN: its values come with the call
SQUARED_EXPONENTIAL, MATERN32, MATERN52, GIVEN = 0, 1, 2, 3
#: entries of ``flags``
KIND, ACTIONS = 0, 1

_EPS, _TINY = np.finfo(np.float64).eps, np.finfo(np.float64).tiny
# NaN and infinity keep their meaning: samples are tested for them in here.
_COMMON = {
    "cache": True, "nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
}  # fmt: skip
_INNER = {**_COMMON, "no_cpython_wrapper": True}  # called from loops alone
_A1, _A2, _A3, _A4 = (types.Array(types.float64, n, "C") for n in (1, 2, 3, 4))
_I1, _F = types.Array(types.int64, 1, "C"), types.float64
_HYPER = (_A2, _A1, _A2)  # log lengthscales, log variance, log action variances
_UNITS = (_A2, _A2, _A2, _A2, _A1)  # shift and scale of inputs and of outputs, reach of inputs


@njit(types.Tuple((_F, _F))(types.int64, _F), **_INNER)
def _phi_psi(kind, d2):
    """Correlation and ``-2 dphi/d(d2)`` at a squared scaled distance, see StationaryKernel."""
    if kind == SQUARED_EXPONENTIAL:
        phi = math.exp(-0.5 * d2)
        return phi, phi
    if kind == MATERN32:
        r = math.sqrt(3.0 * d2)
        decay = math.exp(-r)
        return (1.0 + r) * decay, 3.0 * decay
    r = math.sqrt(5.0 * d2)
    decay = math.exp(-r)
    return (1.0 + r + r * r / 3.0) * decay, (5.0 / 3.0) * (1.0 + r) * decay


@njit(_F(_I1, _A1, _A2, _A1, _A1, _F, _A1, _A1, _A2, types.boolean), **_INNER)
def _kernel(flags, z, basis, active, log_lengthscale, log_variance, log_action, k, dk, slopes):
    """k (and with ``slopes`` dk) between z and the basis; returns k(z, z)."""
    kind, n_a = flags[KIND], flags[ACTIONS]
    n_s = z.shape[0] - n_a
    start = 0.0 if n_s > 0 else 1.0  # without a state it is a LinearKernel, which has a constant
    variance, w, lam = math.exp(log_variance), np.exp(-log_lengthscale), np.exp(log_action)
    for i in range(basis.shape[0]):
        if active[i] == 0.0:
            k[i] = 0.0
            if slopes:
                dk[i, :] = 0.0
            continue
        d2 = 0.0
        for j in range(n_s):
            u = (basis[i, j] - z[j]) * w[j]
            d2 += u * u
        phi, psi = _phi_psi(kind, d2)
        phi, psi, inner = variance * phi, variance * psi, 1.0
        if n_a > 0:
            inner = start
            for j in range(n_a):
                inner += z[n_s + j] * lam[j] * basis[i, n_s + j]
        k[i] = phi * inner
        if slopes:
            psi *= inner
            for j in range(n_s):
                dk[i, j] = psi * (basis[i, j] - z[j]) * w[j] * w[j]
            for j in range(n_a):
                dk[i, n_s + j] = phi * lam[j] * basis[i, n_s + j]
    if n_a == 0:
        return variance
    norm = start
    for j in range(n_a):
        norm += z[n_s + j] * z[n_s + j] * lam[j]
    return variance * norm


@njit(types.void(_A2, _A1, _A1), **_INNER)
def _times(matrix, vector, out):
    """``out = matrix vector``, for a matrix that is symmetric: its rows lie together."""
    n = vector.shape[0]
    for i in range(n):
        row, total = matrix[i], 0.0
        for j in range(n):
            total += row[j] * vector[j]
        out[i] = total


@njit(_F(_F, _F), **_INNER)
def _remaining(c, q):
    """``c + q``, which rounding must not turn negative."""
    return max(c + q, 100.0 * _EPS * q)


@njit(types.int64(_F, _A1, _A1, _A1, _A3, _A3), **_INNER)
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


@njit(types.void(_A3, _A3, _A1, _A1, _A1, _A1, _F, _F, types.int64, _F), **_INNER)
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
    types.int64(_A1, _A1, _F, _F, _A1, _A2, _A1, _I1, _I1, _A3, _A3, _A1, _A1, _F, _F, _A1, _A1),
    **_INNER,
)
def _absorb(
    z, t, prior, s2, k, basis, active, count, slot_, moments, vectors, robust, level, threshold,
    jitter, figures, error,
):  # fmt: skip
    """One sample of one model, see ``absorb``; returns the event."""
    M, m = k.shape[0], t.shape[0]
    capacity, slot = M - 1, slot_[0]
    C, Q, W = moments[0], moments[1], moments[2]
    prior *= 1.0 + jitter
    Ck, e = np.empty(M), np.empty(M)
    _times(C, k, Ck)
    _times(Q, k, e)
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
    if robust.shape[0] > 0:
        distrusted = 1.0 if nis > robust[0] else 0.0
        if distrusted:
            trust = (DISTRUSTED_MOST - level[0]) / (DISTRUSTED_MOST - DISTRUSTED)
            weight = (robust[0] / nis) ** min(max(trust, 0.0), 1.0)
        level[0] += RATE * (distrusted - level[0])
        noise = (s2 + v) / weight - v
    full = count[0] == capacity
    novel = gamma > threshold * prior
    dropped = 0.0 if novel else gamma
    gain, precision = 1.0 / (noise + v - dropped), s2 / noise
    for j in range(z.shape[0]):
        basis[slot, j] = z[j]
    figures[0], figures[1], figures[2], figures[3] = gamma / max(prior, _TINY), nis, weight, v

    s = Ck
    if novel:
        s[slot] += 1.0
        W[slot, slot] += precision
        for o in range(m):
            vectors[1, slot, o] += t[o] * precision
    else:
        for i in range(M):
            s[i] += e[i]
            row, a = W[i], precision * e[i]
            for j in range(M):
                row[j] += a * e[j]
            for o in range(m):
                vectors[1, i, o] += e[i] * t[o] * precision
    for i in range(M):
        for o in range(m):
            vectors[0, i, o] += s[i] * error[o] * gain
    if not novel:
        for i in range(M):
            row, a = C[i], -gain * s[i]
            for j in range(M):
                row[j] += a * s[j]
        return 1
    active[slot] = 1.0
    e[slot] -= 1.0  # p of the recursion
    grow = 1.0 / gamma
    if not full:
        for i in range(M):
            row, a = C[i], -gain * s[i]
            for j in range(M):
                row[j] += a * s[j]
            row, a = Q[i], grow * e[i]
            for j in range(M):
                row[j] += a * e[j]
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


@njit(types.void(_A2, _A2, _A2), **_INNER)
def _slopes(alpha, dk, out):
    """``out = alpha' dk``."""
    out[:] = 0.0
    for i in range(alpha.shape[0]):
        for o in range(alpha.shape[1]):
            row, a = out[o], alpha[i, o]
            for j in range(dk.shape[1]):
                row[j] += a * dk[i, j]


@njit(
    types.void(
        _I1, types.boolean[::1], _A1, _A1, _A2, _A1,
        _A3, _A2, _I1, _I1, _A4, _A4,
        *_HYPER, _A2, *_UNITS, _A1, _A1, _F, _F, _I1, _A2, _A1,
    ),
    **_COMMON,
)  # fmt: skip
def absorb_fleet(
    flags, on, x, y, given_k, given_prior,
    basis, active, count, slot, moments, vectors,
    log_lengthscale, log_variance, log_action, log_noise, shift, scale, shift_y, scale_y, reach,
    robust, levels, threshold, jitter, event, figures, errors,
):  # fmt: skip
    """One sample per model where ``on``.

    Args:
        flags: kind of kernel, width of the action.
        x, y, errors: one model's after the other's.
        given_k, given_prior: k and k** of a kernel that is not known here, in the learner's units.
        robust, levels: square of a robust weight's threshold, share of samples distrusted; or empty.
        figures: novelty, nis, weight and latent variance of each model; as they are where not ``on``.
        errors: innovations.
    """
    B, d, m = basis.shape[0], basis.shape[2], log_noise.shape[1]
    z, t = np.empty(d), np.empty(m)
    k, none = np.empty(basis.shape[1]), np.empty((0, 0))
    found = np.empty(4)
    for b in range(B):
        if not on[b]:
            continue
        own, unit = min(b, log_variance.shape[0] - 1), min(b, shift.shape[0] - 1)
        for j in range(d):
            z[j] = min(max((x[b * d + j] - shift[unit, j]) / scale[unit, j], -reach[j]), reach[j])
        log_s2 = 0.0
        for o in range(m):
            t[o] = (y[b * m + o] - shift_y[unit, o]) / scale_y[unit, o]
            log_s2 += log_noise[b, o]
        s2 = math.exp(log_s2 / m)
        if flags[KIND] == GIVEN:
            prior = given_prior[b]
            for i in range(k.shape[0]):
                k[i] = given_k[b, i] * active[b, i]
        else:
            prior = _kernel(
                flags, z, basis[b], active[b], log_lengthscale[own], log_variance[own], log_action[own],
                k, none, False,
            )  # fmt: skip
        event[b] = _absorb(
            z, t, prior, s2, k, basis[b], active[b], count[b : b + 1], slot[b : b + 1], moments[b],
            vectors[b], robust, levels[b : b + 1], threshold, jitter, found, errors[b * m : (b + 1) * m],
        )  # fmt: skip
        for r in range(4):
            figures[r, b] = found[r]


@njit(
    types.void(
        _I1, _A1, _A3, _A2, _A4, _A4, *_HYPER, *_UNITS, _A2, types.boolean, types.boolean, _A1, _A1, _A1, _A1
    ),
    **_COMMON,
)  # fmt: skip
def query_fleet(
    flags, x, basis, active, moments, vectors,
    log_lengthscale, log_variance, log_action, shift, scale, shift_y, scale_y, reach, most,
    with_variance, with_slopes, mean, variance, jacobian, slope,
):  # fmt: skip
    r"""One query per model, in the outputs' own units: see ``SparseOnlineGP.predict_with_jacobians``.

    Args:
        most: largest \|mean\|, of each model and output.
    """
    B, M, d, m = basis.shape[0], basis.shape[1], basis.shape[2], vectors.shape[3]
    n_a, J = flags[ACTIONS], np.empty((m, d))
    z, k, Ck, dv = np.empty(d), np.empty(M), np.zeros(M), np.zeros(d)
    dk = np.empty((M, d)) if with_slopes else np.empty((0, 0))
    for b in range(B):
        own, unit = min(b, log_variance.shape[0] - 1), min(b, shift.shape[0] - 1)
        for j in range(d):
            z[j] = min(max((x[b * d + j] - shift[unit, j]) / scale[unit, j], -reach[j]), reach[j])
        prior = _kernel(
            flags, z, basis[b], active[b], log_lengthscale[own], log_variance[own], log_action[own],
            k, dk, with_slopes,
        )  # fmt: skip
        alpha = vectors[b, 0]
        value = mean[b * m : (b + 1) * m]
        value[:] = 0.0
        for i in range(M):
            for o in range(m):
                value[o] += alpha[i, o] * k[i]
        for o in range(m):
            value[o] = value[o] * scale_y[unit, o] + shift_y[unit, o]
        if with_slopes:
            _slopes(alpha, dk, J)
            for o in range(m):
                inside = abs(value[o]) <= most[b, o]
                for j in range(d):
                    slope_j = J[o, j] * scale_y[unit, o] / scale[unit, j]
                    jacobian[(b * m + o) * d + j] = slope_j if inside and abs(z[j]) < reach[j] else 0.0
        for o in range(m):
            value[o] = min(max(value[o], -most[b, o]), most[b, o])
        if not with_variance:
            continue
        _times(moments[b, 0], k, Ck)
        v = prior
        for i in range(M):
            v += Ck[i] * k[i]
        v = max(v, 0.0)
        for o in range(m):
            variance[b * m + o] = v * scale_y[unit, o] * scale_y[unit, o]
        if with_slopes:
            dv[:] = 0.0
            for i in range(M):
                a = 2.0 * Ck[i]
                for j in range(d):
                    dv[j] += a * dk[i, j]
            for j in range(n_a):  # k(x, x) of an action-linear kernel
                dv[d - n_a + j] += 2.0 * z[d - n_a + j] * math.exp(log_variance[own] + log_action[own, j])
            for o in range(m):
                for j in range(d):
                    by = scale_y[unit, o] * scale_y[unit, o] / scale[unit, j]
                    slope[(b * m + o) * d + j] = dv[j] * by if abs(z[j]) < reach[j] else 0.0
