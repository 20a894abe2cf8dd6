"""A mixture and its sparse GPs as compiled loops on their own memory.

Equations and names are those of :class:`~torch_ekm.residual.MixtureResidual` and
:class:`~torch_ekm.residual.tails.ScaleMixture`, which stay the reference. ``g`` is a mixture's row of
:mod:`~torch_ekm.residual.sparse_gp.plan`, ``members`` has one row for each learner, and one for the GP of
LocalNoise.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from . import local_noise as L
from . import tails as E
from .base import FARTHEST as FARTHEST_MEAN
from .numba_judge import judge, make_finite, mean_of, scatter_of, share_of_noise
from .sparse_gp import plan as P
from .sparse_gp.engine import numba_core as gp
from .sparse_gp.engine.numba_descent import gather_fleet as gather_fleet
from .sparse_gp.engine.numba_descent import step_fleet as step_fleet
from .sparse_gp.engine.numba_memory import A2, A3, COMMON, I1, I2, INT, ON, inner, matrix_at, vector_at
from .sparse_gp.engine.numba_rebuild import rebuild_fleet as rebuild_fleet
from .sparse_gp.engine.numba_units import pool_columns as pool_columns
from .sparse_gp.engine.numba_units import settle_columns as settle_columns

embed_fleet, query_fleet, update_fleet = gp.embed_fleet, gp.query_fleet, gp.update_fleet


@inner(types.void(I1, A3, I2, A2))
def _of_all(g, figures, events, of_all):
    """Novelty and weight of a sample by the say of each learner, and the largest event."""
    m, n_learners = g[P.OUT], figures.shape[0] - 1
    n_groups = n_learners * g[P.N_SHARES]
    for b in range(g[P.MODELS]):
        of_all[1, b] = of_all[2, b] = of_all[3, b] = 0.0
        for i in range(n_learners):
            of_all[3, b] = max(of_all[3, b], events[i, b])
        for r in range(b * m, (b + 1) * m):
            mass = vector_at(g[P.MASS], r, n_groups)
            for k in range(n_groups):
                i = k // g[P.N_SHARES]
                of_all[1, b] += mass[k] * figures[i, 0, b] / m
                of_all[2, b] += mass[k] * figures[i, 2, b] / m


@njit(INT(I1, I2, I1, ON, INT, INT, A2, A2), **COMMON)
def update_mixture(g, members, numbers, on, x, y, said, of_all):
    """One sample per model where ``on``: all learners predict, the mixture judges them, they learn.

    Args:
        numbers: of samples that each learner has seen.
        x, y: addresses.
        said: room for mean and typical deviation of y, ``(2, models out)``.
        of_all: room for nis, novelty, weight and event of the mixture, ``(4, models)``.

    Returns:
        A bit for each learner of which a model faces another system, and one that the noise learned; -1: a
        sample is not finite, and nothing was done.
    """
    if not gp.are_finite(g, x, y):
        return -1
    B, d, m, n_learners = g[P.MODELS], g[P.IN], g[P.OUT], members.shape[0] - 1
    far, p, inside = np.empty(g[P.N_EXPERTS]), np.empty(g[P.N_EXPERTS]), np.empty(m)
    mean, noise, found = np.empty(m), np.empty(m), np.empty(4)
    means, noisy, local = np.empty((B * m, n_learners)), np.empty((B * m, n_learners)), np.empty(B * m)
    figures, errors = np.zeros((n_learners + 1, 4, B)), np.zeros((n_learners + 1, B, m))
    events, judged_on = np.zeros((n_learners + 1, B), np.int64), np.empty(B, np.bool_)
    figures[:, 2] = 1.0  # the weight where there is no sample
    alarm = 0
    gp.grow_largest(g, on, y)
    for i in range(n_learners + 1):
        a = members[i]
        psi, phi = np.empty(a[P.SLOTS]), np.empty(a[P.SLOTS])
        for b in range(B):
            values, q, k, Ck, prior = gp.room_of(a, b)  # what is found for predictions serves the update
            prior[0] = gp.look(a, b, vector_at(x, b, d), values, q, k, psi, phi)
            v = gp.mean_and_variance(a, b, prior[0], k, Ck, mean)
            gp.cut(a, b, mean, inside)
            if i == n_learners:
                for o in range(m):
                    local[b * m + o] = mean[o]
            else:
                gp.noise_of(a, b, noise)
                scale = vector_at(a[P.SCALE_Y], b, m)
                for o in range(m):
                    means[b * m + o, i] = mean[o]
                    noisy[b * m + o, i] = v * scale[o] * scale[o] + noise[o]
    for b in range(B):
        count, nis = vector_at(g[P.N_SEEN], b, 1), 0.0
        judged = on[b] and count[0] >= E.YOUNG
        since = max(count[0] - E.YOUNG, 0.0)
        for r in range(b * m, (b + 1) * m):
            make_finite(g, r, means[r], noisy[r])
            nis += (
                judge(g, r, vector_at(y, r, 1)[0], judged, since, means[r], noisy[r], far, p, local, said) / m
            )
        judged_on[b] = judged
        alarm |= int(judged) << n_learners
        if on[b]:
            count[0] += 1.0
        of_all[0, b] = nis
    for i in range(n_learners + 1):
        a, learned, on_ = members[i], y, on
        if i == n_learners:
            learned, on_ = local.ctypes.data, judged_on
            if not alarm >> n_learners & 1:
                break
        for b in range(B):
            if on_[b]:
                events[i, b] = gp.learn(a, b, vector_at(learned, b, m), found, errors[i, b])
                for r in range(4):
                    figures[i, r, b] = found[r]
        if gp.note(a, numbers[i], on_, x, learned, figures[i], errors[i]):
            alarm |= 1 << i
    _of_all(g, figures, events, of_all)
    return alarm


@njit(types.void(I1, I2, INT, INT, INT, INT, INT, INT, INT, INT, INT), **COMMON)
def mix_fleet(g, members, means_of, latent_of, J_of, dv_of, mean, variance, standard, J, dv):
    """One query per model from what its learners say, see ``MixtureResidual``; by addresses (0: not wanted).

    Args:
        means_of, latent_of: means and latent variances of all members, and derivatives.
        variance: of g.
        standard: deviation of y by which innovations are standardised.
        J, dv: derivatives of mean and variance by x.
    """
    B, d, m, n = g[P.MODELS], g[P.IN], g[P.OUT], members.shape[0] - 1
    n_shares, n_experts = g[P.N_SHARES], g[P.N_EXPERTS]
    h = matrix_at(g[P.EXPERTS], 0, 5, n_experts)[0]
    each = n_experts // (n * n_shares)
    means, latent, noisy = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    noise, log_factor, by_x = np.empty(m), np.zeros(m), np.zeros(m)
    for b in range(B):
        for i in range(n):
            told, v = vector_at(means_of, i * B + b, m), vector_at(latent_of, i * B + b, m)
            gp.noise_of(members[i], b, noise)
            for o in range(m):
                means[o, i] = told[o]
                latent[o, i] = v[o] if latent_of else 0.0
                noisy[o, i] = latent[o, i] + noise[o]
        for o in range(m if latent_of else 0):
            share, f = share_of_noise(g, b * m + o), vector_at(means_of, n * B + b, m)[o]
            by_x[o] = share if abs(f) < L.REACH else 0.0
            log_factor[o] = share * min(max(f, -L.REACH), L.REACH)
        for o in range(m):
            r = b * m + o
            known = make_finite(g, r, means[o], latent[o])
            make_finite(g, r, means[o], noisy[o])
            free, most = mean_of(g, r, means[o]), FARTHEST_MEAN * vector_at(g[P.LARGEST], r, 1)[0]
            value = min(max(free, -most), most)
            vector_at(mean, r, 1)[0] = value if known else math.nan
            if not known:  # the query is not finite
                for at, size in ((variance, 1), (standard, 1), (J, d), (dv, d)):
                    vector_at(at, r, size if at else 0)[:] = math.nan
                continue
            gain = vector_at(g[P.GAIN], r, n)
            if J:
                to = vector_at(J, r, d)
                to[:] = 0.0
                for i in range(n if free == value else 0):
                    slope = vector_at(J_of, i * B * m + r, d)
                    for j in range(d):
                        to[j] += gain[i] * slope[j] if math.isfinite(slope[j]) else 0.0
            if not latent_of:
                continue
            mass, shift = vector_at(g[P.MASS], r, n * n_shares), vector_at(g[P.SHIFTS], r, n * n_shares)
            spread, total = vector_at(g[P.SPREAD], r, n * n_shares), 0.0
            for k in range(n * n_shares):
                i, share = k // n_shares, h[k * each]
                apart = share * means[o, i] + shift[k] - value
                total += mass[k] * (share * share * latent[o, i] + apart * apart) + spread[k]
            scatter, factor = scatter_of(g, r, noisy[o]), math.exp(log_factor[o])
            by_noise = vector_at(g[P.INFLATION], r, 1)[0] * factor * factor
            bound = by_noise * scatter
            if standard:
                vector_at(standard, r, 1)[0] = math.sqrt(scatter) * factor
            if variance:
                vector_at(variance, r, 1)[0] = min(total, bound)
            if dv:
                to, of_noise = vector_at(dv, r, d), vector_at(J_of, n * B * m + r, d)
                for j in range(d):
                    to[j] = 2.0 * bound * by_x[o] * of_noise[j] if total > bound else 0.0
                for k in range(n * n_shares):
                    i, share = k // n_shares, h[k * each]
                    slope, slope_v = vector_at(J_of, i * B * m + r, d), vector_at(dv_of, i * B * m + r, d)
                    apart = share * means[o, i] + shift[k] - value
                    by_v, by_m = mass[k] * share * share, 2.0 * mass[k] * apart * share
                    if total > bound:
                        by_v, by_m = mass[k] * by_noise, 0.0
                    for j in range(d):
                        to[j] += by_v * slope_v[j] if math.isfinite(slope_v[j]) else 0.0
                        to[j] += by_m * slope[j] if math.isfinite(slope[j]) else 0.0
