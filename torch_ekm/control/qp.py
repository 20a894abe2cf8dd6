"""The controller's quadratic program: one function builds it, another solves it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ..exceptions import ParameterError, SolverError

Array = NDArray[np.float64]


@dataclass
class ControlProblem:
    """The step ``u`` (all of ``(n_u,)``, in the caller's unit) that is best among those allowed.

    ::

        min_u,sl,t   u^T W u + c.u + sum_j w_j (A_j u - b_j)^2 + rho |sl|_1 + rho_t |t|_1
        s.t.         E u + sl = d            what must be reached, if it can be
                     C u - t <= h, t >= 0    what should hold, if it can
                     lower <= u <= upper     what always holds

    The l1 slacks are exact: for ``rho`` above the multipliers they are zero whenever the rows
    can be met, and otherwise the violation is least. So the problem is never infeasible
    as long as ``lower <= upper``.
    """

    weight: Array
    """W, ``(n_u, n_u)``, positive definite."""
    lower: Array
    upper: Array
    equality: tuple[Array, Array]
    """(E, d)"""
    least_squares: list[tuple[Array, Array, Array]] = field(default_factory=list)
    """[(A, b, w)] with ``w`` the weight of each row."""
    soft_inequality: list[tuple[Array, Array]] = field(default_factory=list)
    """[(C, h)]"""
    linear: Array | None = None
    """c, ``(n_u,)``; None: zero."""
    slack_penalty: float = 1e3
    soft_penalty: float = 1e2


@dataclass(frozen=True)
class ControlSolution:
    """A solved :class:`ControlProblem`, certified by its residuals."""

    u: Array
    slack: Array
    """``d - E u``: what of the equality could not be met."""
    violation: float
    """Largest violation of a soft inequality."""
    at_bounds: NDArray[np.bool_]
    primal_residual: float
    dual_residual: float


def build_qp(problem: ControlProblem):
    """The ``qpsolvers.Problem`` over ``z = [u; sl+; sl-; t]``.

    Raises:
        ParameterError: ``lower > upper`` somewhere, or a non-finite figure.
    """
    qpsolvers = require("qpsolvers")
    E, d = problem.equality
    n_u, n_e = len(problem.lower), len(d)
    C = np.vstack([c for c, _ in problem.soft_inequality]) if problem.soft_inequality else np.zeros((0, n_u))
    h = np.concatenate([v for _, v in problem.soft_inequality]) if problem.soft_inequality else np.zeros(0)
    n_t = len(h)
    n = n_u + 2 * n_e + n_t
    crossed = np.flatnonzero(problem.lower > problem.upper)
    if crossed.size:
        i = int(crossed[0])
        raise ParameterError(f"lower[{i}]", problem.lower[i], f"at most upper[{i}] = {problem.upper[i]}")

    P = np.zeros((n, n))
    q = np.zeros(n)
    P[:n_u, :n_u] = 2 * problem.weight
    if problem.linear is not None:
        q[:n_u] += problem.linear
    for A, b, w in problem.least_squares:
        P[:n_u, :n_u] += 2 * A.T @ (w[:, None] * A)
        q[:n_u] -= 2 * A.T @ (w * b)
    q[n_u : n_u + 2 * n_e] = problem.slack_penalty
    q[n_u + 2 * n_e :] = problem.soft_penalty
    A_eq = np.hstack([E, np.eye(n_e), -np.eye(n_e), np.zeros((n_e, n_t))])
    G = np.hstack([C, np.zeros((n_t, 2 * n_e)), -np.eye(n_t)])
    lb = np.concatenate([problem.lower, np.zeros(2 * n_e + n_t)])
    ub = np.concatenate([problem.upper, np.full(2 * n_e + n_t, np.inf)])
    for name, value in (
        ("cost", P),
        ("cost", q),
        ("equality", A_eq),
        ("target", d),
        ("rows", G),
        ("rows", h),
    ):
        if not np.isfinite(value).all():
            raise ParameterError(name, "NaN or infinity", "finite")
    rows = (G, h) if n_t else (None, None)
    equalities = (A_eq, d) if n_e else (None, None)
    return qpsolvers.Problem(P, q, *rows, *equalities, lb, ub)


def solve_qp(problem: ControlProblem, solver: str = "piqp") -> ControlSolution:
    """Solve a :class:`ControlProblem`.

    Args:
        solver: any solver that qpsolvers finds installed; the open-source "piqp" by default.

    Raises:
        ParameterError: the solver is not installed (the message lists those that are), or the
            problem holds crossed bounds or non-finite figures.
        SolverError: the solver did not find a solution.
    """
    qpsolvers = require("qpsolvers")
    if solver not in qpsolvers.available_solvers:
        raise ParameterError("solver", solver, f"one of {', '.join(qpsolvers.available_solvers)}")
    built = build_qp(problem)
    try:
        solution = qpsolvers.solve_problem(built, solver=solver)
    except Exception as error:  # back ends raise types of their own
        raise SolverError(solver, f"{type(error).__name__}: {error}") from error
    if not solution.found or solution.x is None:
        raise SolverError(solver, "no solution found", "bounds may be far out of scale")
    E, d = problem.equality
    u = np.clip(solution.x[: len(problem.lower)], problem.lower, problem.upper)
    violation = max((float(np.max(C @ u - h, initial=0.0)) for C, h in problem.soft_inequality), default=0.0)
    span = np.maximum(problem.upper - problem.lower, 1e-12)
    at_bounds = (u - problem.lower < 1e-5 * span) | (problem.upper - u < 1e-5 * span)
    return ControlSolution(
        u, d - E @ u, max(violation, 0.0), at_bounds, solution.primal_residual(), solution.dual_residual()
    )
