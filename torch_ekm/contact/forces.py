"""Contact and actuator forces of a grasp: the relaxed minimal-force problem and its answer."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._arrays import EqualityProgram, solve_by_active_set
from .._checks import check_positive
from .._extras import require
from .._noise import NOISE
from ..typing import Array
from .contacts import CHARACTERISTIC_LENGTH, ContactModel

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ForceOptions:
    """Standard deviations of the force problem, all of them positive.

    Raises:
        ParameterError: a value outside its range.
    """

    torque_std: float = 0.01
    """Standard deviation of unmodelled joint torque, Sigma_tau^(1/2) [N m]."""
    normal_std: float = NOISE.force
    """Standard deviation of a measured normal force [N]."""
    start_std: float = 1.5
    """Standard deviation of a contact force of which nothing is known yet, per axis [N]."""

    def __post_init__(self) -> None:
        for one in fields(self):
            check_positive(one.name, getattr(self, one.name))


@dataclass(frozen=True)
class FrictionCone:
    """Cone of one contact inside the stacked force vector ``mu``."""

    start: int
    """Position of the normal force in ``mu``; the friction components follow it."""
    scale: Array
    """Diagonal that makes ``u`` of the friction components, ``(d,)``: 1, 1, mu_s/gamma."""
    mu_s: float

    @property
    def dim(self) -> int:
        """Number of friction components d: 0 (frictionless), 1 (planar), 2 (point contact), 3 (soft)."""
        return len(self.scale)

    def u(self, mu: Array) -> Array:
        """Friction components ``u`` of the force vector, scaled to newtons."""
        return self.scale * mu[..., self.start + 1 : self.start + 1 + self.dim]

    def slack(self, mu: Array) -> float:
        """``mu_s f_n - |u|`` [N]; negative: outside the cone."""
        return float(self.mu_s * mu[self.start] - np.linalg.norm(self.u(mu)))

    def rows(self, directions: Array, n_h: int) -> Array:
        """Rows ``g`` of ``g mu <= 0``: ``d . u <= mu_s f_n`` for each direction ``(k, d)``."""
        rows = np.zeros((len(directions), n_h))
        rows[:, self.start] = -self.mu_s
        rows[:, self.start + 1 : self.start + 1 + self.dim] = directions * self.scale
        return rows


def friction_cones(
    models: Sequence[ContactModel], mu_s: Sequence[float], gamma: Sequence[float]
) -> tuple[FrictionCone, ...]:
    """The cones of contacts whose components are stacked in the order of the models' rows."""
    cones, start = [], 0
    for model, friction, torsional in zip(models, mu_s, gamma, strict=True):
        scale = np.ones(len(model.rows) - 1)
        if model is ContactModel.SOFT_FINGER:
            scale[2] = friction / max(torsional, 1e-9)
        cones.append(FrictionCone(start, scale, float(friction)))
        start += len(model.rows)
    return tuple(cones)


@lru_cache(maxsize=4)
def outer_directions(dim: int) -> Array:
    """Unit normals d of a polyhedron ``{d . u <= 1}`` around the unit ball, ``(k, dim)``.

    Eight around a circle; for a soft finger rings of eight over the latitudes and the two poles.
    """
    if dim == 0:
        return np.zeros((0, 0))
    if dim == 1:
        return np.array([[1.0], [-1.0]])
    angle = 2 * np.pi * np.arange(8) / 8
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if dim == 2:
        return ring
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 5)[1:-1]
    layers = [np.concatenate([np.cos(t) * ring, np.full((8, 1), np.sin(t))], axis=-1) for t in latitude]
    return np.concatenate([*layers, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])


def cutting_planes(cones: Sequence[FrictionCone], mu: Array, tolerance: float) -> Array:
    """Rows ``g mu <= 0`` that cut off ``mu`` where it violates a cone by more than ``tolerance`` [N]."""
    cuts = [np.zeros((0, len(mu)))]
    for cone in cones:
        if cone.dim > 1 and cone.slack(mu) < -tolerance:
            u = cone.u(mu)
            cuts.append(cone.rows((u / np.linalg.norm(u))[None], len(mu)))
    return np.concatenate(cuts)


def margins(cones: Sequence[FrictionCone], mu: Array) -> tuple[Array, Array]:
    """Per contact ``mu_s f_n - |u|`` [N], and that relative to ``mu_s f_n``: 1 no friction used, 0 slips."""
    slack = np.array([cone.slack(mu) for cone in cones])
    limit = np.array([cone.mu_s * mu[cone.start] for cone in cones])
    relative = np.divide(slack, limit, out=np.zeros_like(slack), where=limit > 1e-12)
    return slack, relative


class ForceStatus(Enum):
    """Whether the force problem was solved, is impossible, or made the solver fail."""

    SOLVED = "solved"
    NOT_GRASPABLE = "not_graspable"
    """No forces inside the cones and bounds balance the object."""
    FAILED = "failed"
    """The solver gave up; nothing is known."""


@dataclass(frozen=True)
class BalanceEquations:
    """Equilibrium at one state, reduced to the permitted motions (rigid couplings taken out).

    ```
    object_matrix mu = object_load                         G mu = V_p
    hand_matrix mu + actuator_matrix lam + bound_matrix tau - r = -hand_load
    ```
    """

    object_matrix: Array
    """G, contact forces to the wrench on the object, ``(n_w, n_h)``."""
    object_load: Array
    """V_p, gradient of the potential energy by the object's pose [N, N m], ``(n_w,)``."""
    hand_matrix: Array
    """(J_h Z)^T, ``(n_z, n_h)``."""
    actuator_matrix: Array
    """(J_a Z)^T, ``(n_z, n_a)``."""
    hand_load: Array
    """Z^T V_q, torques of the springs in the permitted motions [N m], ``(n_z,)``."""
    cones: tuple[FrictionCone, ...]
    moment_rows: Mask
    """Rows of ``object_load`` that are moments, bool ``(n_w,)``."""
    tendon: Mask
    """Actuators that only pull, bool ``(n_a,)``."""
    spin_columns: tuple[int, ...] = ()
    """Components of ``mu`` that are moments."""
    bound_matrix: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Z^T of unit joint torques with bounds of their own (stops), ``(n_z, n_t)``."""
    bound_lower: Array = field(default_factory=lambda: np.zeros(0))
    bound_upper: Array = field(default_factory=lambda: np.zeros(0))
    measured_normal: Array | None = None
    """Measured normal forces [N], NaN where there is none."""
    expected: Array | None = None
    """Forces ``mu`` to stay near, ``(n_h,)``."""
    expected_covariance: Array | None = None
    """Of ``expected``, ``(n_h, n_h)``."""

    @property
    def row_scale(self) -> Array:
        """1 for forces on the object, 1/L for moments, ``(n_w,)``."""
        return np.where(self.moment_rows, 1 / CHARACTERISTIC_LENGTH, 1.0)


@dataclass(frozen=True)
class ForceSolution:
    """Forces in the order of the problem's unknowns; NaN unless solved."""

    status: ForceStatus
    mu: Array
    """[N], moment rows [N m]."""
    lam: Array
    """Minus the actuator forces along +a [N or N m]."""
    bound: Array
    """Torques of stops [N m]."""
    residual: Array
    """r: unexplained generalised torque, ``(n_z,)`` [N m]. Large: wrong spring or rest angle, slipping."""
    violation: float
    """Smallest norm of the unbalanced object wrench (moments divided by L) [N]; about 0 when solved."""
    solves: int
    """Number of QPs; 0: the answer without inequalities keeps them all."""
    covariance: Array | None = None
    """Of ``mu`` about the answer, ``(n_h, n_h)``; None without ``expected_covariance``."""


MAX_NORMAL = 1e3
"""Upper bound of every normal force [N]; the lower one is 0."""
_FORCE_WEIGHT = 1e-7
"""``eps``: weight of ``|mu|^2`` against the squared, whitened joint residual [1/N^2]."""


class ForceCost(NamedTuple):
    """``1/2 x^T P x + q^T x`` subject to ``balance x = load``, with ``[mu; lam; tau] = scale * x``."""

    P: Array
    q: Array
    balance: Array
    load: Array
    scale: Array

    def covariance(self, n_h: int) -> Array:
        """``N (N^T P N)^-1 N^T`` of ``mu``, N the null space of the balance: P read as information."""
        _, sigma, Vh = np.linalg.svd(self.balance)
        N = Vh[int((sigma > 1e-9 * sigma[0]).sum()) :].T
        half = (self.scale[:, None] * N)[:n_h]
        return half @ np.linalg.solve(N.T @ self.P @ N, half.T)


def force_cost(eq: BalanceEquations, options: ForceOptions) -> ForceCost:
    """What the forces should be, in ``x = [mu; lam; tau]``, all scaled to newtons.

    ```
    min  p(mu) + eps (|arm lam/L|^2 + |tau/L|^2/100) + |r|^2/sigma^2
         + sum (f_n - measured)^2/sigma_n^2
    s.t. G mu = V_p
    p(mu) = eps |mu|^2, or (mu - expected)^T Sigma^-1 (mu - expected) where forces are expected
    ```

    With expected forces it is the negative logarithm of a posterior density (times two).
    """
    L = CHARACTERISTIC_LENGTH
    n_h, n_a, n_t = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(eq.bound_lower)
    n = n_h + n_a + n_t
    scale = np.ones(n)
    scale[list(eq.spin_columns)] = L
    scale[n_h:] = L
    # typical moment arm: 1 for motors in rad, a radius for cables in m
    arm = np.sqrt((eq.actuator_matrix * eq.actuator_matrix).sum(0))
    scale[n_h : n_h + n_a] /= np.where(arm > 0, arm, 1.0)
    balance = np.zeros((len(eq.object_load), n))
    balance[:, :n_h] = eq.object_matrix * eq.row_scale[:, None] * scale[:n_h]
    bound = eq.bound_matrix.reshape(len(eq.hand_load), n_t)
    joint = np.concatenate([eq.hand_matrix, eq.actuator_matrix, bound], axis=1) * scale
    WJ = joint / options.torque_std**2
    P, q = joint.T @ WJ, WJ.T @ eq.hand_load
    diagonal = np.full(n, _FORCE_WEIGHT)
    diagonal[n_h + n_a :] *= 1e-2
    if eq.expected is not None and eq.expected_covariance is not None:
        diagonal[:n_h] = 0.0
        W = np.linalg.inv(eq.expected_covariance) * scale[:n_h, None] * scale[:n_h]  # Sigma^-1 in x
        P[:n_h, :n_h] += W
        q[:n_h] -= W @ (eq.expected / scale[:n_h])
    if eq.measured_normal is not None:
        known = np.isfinite(eq.measured_normal)
        at = np.array([cone.start for cone in eq.cones])[known]
        diagonal[at] += (scale[at] / options.normal_std) ** 2
        q[at] -= scale[at] * eq.measured_normal[known] / options.normal_std**2
    P[np.diag_indices(n)] += diagonal
    return ForceCost(P, q, balance, eq.object_load * eq.row_scale, scale)


def force_problem(eq: BalanceEquations, cost: ForceCost):
    """Add the inequalities to the cost: a ``qpsolvers.Problem``.

    ```
    0 <= f_n <= f_max,  |u_i| <= mu_s f_n,i,  -lam >= 0 for tendons,  bounds of stops
    ```

    The friction cones stand in it as polyhedra around them, which cutting planes carve down to the cones.
    """
    qpsolvers = require("qpsolvers")
    P, q, balance, load, scale = cost
    n_h, n_a, n = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(q)
    normals = [cone.start for cone in eq.cones]
    rows = np.concatenate([cone.rows(outer_directions(cone.dim), n_h) for cone in eq.cones])
    inequality = np.zeros((len(rows), n))
    inequality[:, :n_h] = rows * scale[:n_h]
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    lower[normals], upper[normals] = 0.0, MAX_NORMAL
    upper[n_h : n_h + n_a] = np.where(eq.tendon, 0.0, np.inf)
    L = CHARACTERISTIC_LENGTH
    lower[n_h + n_a :], upper[n_h + n_a :] = eq.bound_lower / L, eq.bound_upper / L
    return qpsolvers.Problem(P, q, inequality, np.zeros(len(rows)), balance, load, lower, upper)


_TOLERANCE = 2e-7  # [N] largest friction violation left by the cutting planes
_MAX_CUTS = 30


def contact_forces(eq: BalanceEquations, options: ForceOptions | None = None) -> ForceSolution:
    """Forces that balance the object exactly and the joints as well as possible.

    The object balance is hard (mass and contact geometry are known best), the joint balance soft:
    an equality there is infeasible for nearly every measured state. Friction is exact by cutting
    planes.

    Never raises for an impossible grasp: read ``status`` and ``violation``.
    """
    options = options or ForceOptions()
    n_h = eq.object_matrix.shape[1]
    cost = force_cost(eq, options)
    covariance = None if eq.expected_covariance is None else cost.covariance(n_h)
    program = None
    with contextlib.suppress(np.linalg.LinAlgError):  # redundant rows, as of two point contacts
        program = EqualityProgram(cost.P, cost.q, cost.balance, cost.load)
        if _keeps_all(eq, cost.scale * program.x):  # it is then the optimum
            return _unpack(eq, cost.scale * program.x, 0, covariance)
    problem = force_problem(eq, cost)
    bounds = [(-np.eye(len(cost.q)), -problem.lb), (np.eye(len(cost.q)), problem.ub)]
    sides = [(rows[np.isfinite(most)], most[np.isfinite(most)]) for rows, most in bounds]
    limits, most = (np.concatenate(part) for part in zip(*sides, strict=True))
    active: list[int] = []
    for solves in range(1, _MAX_CUTS + 1):
        G, h = np.concatenate([limits, problem.G]), np.concatenate([most, problem.h])
        optimum = None if program is None else solve_by_active_set(program, G, h, active)
        if optimum is None:
            solution = _solve(problem)
            if not solution.found:
                return _classify_failure(eq, cost, problem, solves)
            x, active = solution.x, []
        else:
            x, active = optimum.x, optimum.active
        unknowns = cost.scale * x
        new = cutting_planes(eq.cones, unknowns[:n_h], _TOLERANCE)
        if not len(new):
            break
        rows = np.zeros((len(new), len(cost.scale)))
        rows[:, :n_h] = new * cost.scale[:n_h]
        problem.G, problem.h = np.concatenate([problem.G, rows]), np.append(problem.h, np.zeros(len(new)))
    return _unpack(eq, unknowns, solves, covariance)


def _keeps_all(eq: BalanceEquations, unknowns: Array) -> bool:
    """Whether the answer without inequalities keeps them, as it mostly does."""
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    mu, lam, bound = np.split(unknowns, [n_h, n_h + n_a])
    normal = mu[[cone.start for cone in eq.cones]]
    unbalanced = (eq.object_matrix @ mu - eq.object_load) * eq.row_scale
    return bool(
        all(cone.slack(mu) >= 0 for cone in eq.cones)
        and (normal >= 0).all()
        and (normal <= MAX_NORMAL).all()
        and not (lam[eq.tendon] > 0).any()
        and (bound >= eq.bound_lower).all()
        and (bound <= eq.bound_upper).all()
        and np.abs(unbalanced).max() < _TOLERANCE
    )


def _solve(problem):
    """Solve a ``qpsolvers.Problem`` by PIQP with tight tolerances.

    The weight of the forces is smaller than that of the joint residual by seven powers of ten: PIQP
    needs iterative refinement for that (without it, one problem in eight with joints at their stops ran
    into its limit of iterations). Should it give up nevertheless, Clarabel has the last word.
    """
    qpsolvers, csc = require("qpsolvers"), require("scipy.sparse").csc_matrix
    options = {"eps_abs": 1e-10, "eps_rel": 1e-11, "iterative_refinement_always_enabled": True}
    solution = qpsolvers.solve_problem(problem, "piqp", **options)
    status = str(getattr(solution.extras.get("info"), "status", ""))
    if solution.found or "PRIMAL_INFEASIBLE" in status:
        return solution
    require("clarabel")  # where it is missing, this names the extra
    G, A = (None if M is None else csc(M) for M in (problem.G, problem.A))
    sparse = qpsolvers.Problem(csc(problem.P), problem.q, G, problem.h, A, problem.b, problem.lb, problem.ub)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # qpsolvers warns when Clarabel finds the problem infeasible
        return qpsolvers.solve_problem(sparse, "clarabel")


def _unpack(
    eq: BalanceEquations, unknowns: Array, solves: int, covariance: Array | None = None
) -> ForceSolution:
    """Split ``[mu; lam; tau]`` and certify it: joint residual and object violation from the equations."""
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    mu, lam, bound = np.split(unknowns, [n_h, n_h + n_a])
    residual = eq.hand_load + eq.hand_matrix @ mu + eq.actuator_matrix @ lam
    if len(bound):
        residual = residual + eq.bound_matrix @ bound
    violation = float(np.linalg.norm((eq.object_matrix @ mu - eq.object_load) * eq.row_scale))
    return ForceSolution(ForceStatus.SOLVED, mu, lam, bound, residual, violation, solves, covariance)


def _classify_failure(eq: BalanceEquations, cost: ForceCost, problem: Any, solves: int) -> ForceSolution:
    """Find out whether the balance is impossible or the solver failed: by how little it can be missed."""
    problem.P = problem.P * 1e-9 + cost.balance.T @ cost.balance
    problem.q = problem.q * 1e-9 - cost.balance.T @ cost.load
    problem.A = problem.b = None
    solution = _solve(problem)
    status, violation = ForceStatus.FAILED, math.nan
    if solution.found:
        violation = _unpack(eq, cost.scale * solution.x, solves).violation
        if violation > 1e-6:  # else the balance is possible after all, and only the solver failed
            status = ForceStatus.NOT_GRASPABLE
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    nothing = np.full(n_h + n_a + len(eq.bound_lower) + len(eq.hand_load), np.nan)
    mu, lam, bound, residual = np.split(nothing, np.cumsum([n_h, n_a, len(eq.bound_lower)]))
    return ForceSolution(status, mu, lam, bound, residual, violation, solves + 1)
