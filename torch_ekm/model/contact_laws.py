"""Equilibrium of a step under unilateral laws and exact Coulomb friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..typing import Array

Mask = NDArray[np.bool_]

_TOLERANCE = 1e-10  # of the residual [N m, rad]
_NEWTON = 10  # iterations before splitting takes over
_SPLITTING = 40  # iterations between two attempts of Newton's method
_ROUNDS = 10  # of 4,660 equilibria all but 10 are found in so many; what has none takes them all
_SHORTEST = 0.05  # share of a Newton step at which the line search gives up
# weights of gaps against forces [N m/rad], without influence on the answer; splitting takes them in turn
_RHO_NEWTON, _RHO_SPLITTING = 0.1, (1.0, 1.0, 3.0, 0.3)


@dataclass(frozen=True)
class StepProblem:
    """What holds after a step z, in scaled, permitted coordinates (angles, lengths by L, forces times L).

    ```
    D z + load - E^T lam + sum_i T_i^T t_i = 0                    equilibrium
    w = gap + E z + c (lam - lam_0),   0 <= w _|_ lam >= 0        one-sided laws; w = 0: two-sided ones
    v_i = way_i + T_i z + c_t (t_i - t_0i)                        slide of contact i
    |t_i| <= mu_i lam_i,   v_i = 0 or t_i = mu_i lam_i v_i/|v_i|   Coulomb friction
    ```

    The first n_c laws are the contacts'; tendons, rods and joint stops follow. Compliances c decide how
    redundant contacts share a load.
    """

    D: Array
    """``(n_z, n_z)``, may be indefinite and not symmetric."""
    load: Array
    E: Array
    """``(m, n_z)``: how each gap grows with z."""
    gap: Array
    compliance: Array
    before: Array
    """lam_0 of each law."""
    one_sided: Mask
    """bool ``(m,)``."""
    T: Array
    """``(n_c, d, n_z)``; rows of 0 where a contact has fewer than d."""
    way: Array
    """Slid before, ``(n_c, d)``."""
    tangential_compliance: float
    t_before: Array
    """``(n_c, d)``."""
    mu_s: Array
    """``(n_c,)``."""

    def slides(self, z: Array, t: Array) -> Array:
        """v."""
        return self.way + self.T @ z + self.tangential_compliance * (t - self.t_before)


class Response(NamedTuple):
    """How an answer changes with k parameters."""

    z: Array
    """``(n_z, k)``"""
    lam: Array
    """``(m, k)``"""
    t: Array
    """``(n_c, d, k)``"""


class StepSolution(NamedTuple):
    """Answer of a :class:`StepProblem`."""

    z: Array
    lam: Array
    t: Array
    """``(n_c, d)``."""
    active: Mask
    """bool ``(m,)``: the law bears."""
    slides: Mask
    """bool ``(n_c,)``."""
    jacobian: Array
    """Of the residual with respect to ``[z; lam; t]``."""

    def response(self, load: Array, gap: Array) -> Response:
        """Derivative of the answer in its mode, by k parameters that change the load at the rates ``load``
        ``(n_z, k)`` and the gaps at the rates ``gap`` ``(m, k)``."""
        n_z, (m, k) = len(load), gap.shape
        rates = np.zeros((len(self.jacobian), k))
        rates[:n_z] = load
        rates[n_z : n_z + m] = np.where(self.active[:, None], _RHO_NEWTON * gap, 0.0)
        # the disc of a contact that slides shrinks as its gap grows; one that bears nothing has none
        for i in np.flatnonzero(self.slides & (self.lam[: len(self.slides)] > _TOLERANCE)):
            rows = slice(n_z + m + i * self.t.shape[1], n_z + m + (i + 1) * self.t.shape[1])
            rates[rows] = _RHO_NEWTON * np.outer(self.t[i] / self.lam[i], gap[i])
        try:
            change = np.linalg.solve(self.jacobian, -rates)
        except np.linalg.LinAlgError:  # forces that no motion distinguishes: the least of their changes
            change = np.linalg.lstsq(self.jacobian, -rates, rcond=None)[0]
        change = np.asarray(change, dtype=np.float64)
        z, lam, t = np.split(change, [n_z, n_z + m])
        return Response(z, lam, t.reshape(*self.t.shape, k))


def solve(problem: StepProblem, lam: Array, t: Array) -> StepSolution | None:
    """Newton on the natural maps, from a first guess of the forces; splitting where that does not converge.

    ```
    lam - max(0, lam - rho w) = 0        t - P(t + rho v) = 0, P onto the disc |t| <= mu_s max(0, lam - rho w)
    ```

    (Alart and Curnier, CMAME 92, 1991). The splitting is ADMM on the cones with De Saxce's correction
    ``w + mu_s |v|`` (Acary, Cadoux, Lemarechal and Malick, ZAMM 91, 2011); slow, but it finds the contacts
    that slide, and Newton's method the digits. None: neither converges.
    """
    z = np.zeros(problem.E.shape[1])
    for attempt in range(_ROUNDS):
        found = _newton(problem, z, lam, t)
        if found is not None:
            return found
        with np.errstate(over="ignore", invalid="ignore"):  # it may diverge where D is indefinite
            split = _split(problem, lam, t, _RHO_SPLITTING[attempt % len(_RHO_SPLITTING)])
        if split is not None and np.isfinite(split[1]).all():
            z, lam, t = split
    return None


def _newton(problem: StepProblem, z: Array, lam: Array, t: Array) -> StepSolution | None:
    n_z, m, shape = len(z), len(lam), t.shape
    x = np.concatenate([z, lam, t.ravel()])
    maps = _NaturalMaps(problem)
    F, J, active, slides = maps(x)
    for _ in range(_NEWTON):
        if np.abs(F).max() < _TOLERANCE:
            z, lam, t = np.split(x, [n_z, n_z + m])
            return StepSolution(z, lam, t.reshape(shape), active, slides, J)
        try:
            way = np.linalg.solve(J, -F)
        except np.linalg.LinAlgError:
            return None
        share, size = 1.0, F @ F
        while True:
            trial = x + share * way
            found = maps(trial)
            if found[0] @ found[0] < size:
                break
            share *= 0.5
            if share < _SHORTEST:
                return None
        x, (F, J, active, slides) = trial, found
    return None


class _NaturalMaps:
    """Residual F of the equations at ``x = [z; y]``, ``y = [lam; t]``, and its generalised Jacobian.

    ```
    F = [D z + load - E^T lam + T^T t;  y - P(y - rho s)]      s = [w; -v], P clips or projects onto the disc
    ```
    """

    def __init__(self, p: StepProblem) -> None:
        (m, n_z), (n_c, d) = p.E.shape, p.way.shape
        self.p, flat = p, p.T.reshape(-1, n_z)
        self.J = np.zeros((n_z + m + n_c * d,) * 2)
        self.J[:n_z] = np.concatenate([p.D, -p.E.T, flat.T], axis=1)
        c = np.concatenate([p.compliance, np.full(n_c * d, -p.tangential_compliance)])
        way = p.tangential_compliance * p.t_before - p.way
        self.rho_s = _RHO_NEWTON * np.concatenate([p.gap - p.compliance * p.before, way.ravel()])
        self.rho_G, self.own = _RHO_NEWTON * np.concatenate([p.E, -flat]), 1 - _RHO_NEWTON * c
        self.transmits = np.abs(p.T).max(2, initial=0.0) > 0  # a row that a contact lacks bears nothing
        self.diagonal = np.arange(n_z, len(self.J))

    def __call__(self, x: Array) -> tuple[Array, Array, Mask, Mask]:
        """F, J, which laws bear and which contacts slide."""
        p, rho = self.p, _RHO_NEWTON
        (m, n_z), (n_c, d) = p.E.shape, p.way.shape
        y = x[n_z:]
        moved = self.own * y - self.rho_G @ x[:n_z] - self.rho_s  # y - rho s
        active = ~p.one_sided | (moved[:m] > 0)
        ahead = moved[m:].reshape(n_c, d)
        with np.errstate(over="ignore"):  # in iterations that diverge
            radius, length = p.mu_s * moved[:n_c].clip(min=0.0), np.sqrt((ahead * ahead).sum(1))
        slides = (radius > 0) & (length > radius)
        shrink = np.divide(radius, length, out=(radius > 0).astype(np.float64), where=slides)
        kept = np.concatenate([active, (shrink[:, None] * self.transmits).ravel()])
        F = np.concatenate([self.J[:n_z] @ x + p.load, y - kept * moved])
        J = self.J.copy()
        J[n_z:, :n_z] = kept[:, None] * self.rho_G
        J[self.diagonal, self.diagonal] = 1 - kept * self.own
        for i in np.flatnonzero(slides):
            rows, e, mu = slice(n_z + m + i * d, n_z + m + (i + 1) * d), ahead[i] / length[i], p.mu_s[i]
            J[rows, :n_z] += np.outer(e, rho * (shrink[i] * (e @ p.T[i]) + mu * p.E[i]))
            J[rows, rows] += (1 + rho * p.tangential_compliance) * shrink[i] * np.outer(e, e)
            J[rows, n_z + i] = -mu * self.own[i] * e
        return F, J, active, slides


def _split(p: StepProblem, lam: Array, t: Array, rho: float) -> tuple[Array, Array, Array] | None:
    """Some iterations of ``y <- P_K(y - rho s)``, ``s = G z + g + c y``, z the minimum of the augmented
    Lagrangian; ``y = [lam; t]``, ``G = [E; -T]``. None: it has no minimum."""
    (m, n_z), (n_c, d) = p.E.shape, p.way.shape
    G = np.concatenate([p.E, -p.T.reshape(-1, n_z)])
    c = np.concatenate([p.compliance, np.full(n_c * d, p.tangential_compliance)])
    y, target = np.concatenate([lam, t.ravel()]), np.zeros(len(c))
    g0 = np.concatenate(
        [p.gap - p.compliance * p.before, -(p.way - p.tangential_compliance * p.t_before).ravel()]
    )
    share = 1 / (1 + rho * c)
    try:
        inverse = np.linalg.inv(p.D + (G.T * (rho * share)) @ G)
    except np.linalg.LinAlgError:  # D is indefinite
        return None
    z = np.zeros(n_z)
    for _ in range(_SPLITTING):
        g = g0.copy()
        g[:n_c] += p.mu_s * np.sqrt((p.slides(z, y[m:].reshape(n_c, d)) ** 2).sum(1))
        free = share * (y - rho * (g - target))
        z = inverse @ (G.T @ free - p.load)
        force = free - rho * share * (G @ z)
        moved = y - rho * (G @ z + g + c * force)
        y = _onto_cones(p, moved)
        target = (y - moved) / rho
    return z, y[:m], y[m:].reshape(n_c, d)


def _onto_cones(p: StepProblem, y: Array) -> Array:
    """The nearest forces that keep the signs and the friction cones."""
    m, (n_c, d) = len(p.gap), p.way.shape
    lam, t = y[:m], y[m:].reshape(n_c, d)
    normal, mu, length = lam[:n_c], p.mu_s, np.sqrt((t * t).sum(1))
    mixed = ((normal + mu * length) / (1 + mu * mu)).clip(min=0.0)
    inside = length <= mu * normal
    onto = np.where(p.one_sided, lam.clip(min=0.0), lam)
    onto[:n_c] = np.where(inside, normal, mixed)
    scale = np.where(inside, 1.0, mu * mixed / np.where(length > 0, length, 1.0))
    return np.concatenate([onto, (scale[:, None] * t).ravel()])
