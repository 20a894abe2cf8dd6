from __future__ import annotations

import contextlib
import math
import warnings
from typing import Any, NamedTuple

import numpy as np

from ..._extras import require
from ...typing import Array
from .problem import (
    MAX_NORMAL,
    BalanceEquations,
    ForceCost,
    ForceOptions,
    ForceSolution,
    ForceStatus,
    cutting_planes,
    force_cost,
    force_problem,
)

_MOST_CHANGES = 25
_VIOLATED = 1e-10  # of rows of the order of 1
_ERROR = 1e-9


class EqualityProgram:
    """``min 1/2 x^T P x + q^T x, A x = b``, solved again and again with more rows.

    Raises:
        numpy.linalg.LinAlgError: rows of A depend on each other, or P is singular on their null space.
    """

    def __init__(self, P: Array, q: Array, A: Array, b: Array) -> None:
        self._n, m = len(q), len(b)
        self._K = np.zeros((self._n + m, self._n + m))
        self._K[: self._n, : self._n] = P
        self._K[: self._n, self._n :], self._K[self._n :, : self._n] = A.T, A
        self._inverse = np.linalg.inv(self._K)
        self._right = np.concatenate([-q, b])  # of the conditions for x and the multipliers of A
        z = self._inverse @ self._right
        self._z = z + self._inverse @ (self._right - self._K @ z)  # refined: rounding of a poor condition
        self.x: Array = self._z[: self._n]
        """The optimum."""

    def solve(self, E: Array, e: Array) -> tuple[Array, Array, Any]:
        """The optimum with ``E x = e`` on top, and the multipliers of A and of E.

        Raises:
            numpy.linalg.LinAlgError: the rows depend on each other and on A.
        """
        n, H_E = self._n, self._inverse[:, : self._n] @ E.T
        lam = np.linalg.solve(E @ H_E[:n], E @ self.x - e)
        z = self._z - H_E @ lam
        return z[:n], z[n:], lam

    def error(self, x: Array, nu: Array, push: Array) -> float:
        """``max(|P x + q + A^T nu + push|, |A x - b|)`` as a share of the largest of q and b, or of 1."""
        left = self._right - self._K @ np.concatenate([x, nu])
        left[: self._n] -= push
        return float(abs(left).max() / max(1.0, abs(self._right).max()))


class Optimum(NamedTuple):
    """x, and what certifies it."""

    x: Array
    equality: Array
    """nu, multipliers of ``A x = b``."""
    active: list[int]
    """W, rows of G that hold with equality."""
    inequality: Array
    """lam, their multipliers."""


def solve_by_active_set(program: EqualityProgram, G: Array, h: Array, active: list[int]) -> Optimum | None:
    """The optimum with ``G x <= h``, by guessing which rows W hold with equality, ``active`` first::

        P x + q + A^T nu + G_W^T lam = 0,  A x = b,  G_W x = h_W,  lam >= 0,  G x <= h

    From one guess to the next the row with the most negative multiplier leaves, or else the row that is
    violated most enters. An answer keeps all conditions of Karush, Kuhn and Tucker and is exact to rounding;
    where none is found (None) an interior-point method has to do it. At a vertex, where as many rows hold as
    there are unknowns, rounding decides which row leaves, and none may be found. See Nocedal and Wright,
    Numerical Optimization (2006), ch. 16.
    """
    rows = list(active)
    for _ in range(_MOST_CHANGES):
        try:
            x, nu, lam = program.solve(G[rows], h[rows])
        except np.linalg.LinAlgError:
            return None
        if len(rows) and lam.min() < 0:
            del rows[int(lam.argmin())]
            continue
        broken = G @ x - h
        broken[rows] = 0.0
        if broken.max(initial=0.0) <= _VIOLATED:
            right = program.error(x, nu, lam @ G[rows]) <= _ERROR  # not so where A is nearly singular
            return Optimum(x, nu, rows, lam) if right else None
        rows.append(int(broken.argmax()))
    return None


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
    cost, cuts = force_cost(eq, options), np.zeros((0, n_h))
    covariance = None if eq.expected_covariance is None else cost.covariance(n_h)
    program = None
    with contextlib.suppress(np.linalg.LinAlgError):  # redundant rows, as of two point contacts
        program = EqualityProgram(cost.P, cost.q, cost.balance, cost.load)
        if _keeps_all(eq, cost.scale * program.x):  # it is then the optimum
            return _unpack(eq, cost.scale * program.x, 0, covariance)
    problem = force_problem(eq, cost, cuts)
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
                return _classify_failure(eq, cost, cuts, solves)
            x, active = solution.x, []
        else:
            x, active = optimum.x, optimum.active
        unknowns = cost.scale * x
        new = cutting_planes(eq.cones, unknowns[:n_h], _TOLERANCE)
        if not len(new):
            break
        cuts = np.concatenate([cuts, new])
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


def _classify_failure(eq: BalanceEquations, cost: ForceCost, cuts: Array, solves: int) -> ForceSolution:
    """Find out whether the balance is impossible or the solver failed."""
    solution = _solve(force_problem(eq, cost, cuts, soft=True))
    status, violation = ForceStatus.FAILED, math.nan
    if solution.found:
        violation = _unpack(eq, cost.scale * solution.x, solves).violation
        if violation > 1e-6:  # else the balance is possible after all, and only the solver failed
            status = ForceStatus.NOT_GRASPABLE
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    nothing = np.full(n_h + n_a + len(eq.bound_lower) + len(eq.hand_load), np.nan)
    mu, lam, bound, residual = np.split(nothing, np.cumsum([n_h, n_a, len(eq.bound_lower)]))
    return ForceSolution(status, mu, lam, bound, residual, violation, solves + 1)
