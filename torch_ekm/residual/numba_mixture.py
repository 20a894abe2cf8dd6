"""The experts of a mixture as compiled loops over a fleet (extra ``fast``).

Equations and names are those of :class:`~torch_ekm.residual.MixtureResidual` and
:class:`~torch_ekm.residual.tails.ScaleMixture`, which stay the reference. Arrays of two axes have a row for
each output of each model, all but ``experts``: rows h, kappa, rho, beta, c, a column for each expert, those
of the first learner first. Logarithms and exponentials of all experts are numpy's, which are vectorised,
between the calls.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

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
from .sparse_gp.engine.numba_kernels import _A1, _A2, _COMMON, _F, _INNER, _TINY
from .tails import LARGEST, MEMORY

_ON = types.boolean[::1]
#: entries of ``figures``
_Z, _SCALE = 0, 1


@njit(_F(_F), **_INNER)
def _bounded(z):
    return min(max(z, -FARTHEST), FARTHEST) if z == z else FARTHEST


@njit(_F(_A1, _A1), **_INNER)
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


@njit(types.void(_A1, _A2, _A2, _A2, _A2, _A2, _A2, _A2, _A1, _A1, _A1, _A2, _A2, _A2, _A2, _A2), **_COMMON)
def measure_fleet(
    y, means, variances, experts, innovation, level, gain, mass, offset, inflation, largest, log_scale,
    tail_evidence, far, ratio, figures,
):  # fmt: skip
    r"""How far y lies from each expert's mean: ``far`` in typical scales, ``ratio = r / 10`` as it is judged.

    Args:
        means, variances: of the learners' predictions of y.
        largest: \|mean\| of the mixture, of each output.
        figures: standardised innovation of the mixture's mean, and typical scale, of each output.
    """
    h, kappa, n_learners = experts[0], experts[1], means.shape[1]
    each, n_shares = experts.shape[1] // n_learners, mass.shape[1] // n_learners
    for o in range(y.shape[0]):
        mean, variance = offset[o], 0.0
        for i in range(n_learners):
            mean += gain[o, i] * means[o, i]
            for s in range(n_shares):
                variance += mass[o, i * n_shares + s] * variances[o, i]
        mean, deviation = min(max(mean, -largest[o]), largest[o]), math.sqrt(variance)
        typical = _typical(log_scale[o], tail_evidence[o])
        scale = deviation * typical
        figures[o, _Z], figures[o, _SCALE] = _bounded((y[o] - mean) / deviation), scale
        width = min(max(RMS_LEAST * math.sqrt(inflation[o]) / typical, 1.0), RMS_MOST)
        w, lev, row = innovation[o], level[o], far[o]
        for i in range(n_learners):
            for e in range(i * each, (i + 1) * each):
                row[e] = h[e] * means[o, i] - kappa[e] * w[e]
        for e in range(row.shape[0]):
            row[e] = (y[o] - (row[e] + lev[e])) / scale
        squares, by = ratio[o], 1.0 / (FREEDOM * width * width)
        for e in range(row.shape[0]):
            row[e] = _bounded(row[e])
            squares[e] = row[e] * row[e] * by


@njit(types.void(_F, _F, _A1, _A1, _A1, _A1, _A1), **_INNER)
def _follow_tails(z, since, rates, freedoms, constants, log_scale, evidence):
    """See ``ScaleMixture.observe``."""
    most, fastest = -np.inf, 0.5 / (1.0 + since / 4.0)
    for t in range(rates.shape[0]):
        nu = freedoms[t]
        r = (z / math.exp(log_scale[t])) ** 2
        density = constants[t] - log_scale[t] - 0.5 * (nu + 1.0) * math.log1p(r / nu)
        evidence[t] = MEMORY * evidence[t] + density
        most = max(most, evidence[t])
        moved = log_scale[t] + max(rates[t], fastest) * ((nu + 1.0) * r / (nu + r) - 1.0)
        log_scale[t] = min(max(moved, -LARGEST), LARGEST)
    for t in range(rates.shape[0]):
        evidence[t] -= most


@njit(
    types.void(
        _ON, _A2, _A2, _A2, _A2, _A1, _A2, _A2, _A2, _A2, _A1, _A1, _A1, _A1, _A1, _A2, _A2, _A1
    ),
    **_COMMON,
)  # fmt: skip
def fold_fleet(
    on, far, ratio, figures, experts, prior, evidence, innovation, level, trend, inflation, count,
    rates, freedoms, constants, log_scale, tail_evidence, nis,
):  # fmt: skip
    """Take one sample per model in, where ``on``.

    ``ratio`` is ``log(1 + ratio)`` now; it becomes the logarithm of the experts' weights, 0 at the largest.
    ``on`` becomes false where models are too young to be judged.

    Args:
        constants: log densities of the tails' laws at 0, at scale 1.
    """
    B, n = count.shape[0], experts.shape[1]
    m = far.shape[0] // B
    rho, beta, cap = experts[2], experts[3], experts[4]
    for b in range(B):
        nis[b], since = 0.0, max(count[b] - YOUNG, 0.0)
        rate = max(1.0 / (since + 2.0), RATE)
        judged = on[b] and count[b] >= YOUNG
        if on[b]:
            count[b] += 1.0
        on[b] = judged
        for o in range(b * m, (b + 1) * m):
            z, scale = figures[o, _Z], figures[o, _SCALE]
            if judged:
                w, lev, tre, ev, row, logs = innovation[o], level[o], trend[o], evidence[o], far[o], ratio[o]
                most = -np.inf
                for e in range(n):
                    ev[e] = MEMORY * ev[e] - 0.5 * (FREEDOM + 1.0) * logs[e]
                for e in range(n):
                    most = max(most, ev[e])
                for e in range(n):
                    ev[e] = max(ev[e] - most, LEAST)
                for e in range(n):
                    a = row[e] / cap[e]
                    w[e] = scale * row[e] / (1.0 + a * a)
                for e in range(n):
                    tre[e] = TREND_DECAY * tre[e] + beta[e] * w[e]
                for e in range(n):
                    lev[e] = LEVEL_DECAY * lev[e] + rho[e] * w[e]
                for e in range(n):
                    lev[e] += tre[e]
                    if not abs(lev[e]) <= FARTHEST * scale:
                        lev[e] = tre[e] = 0.0
                most = -np.inf
                for e in range(n):
                    logs[e] = prior[e] + ev[e]
                for e in range(n):
                    most = max(most, logs[e])
                for e in range(n):
                    logs[e] -= most
                square = min(z * z, SQUARE_MOST * inflation[o])
                inflation[o] = max(inflation[o] + rate * (square - inflation[o]), 1e-12)
                _follow_tails(z, since, rates, freedoms, constants, log_scale[o], tail_evidence[o])
            nis[b] += z * z / inflation[o] / m


@njit(types.void(_ON, _A2, _A2, _A2, _A2, _A2, _A2, _A2, _A2, _A1), **_COMMON)
def settle_fleet(on, p, experts, innovation, level, mass, shift, spread, gain, offset):
    """What queries need of the experts, from weights p that do not sum to 1 yet, see ``_settle``."""
    h, kappa, n_groups = experts[0], experts[1], mass.shape[1]
    each, m = experts.shape[1] // n_groups, p.shape[0] // on.shape[0]
    n_shares = n_groups // gain.shape[1]
    for o in range(p.shape[0]):
        if not on[o // m]:
            continue
        row, w, lev, total = p[o], innovation[o], level[o], 0.0
        for e in range(row.shape[0]):
            total += row[e]
        for i in range(gain.shape[1]):
            gain[o, i] = 0.0
        offset[o] = 0.0
        for g in range(n_groups):
            held, carried, apart = 0.0, 0.0, 0.0
            for e in range(g * each, (g + 1) * each):
                held += row[e]
                carried += row[e] * (lev[e] - kappa[e] * w[e])
            middle = carried / max(held, _TINY)
            for e in range(g * each, (g + 1) * each):
                apart += row[e] * (lev[e] - kappa[e] * w[e] - middle) ** 2
            mass[o, g], shift[o, g], spread[o, g] = held / total, middle, apart / total
            gain[o, g // n_shares] += held / total * h[g * each]
            offset[o] += carried / total


@njit(types.void(_A2, _A2, _A2, _A2, _A2, _A2, _A2, _A2, _A1, _A1, _A1, _A2), **_COMMON)
def combine_fleet(means, latent, noisy, experts, gain, mass, shift, spread, offset, inflation, largest, out):
    """Mean and deviations of g and of y in the rows of ``out``, see ``MixtureResidual.predict``.

    Args:
        means, latent, noisy: of the learners' predictions, variances of g and of y.
    """
    n_learners = means.shape[1]
    n_shares, each = mass.shape[1] // n_learners, experts.shape[1] // mass.shape[1]
    for o in range(means.shape[0]):
        mean, variance, scatter = offset[o], 0.0, 0.0
        for i in range(n_learners):
            mean += gain[o, i] * means[o, i]
        mean = min(max(mean, -largest[o]), largest[o])
        for i in range(n_learners):
            for s in range(n_shares):
                g = i * n_shares + s
                h, p = experts[0, g * each], mass[o, g]
                scatter += p * noisy[o, i]
                variance += p * (h * h * latent[o, i] + (h * means[o, i] + shift[o, g] - mean) ** 2)
                variance += spread[o, g]
        scatter = math.sqrt(scatter) * math.sqrt(inflation[o])
        out[0, o], out[1, o], out[2, o] = mean, min(math.sqrt(variance), scatter), scatter
