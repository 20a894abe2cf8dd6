"""Equilibrium of a step under unilateral laws and exact Coulomb friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...typing import Array

Mask = NDArray[np.bool_]

_TOLERANCE = 1e-10  # of the residual [N m, rad]
_NEWTON = 10  # iterations before splitting takes over
_SPLITTING = 40  # iterations between two attempts of Newton's method
_ROUNDS = 20
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

    def gaps(self, z: Array, lam: Array) -> Array:
        """w."""
        return self.gap + self.E @ z + self.compliance * (lam - self.before)

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
        """Derivative of the answer in its mode, by parameters that change ``load`` and ``gap``.

        Args:
            load: at these rates, ``(n_z, k)``.
            gap: likewise, ``(m, k)``.
        """
        n_z, (m, k) = len(load), gap.shape
        rates = np.zeros((len(self.jacobian), k))
        rates[:n_z] = load
        rates[n_z : n_z + m] = np.where(self.active[:, None], _RHO_NEWTON * gap, 0.0)
        for i in np.flatnonzero(self.slides):  # the disc of a contact that slides shrinks as its gap grows
            rows = slice(n_z + m + i * self.t.shape[1], n_z + m + (i + 1) * self.t.shape[1])
            rates[rows] = _RHO_NEWTON * np.outer(self.t[i] / self.lam[i], gap[i])
        try:
            change = np.linalg.solve(self.jacobian, -rates)
        except np.linalg.LinAlgError:  # forces that no motion tells apart: the least of their changes
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
    F, J, active, slides = _residual(problem, x)
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
            found = _residual(problem, trial)
            if found[0] @ found[0] < size:
                break
            share *= 0.5
            if share < _SHORTEST:
                return None
        x, (F, J, active, slides) = trial, found
    return None


def _residual(p: StepProblem, x: Array) -> tuple[Array, Array, Mask, Mask]:
    """F, its generalised Jacobian, which laws bear and which contacts slide."""
    (m, n_z), (n_c, d), rho = p.E.shape, p.way.shape, _RHO_NEWTON
    z, lam, t = x[:n_z], x[n_z : n_z + m], x[n_z + m :].reshape(n_c, d)
    w, v = p.gaps(z, lam), p.slides(z, t)
    flat = p.T.reshape(-1, n_z)
    pressed = lam - rho * w
    active = ~p.one_sided | (pressed > 0)
    radius = p.mu_s * pressed[:n_c].clip(min=0.0)
    y = t + rho * v
    length = np.sqrt((y * y).sum(1))
    bears = radius > 0
    slides = bears & (length > radius)
    F = np.concatenate(
        [
            p.D @ z + p.load - p.E.T @ lam + flat.T @ t.ravel(),
            np.where(active, rho * w, lam),
            np.zeros(n_c * d),
        ]
    )
    J = np.zeros((len(x), len(x)))
    J[:n_z, :n_z], J[:n_z, n_z : n_z + m], J[:n_z, n_z + m :] = p.D, -p.E.T, flat.T
    law = n_z + np.arange(m)
    J[law, :n_z] = np.where(active[:, None], rho * p.E, 0.0)
    J[law, law] = np.where(active, rho * p.compliance, 1.0)

    eye = np.eye(d)
    direction = y / np.where(length > 0, length, 1.0)[:, None]
    shrink = np.where(slides, radius / np.where(slides, length, 1.0), 0.0)
    P = shrink[:, None, None] * (eye - direction[:, :, None] * direction[:, None, :])
    stick = (bears & ~slides)[:, None] & (np.abs(p.T).max(2) > 0)  # a row that a contact lacks bears nothing
    projected = np.where(stick, y, (shrink[:, None] * y))
    F[n_z + m :] = (t - projected).ravel()
    P = np.where(stick[:, :, None], eye, P)
    mu = np.where(slides, p.mu_s, 0.0)
    J[n_z + m :, :n_z] = (
        -rho * P @ p.T + (rho * mu)[:, None, None] * direction[:, :, None] * p.E[:n_c, None, :]
    ).reshape(-1, n_z)
    own = eye - (1 + rho * p.tangential_compliance) * P
    normal = -(mu * (1 - rho * p.compliance[:n_c]))[:, None] * direction
    for i in range(n_c):
        rows = slice(n_z + m + i * d, n_z + m + (i + 1) * d)
        J[rows, rows] = own[i]
        J[rows, n_z + i] = normal[i]
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
