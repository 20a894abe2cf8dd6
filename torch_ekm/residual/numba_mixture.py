"""A mixture and its sparse GPs as compiled loops on their own memory.

Equations and names are those of :class:`~torch_ekm.residual.MixtureResidual` and
:class:`~torch_ekm.residual.tails.ScaleMixture`, which stay the reference. ``g`` is a row of sizes and
addresses as in the first lines here, ``members`` has one row of
:mod:`~torch_ekm.residual.sparse_gp.plan` for each learner; of another kind of learner it is 0, and
what it predicts is given.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from .base import FARTHEST as FARTHEST_MEAN
from .experts import (
    FARTHEST,
    FREEDOM,
    LEAST,
    LEVEL_DECAY,
    RATE,
    RMS_LEAST,
    RMS_MOST,
    SQUARE_MOST,
    TREND_DECAY,
    YOUNG,
)
from .sparse_gp import plan as P
from .sparse_gp.engine.numba_core import (
    are_finite,
    cut,
    grow_largest,
    learn,
    look,
    mean_and_variance,
    noise_of,
    note,
    query,
    query_fleet,
    update_fleet,
    values_of,
)  # fmt: skip
from .sparse_gp.engine.numba_math import (
    A1,
    A2,
    A3,
    COMMON,
    I1,
    I2,
    INNER,
    INT,
    ON,
    TINY,
    F,
    exp,
    log,
    matrix_at,
    vector_at,
)  # fmt: skip
from .tails import LARGEST, MEMORY

__all__ = ["are_finite", "query_fleet", "query_mixture", "update_fleet", "update_mixture"]

#: fields of ``g`` after those of a plan, of which it has MODELS, IN, OUT and LARGEST
(
    N_EXPERTS, N_SHARES, N_TAILS,
    EXPERTS,  # rows h, kappa, rho, beta, c, a column for each expert, those of the first learner first
    PRIOR, EVIDENCE, INNOVATION, LEVEL, TREND, GAIN, MASS, SHIFT, SPREAD, OFFSET, INFLATION, COUNT,
    RATES, FREEDOMS, AT_ZERO,  # of the tails' laws, and their log density at 0
    TAIL_SCALE, TAIL_EVIDENCE, FIELDS,
) = range(P.FIELDS, P.FIELDS + 22)  # fmt: skip


@njit(F(F), **INNER)
def _bounded(z):
    return min(max(z, -FARTHEST), FARTHEST) if z == z else FARTHEST


@njit(F(A1, A1), **INNER)
def _typical(log_scale, evidence):
    """See ``ScaleMixture.typical``."""
    most, total, mean = -np.inf, 0.0, 0.0
    for t in range(evidence.shape[0]):
        most = max(most, evidence[t])
    for t in range(evidence.shape[0]):
        p = math.exp(evidence[t] - most)
        total += p
        mean += p * log_scale[t]
    return math.exp(mean / total)


@njit(types.void(I1, INT, F, F), **INNER)
def _follow_tails(g, o, z, since):
    """See ``ScaleMixture.observe``."""
    n = g[N_TAILS]
    log_scale, evidence = vector_at(g[TAIL_SCALE], o, n), vector_at(g[TAIL_EVIDENCE], o, n)
    rates, freedoms, at_zero = (
        vector_at(g[RATES], 0, n), vector_at(g[FREEDOMS], 0, n), vector_at(g[AT_ZERO], 0, n)
    )  # fmt: skip
    most, fastest = -np.inf, 0.5 / (1.0 + since / 4.0)
    for t in range(n):
        nu = freedoms[t]
        r = (z / math.exp(log_scale[t])) ** 2
        density = at_zero[t] - log_scale[t] - 0.5 * (nu + 1.0) * math.log1p(r / nu)
        evidence[t] = MEMORY * evidence[t] + density
        most = max(most, evidence[t])
        moved = log_scale[t] + max(rates[t], fastest) * ((nu + 1.0) * r / (nu + r) - 1.0)
        log_scale[t] = min(max(moved, -LARGEST), LARGEST)
    for t in range(n):
        evidence[t] -= most


@njit(types.void(I1, INT, F, A1, A1), **INNER)
def _weigh(g, o, scale, far, p):
    """Evidence and what is carried over, from innovations ``far`` in typical scales; ``p``: ``r / 10``.

    ``p`` becomes the experts' weights, 1 at the largest.
    """
    n, most = g[N_EXPERTS], -np.inf
    experts, prior = matrix_at(g[EXPERTS], 0, 5, n), vector_at(g[PRIOR], 0, n)
    rho, beta, cap = experts[2], experts[3], experts[4]
    evidence, w = vector_at(g[EVIDENCE], o, n), vector_at(g[INNOVATION], o, n)
    level, trend = vector_at(g[LEVEL], o, n), vector_at(g[TREND], o, n)
    for e in range(n):
        p[e] = log(1.0 + p[e])
    for e in range(n):
        evidence[e] = MEMORY * evidence[e] - 0.5 * (FREEDOM + 1.0) * p[e]
    for e in range(n):
        most = max(most, evidence[e])
    for e in range(n):
        evidence[e] = max(evidence[e] - most, LEAST)
    for e in range(n):
        a = far[e] / cap[e]
        w[e] = scale * far[e] / (1.0 + a * a)
    for e in range(n):
        trend[e] = TREND_DECAY * trend[e] + beta[e] * w[e]
    for e in range(n):
        level[e] = LEVEL_DECAY * level[e] + rho[e] * w[e]
    for e in range(n):
        level[e] += trend[e]
        if not abs(level[e]) <= FARTHEST * scale:
            level[e] = trend[e] = 0.0
    most = -np.inf
    for e in range(n):
        p[e] = prior[e] + evidence[e]
    for e in range(n):
        most = max(most, p[e])
    for e in range(n):
        p[e] = exp(p[e] - most)


@njit(types.void(I1, INT, INT, A1), **INNER)
def _settle(g, o, n_learners, p):
    """What queries need of the experts, from weights p that do not sum to 1 yet, see ``_settle``."""
    n, n_shares, total = g[N_EXPERTS], g[N_SHARES], 0.0
    n_groups = n_learners * n_shares
    each, experts = n // n_groups, matrix_at(g[EXPERTS], 0, 5, n)
    h, kappa = experts[0], experts[1]
    w, level = vector_at(g[INNOVATION], o, n), vector_at(g[LEVEL], o, n)
    gain, offset = vector_at(g[GAIN], o, n_learners), vector_at(g[OFFSET], o, 1)
    mass, spread = vector_at(g[MASS], o, n_groups), vector_at(g[SPREAD], o, n_groups)
    shift = vector_at(g[SHIFT], o, n_groups)
    for e in range(n):
        total += p[e]
    gain[:] = 0.0
    offset[0] = 0.0
    for k in range(n_groups):
        held, carried, apart = 0.0, 0.0, 0.0
        for e in range(k * each, (k + 1) * each):
            held += p[e]
        for e in range(k * each, (k + 1) * each):
            carried += p[e] * (level[e] - kappa[e] * w[e])
        middle = carried / max(held, TINY)
        for e in range(k * each, (k + 1) * each):
            apart += p[e] * (level[e] - kappa[e] * w[e] - middle) ** 2
        mass[k], shift[k], spread[k] = held / total, middle, apart / total
        gain[k // n_shares] += held / total * h[k * each]
        offset[0] += carried / total


@njit(F(I1, INT, A1), **INNER)
def _mean(g, o, means):
    """The mixture's, cut at twice the largest y."""
    mean, gain = vector_at(g[OFFSET], o, 1)[0], vector_at(g[GAIN], o, means.shape[0])
    for i in range(means.shape[0]):
        mean += gain[i] * means[i]
    return mean


@njit(F(I1, INT, A1), **INNER)
def _scatter(g, o, noisy):
    """Variance of y as the learners state it, by their weights."""
    n_learners, n_shares, variance = noisy.shape[0], g[N_SHARES], 0.0
    mass = vector_at(g[MASS], o, n_learners * n_shares)
    for k in range(mass.shape[0]):
        variance += mass[k] * noisy[k // n_shares]
    return variance


@njit(types.void(I1, INT, A1, A1), **INNER)
def _make_finite(g, o, means, variances):
    """See ``_finite`` and ``_wide`` of the mixture."""
    most = vector_at(g[P.LARGEST], o, 1)[0]
    for i in range(means.shape[0]):
        means[i] = means[i] if math.isfinite(means[i]) else 0.0
        variances[i] = variances[i] if math.isfinite(variances[i]) else most * most


@njit(F(I1, INT, F, types.boolean, F, A1, A1, A1, A1), **INNER)
def _judge(g, o, y, judged, since, means, noisy, far, p):
    """One output of one model: how far y lies from each expert's mean, and what follows; returns the nis."""
    n, n_learners = g[N_EXPERTS], means.shape[0]
    each, inflation = n // n_learners, vector_at(g[INFLATION], o, 1)
    experts, most = matrix_at(g[EXPERTS], 0, 5, n), FARTHEST_MEAN * vector_at(g[P.LARGEST], o, 1)[0]
    h, kappa = experts[0], experts[1]
    mean, deviation = min(max(_mean(g, o, means), -most), most), math.sqrt(_scatter(g, o, noisy))
    z = _bounded((y - mean) / deviation)
    if judged:
        tails = g[N_TAILS]
        typical = _typical(vector_at(g[TAIL_SCALE], o, tails), vector_at(g[TAIL_EVIDENCE], o, tails))
        scale = deviation * typical
        width = min(max(RMS_LEAST * math.sqrt(inflation[0]) / typical, 1.0), RMS_MOST)
        w, level = vector_at(g[INNOVATION], o, n), vector_at(g[LEVEL], o, n)
        for i in range(n_learners):
            for e in range(i * each, (i + 1) * each):
                far[e] = h[e] * means[i] - kappa[e] * w[e]
        for e in range(n):
            far[e] = (y - (far[e] + level[e])) / scale
        by = 1.0 / (FREEDOM * width * width)
        for e in range(n):
            far[e] = _bounded(far[e])
        for e in range(n):
            p[e] = far[e] * far[e] * by
        _weigh(g, o, scale, far, p)
        _settle(g, o, n_learners, p)
        square = min(z * z, SQUARE_MOST * inflation[0])
        rate = max(1.0 / (since + 2.0), RATE)
        inflation[0] = max(inflation[0] + rate * (square - inflation[0]), 1e-12)
        _follow_tails(g, o, z, since)
    return z * z / inflation[0]


@njit(types.void(I1, A3, A2), **INNER)
def _of_all(g, figures, of_all):
    """Novelty and weight of a sample, by the say of each learner."""
    m, n_learners = g[P.OUT], figures.shape[0]
    n_groups = n_learners * g[N_SHARES]
    for b in range(g[P.MODELS]):
        of_all[1, b] = of_all[2, b] = 0.0
        for r in range(b * m, (b + 1) * m):
            mass = vector_at(g[MASS], r, n_groups)
            for k in range(n_groups):
                i = k // g[N_SHARES]
                of_all[1, b] += mass[k] * figures[i, 0, b] / m
                of_all[2, b] += mass[k] * figures[i, 2, b] / m


@njit(INT(I1, I2, I2, ON, INT, INT, A2, A2, A3, I2, A3, A2), **COMMON)
def update_mixture(g, members, turns, on, x, y, means, noisy, figures, events, errors, of_all):
    """One sample per model where ``on``: all learners predict, the mixture judges them, they learn.

    Args:
        turns: what each learner does, see its plan.
        x, y: addresses.
        means, noisy: of y, from learners of other kinds, ``(models out, learners)``.
        figures, events, errors: see ``update_fleet``, one for each learner.
        of_all: nis, novelty and weight of the mixture, ``(3, models)``; the last two where all learned here.

    Returns:
        A bit for each learner of which a model faces another system.
    """
    B, d, m, n_learners = g[P.MODELS], g[P.IN], g[P.OUT], members.shape[0]
    far, p, inside = np.empty(g[N_EXPERTS]), np.empty(g[N_EXPERTS]), np.empty(m)
    mean, noise, t, found = np.empty(m), np.empty(m), np.empty(m), np.empty(4)
    total = 0
    for i in range(n_learners):
        if members[i, P.MODELS]:
            total += B * (values_of(members[i]) + members[i, P.WIDTH] + 2 * members[i, P.SLOTS] + 1)
    room, at = np.empty(total), 0  # what is found for predictions serves the update
    grow_largest(g, on, y)
    for i in range(n_learners):
        a = members[i]
        if not a[P.MODELS]:
            continue
        n, W, M = values_of(a), a[P.WIDTH], a[P.SLOTS]
        psi, phi = np.empty(M), np.empty(M)
        for b in range(B):
            values, q = room[at : at + n], room[at + n : at + n + W]
            k, Ck = room[at + n + W : at + n + W + M], room[at + n + W + M : at + n + W + 2 * M]
            prior = look(a, b, vector_at(x, b, d), values, q, k, psi, phi)
            v = mean_and_variance(a, b, prior, k, Ck, mean)
            cut(a, b, mean, inside)
            noise_of(a, b, noise)
            scale = vector_at(a[P.SCALE_Y], b * a[P.OWN_UNITS], m)
            for o in range(m):
                means[b * m + o, i] = mean[o]
                noisy[b * m + o, i] = v * scale[o] * scale[o] + noise[o]
            room[at + n + W + 2 * M] = prior
            at += n + W + 2 * M + 1
    for b in range(B):
        count, nis = vector_at(g[COUNT], b, 1), 0.0
        for r in range(b * m, (b + 1) * m):
            _make_finite(g, r, means[r], noisy[r])
            judged = on[b] and count[0] >= YOUNG
            since = max(count[0] - YOUNG, 0.0)
            nis += _judge(g, r, vector_at(y, r, 1)[0], judged, since, means[r], noisy[r], far, p) / m
        if on[b]:
            count[0] += 1.0
        of_all[0, b] = nis
    at, alarm = 0, 0
    for i in range(n_learners):
        a = members[i]
        if not a[P.MODELS]:
            continue
        n, W, M = values_of(a), a[P.WIDTH], a[P.SLOTS]
        for b in range(B):
            values, q = room[at : at + n], room[at + n : at + n + W]
            k, Ck = room[at + n + W : at + n + W + M], room[at + n + W + M : at + n + W + 2 * M]
            if on[b] and turns[i, P.MODE] != P.SKIP:
                prior = room[at + n + W + 2 * M]
                events[i, b] = learn(
                    a, b, values, q, k, Ck, prior, vector_at(y, b, m), t, found, errors[i, b]
                )
                for r in range(4):
                    figures[i, r, b] = found[r]
            at += n + W + 2 * M + 1
        if note(a, turns[i], on, x, y, figures[i], errors[i]):
            alarm |= 1 << i
    _of_all(g, figures, of_all)
    return alarm


@njit(types.void(I1, I2, INT, INT, INT, INT, INT, INT, INT), **COMMON)
def query_mixture(g, members, x, mean, variance, deviation, standard, J, dv):
    """One query per model; results by their addresses (0: not wanted), see ``MixtureResidual``.

    Args:
        variance, deviation: of g.
        standard: deviation of y by which innovations are standardised.
        J, dv: derivatives of mean and variance by x.
    """
    B, d, m, n = g[P.MODELS], g[P.IN], g[P.OUT], members.shape[0]
    n_shares, n_experts = g[N_SHARES], g[N_EXPERTS]
    with_variance, rows = variance != 0 or deviation != 0 or standard != 0, m if J else 0
    rows_dv = m if dv else 0
    h = matrix_at(g[EXPERTS], 0, 5, n_experts)[0]
    each = n_experts // (n * n_shares)
    means, latent, noisy = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    J_of, dv_of = np.empty((n, rows, d)), np.empty((n, rows_dv, d))
    one, v, noise = np.empty(m), np.empty(m), np.zeros(m)
    for b in range(B):
        for i in range(n):
            query(members[i], b, with_variance, vector_at(x, b, d), one, v, J_of[i], dv_of[i])
            if with_variance:
                noise_of(members[i], b, noise)
            for o in range(m):
                means[o, i], latent[o, i], noisy[o, i] = one[o], v[o], v[o] + noise[o]
        for o in range(m):
            r = b * m + o
            _make_finite(g, r, means[o], latent[o])
            _make_finite(g, r, means[o], noisy[o])
            free, most = _mean(g, r, means[o]), FARTHEST_MEAN * vector_at(g[P.LARGEST], r, 1)[0]
            value = min(max(free, -most), most)
            vector_at(mean, r, 1)[0] = value
            gain = vector_at(g[GAIN], r, n)
            if rows:
                to = vector_at(J, r, d)
                to[:] = 0.0
                if free == value:
                    for i in range(n):
                        for j in range(d):
                            s = J_of[i, o, j]
                            to[j] += gain[i] * s if math.isfinite(s) else 0.0
            if not with_variance:
                continue
            mass, shift = vector_at(g[MASS], r, n * n_shares), vector_at(g[SHIFT], r, n * n_shares)
            spread, total = vector_at(g[SPREAD], r, n * n_shares), 0.0
            for k in range(n * n_shares):
                i, share = k // n_shares, h[k * each]
                apart = share * means[o, i] + shift[k] - value
                total += mass[k] * (share * share * latent[o, i] + apart * apart) + spread[k]
            scatter = _scatter(g, r, noisy[o])
            bound = scatter * vector_at(g[INFLATION], r, 1)[0]
            if standard:
                vector_at(standard, r, 1)[0] = math.sqrt(scatter)
            if deviation:
                vector_at(deviation, r, 1)[0] = math.sqrt(min(total, bound))
            if variance:
                vector_at(variance, r, 1)[0] = min(total, bound)
            if rows_dv:
                to = vector_at(dv, r, d)
                to[:] = 0.0
                for k in range(n * n_shares):
                    i, share = k // n_shares, h[k * each]
                    apart = share * means[o, i] + shift[k] - value
                    by_v, by_m = mass[k] * share * share, 2.0 * mass[k] * apart * share
                    if total > bound:
                        by_v, by_m = mass[k] * vector_at(g[INFLATION], r, 1)[0], 0.0
                    for j in range(d):
                        s, f = dv_of[i, o, j], J_of[i, o, j]
                        to[j] += by_v * (s if math.isfinite(s) else 0.0) + by_m * (
                            f if math.isfinite(f) else 0.0
                        )
