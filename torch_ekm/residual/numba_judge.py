"""How a mixture judges its experts as compiled loops, one output of one model at a time.

Equations and names are those of :class:`~torch_ekm.residual.MixtureResidual` and
:class:`~torch_ekm.residual.tails.ScaleMixture`, which stay the reference. ``g`` is a mixture's row of
:mod:`~torch_ekm.residual.sparse_gp.plan`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from . import local_noise as L
from . import tails as E
from .base import FARTHEST as FARTHEST_MEAN
from .sparse_gp import plan as P
from .sparse_gp.engine.numba_math import exp, log
from .sparse_gp.engine.numba_memory import A1, A2, I1, INT, TINY, F, inner, matrix_at, vector_at
from .tails import LARGEST, MEMORY

_N = len(L.SHARES)


@inner(F(F))
def _bounded(z):
    return min(max(z, -E.FARTHEST), E.FARTHEST) if z == z else E.FARTHEST


@inner(F(A1, A1))
def _believed(values, evidence):
    """Their mean, weighted by evidence."""
    most, total, mean = -np.inf, 0.0, 0.0
    for t in range(evidence.shape[0]):
        most = max(most, evidence[t])
    for t in range(evidence.shape[0]):
        p = math.exp(evidence[t] - most)
        total += p
        mean += p * values[t]
    return mean / total


@inner(types.void(I1, INT, F, F))
def _follow_tails(g, o, z, since):
    """See ``ScaleMixture.observe``."""
    n = g[P.N_TAILS]
    log_scale, evidence = vector_at(g[P.TAIL_SCALE], o, n), vector_at(g[P.TAIL_EVIDENCE], o, n)
    rates, freedoms, at_zero = (
        vector_at(g[P.RATES_OF_TAILS], 0, n), vector_at(g[P.FREEDOMS], 0, n), vector_at(g[P.AT_ZERO], 0, n)
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


@inner(F(I1, INT))
def share_of_noise(g, o):
    """s of LocalNoise."""
    return _believed(vector_at(g[P.NOISE_SHARES], 0, _N), vector_at(g[P.NOISE_EVIDENCE], o, _N))


@inner(F(I1, INT, F, F))
def _target_of_noise(g, o, size, f):
    """What f learns of a log innovation, after its evidence, see ``LocalNoise.observe``."""
    n, most = _N, -np.inf
    shares, evidence = vector_at(g[P.NOISE_SHARES], 0, n), vector_at(g[P.NOISE_EVIDENCE], o, n)
    for s in range(n):
        log_scale = shares[s] * f
        z2 = math.exp(2.0 * (size - log_scale))
        evidence[s] = L.MEMORY * evidence[s] - log_scale
        evidence[s] -= 0.5 * (L.FREEDOM + 1.0) * math.log1p(z2 / L.FREEDOM)
        most = max(most, evidence[s])
    for s in range(n):
        evidence[s] -= most
    return math.log(min(math.exp(size - f), L.MOST) + L.FLOOR) + L.CENTRE + f


@inner(types.void(I1, INT, F, A1, A1))
def _weigh(g, o, scale, far, p):
    """Evidence and what is carried over, from innovations ``far`` in typical scales; ``p``: ``r / 10``.

    ``p`` becomes the experts' weights, 1 at the largest.
    """
    n, most = g[P.N_EXPERTS], -np.inf
    experts, prior = matrix_at(g[P.EXPERTS], 0, 5, n), vector_at(g[P.PRIOR], 0, n)
    rho, beta, cap = experts[2], experts[3], experts[4]
    evidence, w = vector_at(g[P.EVIDENCE], o, n), vector_at(g[P.INNOVATION], o, n)
    level, trend = vector_at(g[P.LEVEL], o, n), vector_at(g[P.TREND], o, n)
    for e in range(n):
        p[e] = log(1.0 + p[e])
    for e in range(n):
        evidence[e] = MEMORY * evidence[e] - 0.5 * (E.FREEDOM + 1.0) * p[e]
    for e in range(n):
        most = max(most, evidence[e])
    for e in range(n):
        evidence[e] = max(evidence[e] - most, E.LEAST)
    for e in range(n):
        a = far[e] / cap[e]
        w[e] = scale * far[e] / (1.0 + a * a)
    for e in range(n):
        trend[e] = E.TREND_DECAY * trend[e] + beta[e] * w[e]
    for e in range(n):
        level[e] = E.LEVEL_DECAY * level[e] + rho[e] * w[e]
    for e in range(n):
        level[e] += trend[e]
    for e in range(n):  # what is farther off is of a time when y was another size
        trend[e] = trend[e] if abs(level[e]) <= E.FARTHEST * scale else 0.0
    for e in range(n):
        level[e] = level[e] if abs(level[e]) <= E.FARTHEST * scale else 0.0
    most = -np.inf
    for e in range(n):
        p[e] = prior[e] + evidence[e]
    for e in range(n):
        most = max(most, p[e])
    for e in range(n):
        p[e] = exp(p[e] - most)


@inner(types.void(I1, INT, INT, A1, A1))
def _settle(g, o, n_learners, p, carried):
    """What queries need of the experts, from weights p that do not sum to 1 yet, see ``_settle``.

    ``carried``: room for what each carries over. Each group is a view: an index that does not begin at 0 may
    be negative for all that the compiler knows, and it does not vectorise.
    """
    n, n_shares, total = g[P.N_EXPERTS], g[P.N_SHARES], 0.0
    n_groups = n_learners * n_shares
    each, experts = n // n_groups, matrix_at(g[P.EXPERTS], 0, 5, n)
    h, kappa = experts[0], experts[1]
    w, level = vector_at(g[P.INNOVATION], o, n), vector_at(g[P.LEVEL], o, n)
    gain, offset = vector_at(g[P.GAIN], o, n_learners), vector_at(g[P.OFFSET], o, 1)
    mass, spread = vector_at(g[P.MASS], o, n_groups), vector_at(g[P.SPREAD], o, n_groups)
    shift = vector_at(g[P.SHIFTS], o, n_groups)
    for e in range(n):
        total += p[e]
    for e in range(n):
        carried[e] = level[e] - kappa[e] * w[e]
    gain[:] = 0.0
    offset[0] = 0.0
    for k in range(n_groups):
        own, values = p[k * each : (k + 1) * each], carried[k * each : (k + 1) * each]
        held, sum_, apart = 0.0, 0.0, 0.0
        for e in range(each):
            held += own[e]
        for e in range(each):
            sum_ += own[e] * values[e]
        middle = sum_ / max(held, TINY)
        for e in range(each):
            apart += own[e] * (values[e] - middle) ** 2
        mass[k], shift[k], spread[k] = held / total, middle, apart / total
        gain[k // n_shares] += held / total * h[k * each]
        offset[0] += sum_ / total


@inner(F(I1, INT, A1))
def mean_of(g, o, means):
    """The mixture's, not yet cut at twice the largest y."""
    mean, gain = vector_at(g[P.OFFSET], o, 1)[0], vector_at(g[P.GAIN], o, means.shape[0])
    for i in range(means.shape[0]):
        mean += gain[i] * means[i]
    return mean


@inner(F(I1, INT, A1))
def scatter_of(g, o, noisy):
    """Variance of y as the learners state it, by their weights."""
    n_learners, n_shares, variance = noisy.shape[0], g[P.N_SHARES], 0.0
    mass = vector_at(g[P.MASS], o, n_learners * n_shares)
    for k in range(mass.shape[0]):
        variance += mass[k] * noisy[k // n_shares]
    return variance


@inner(types.boolean(I1, INT, A1, A1))
def make_finite(g, o, means, variances):
    """See ``finite`` and ``_wide`` of the mixture; whether any mean was finite."""
    most, known = vector_at(g[P.LARGEST], o, 1)[0], False
    for i in range(means.shape[0]):
        known |= math.isfinite(means[i])
        means[i] = means[i] if math.isfinite(means[i]) else 0.0
        variances[i] = variances[i] if math.isfinite(variances[i]) else most * most
    return known


@inner(F(I1, INT, F, types.boolean, F, A1, A1, A1, A1, A1, A2))
def judge(g, o, y, judged, since, means, noisy, far, p, local, said):
    """One output of one model: how far y lies from each expert's mean, and what follows; returns the nis.

    ``local``: f of LocalNoise for each output, which becomes what it is to learn; ``said``: room for the
    mean and typical deviation.
    """
    n, n_learners = g[P.N_EXPERTS], means.shape[0]
    each, inflation = n // n_learners, vector_at(g[P.INFLATION], o, 1)
    experts, most = matrix_at(g[P.EXPERTS], 0, 5, n), FARTHEST_MEAN * vector_at(g[P.LARGEST], o, 1)[0]
    h, kappa = experts[0], experts[1]
    f = min(max(local[o], -L.REACH), L.REACH)
    log_factor = share_of_noise(g, o) * f
    mean = min(max(mean_of(g, o, means), -most), most)
    deviation = math.sqrt(scatter_of(g, o, noisy)) * math.exp(log_factor)
    z, tails = _bounded((y - mean) / deviation), g[P.N_TAILS]
    log_scale = vector_at(g[P.TAIL_SCALE], o, tails)
    typical = math.exp(_believed(log_scale, vector_at(g[P.TAIL_EVIDENCE], o, tails)))
    scale = deviation * typical
    said[0, o], said[1, o] = mean, scale
    if judged:
        width = min(max(E.RMS_LEAST * math.sqrt(inflation[0]) / typical, 1.0), E.RMS_MOST)
        w, level = vector_at(g[P.INNOVATION], o, n), vector_at(g[P.LEVEL], o, n)
        for i in range(n_learners):
            to, share = far[i * each : (i + 1) * each], h[i * each : (i + 1) * each]
            for e in range(each):
                to[e] = share[e] * means[i]
        for e in range(n):
            far[e] -= kappa[e] * w[e]
        for e in range(n):
            far[e] = (y - (far[e] + level[e])) / scale
        by = 1.0 / (E.FREEDOM * width * width)
        for e in range(n):
            far[e] = _bounded(far[e])
        for e in range(n):
            p[e] = far[e] * far[e] * by
        _weigh(g, o, scale, far, p)
        _settle(g, o, n_learners, p, far)
        square = min(z * z, E.SQUARE_MOST * inflation[0])
        rate = max(1.0 / (since + 2.0), E.RATE)
        inflation[0] = max(inflation[0] + rate * (square - inflation[0]), 1e-12)
        local[o] = _target_of_noise(g, o, math.log(max(abs(z) / typical, TINY)) + log_factor, f)
        _follow_tails(g, o, z, since)
    return z * z / inflation[0]
