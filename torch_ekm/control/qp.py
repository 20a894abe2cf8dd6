"""The controller's quadratic program: rows in, one function sums them, another solves the sum.

It is solved for u in degrees: of the order of 1, like its rows.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .._extras import require
from .._noise import DEGREE
from ..contact.forces.solve import EqualityProgram, solve_by_active_set
from ..exceptions import NonFiniteError, ParameterError, ShapeError, SolverError
from ..typing import Array, Tensor

Numbers = Tensor | Array | float


class Squares(NamedTuple):
    """``sum_j w_j ((A_j u - b_j) / unit_j)^2``: what is wanted, more or less; A ``(n, n_a)``, u [rad]."""

    A: Numbers
    b: Numbers
    weight: Numbers = 1.0
    unit: Numbers = 1.0
    """In which a row's error is weighed: of a rotation e.g. one degree, in rad."""


class Equality(NamedTuple):
    """``rho |A u - b|_1 / (1 deg)``: what must be reached, if it can be; A ``(n, n_a)``, u [rad]."""

    A: Numbers
    b: Numbers
    penalty: Numbers = 1e3


class Inequality(NamedTuple):
    """``C u <= h``, else ``rho max(0, C u - h) / unit``: what should hold, if it can; C ``(n, n_a)``."""

    C: Numbers
    h: Numbers
    unit: float = 1.0
    penalty: float = 1e2


class Bounds(NamedTuple):
    """``lower <= u <= upper`` [rad]: what always holds."""

    lower: Numbers
    upper: Numbers


Rows = Squares | Equality | Inequality | Bounds


class ControlSolution(NamedTuple):
    """The best increment."""

    u: Array
    """[rad]"""
    slack: Array
    """``b - A u``: what of the equalities could not be met, in their unit."""


@dataclass(frozen=True)
class ControlProblem:
    """The program of one step, u in degrees, rows in their units::

        min_u,sl,t   1/2 u^T P u + q.u + rho |sl|_1 + rho_t |t|_1
        s.t.         A u + sl = b
                     C u - t <= h, t >= 0
                     lower <= u <= upper

    The l1 slacks are exact: for ``rho`` above the multipliers they are zero whenever the rows
    can be met, and otherwise the violation is least. So the problem is never infeasible
    as long as ``lower <= upper``.
    """

    P: Array
    q: Array
    equality: tuple[Array, Array, Array]
    """A, b and rho."""
    inequality: tuple[Array, Array, Array]
    """C, h and rho_t."""
    bounds: tuple[Array, Array]
    """lower and upper [deg]."""

    def solve(self) -> ControlSolution:
        """The best u: by an active set where all rows can be met, else by the open-source solver PIQP.

        Raises:
            SolverError: the solver did not find a solution, or is not installed.
        """
        A, b, _ = self.equality
        u = self._without_slack()
        u = np.clip(self._by_piqp() if u is None else u, *self.bounds)
        return ControlSolution(u * DEGREE, (b - A @ u) * DEGREE)

    def _without_slack(self) -> Array | None:
        """u, where no multiplier is above its penalty: the slacks are then 0."""
        (A, b, rho), eye = self.equality, np.eye(len(self.q))
        lower, upper = (np.isfinite(bound) for bound in self.bounds)
        G = np.concatenate([self.inequality[0], -eye[lower], eye[upper]])
        h = np.concatenate([self.inequality[1], -self.bounds[0][lower], self.bounds[1][upper]])
        penalty = np.concatenate([self.inequality[2], np.full(len(h) - len(self.inequality[1]), np.inf)])
        with contextlib.suppress(np.linalg.LinAlgError):  # rows that depend on each other
            found = solve_by_active_set(EqualityProgram(self.P, self.q, A, b), G, h, [])
            if found is not None and (found.inequality <= penalty[found.active]).all():
                return found.x if (abs(found.equality) <= rho).all() else None
        return None

    def _by_piqp(self) -> Array:
        """u, of the program with its slacks over ``z = [u; sl+; sl-; t]``."""
        qpsolvers = require("qpsolvers")
        (A, b, rho), (C, h, rho_t), (lower, upper) = self.equality, self.inequality, self.bounds
        n_e, n_t = len(b), len(h)
        slacks = 2 * n_e + n_t
        A = np.hstack([A, np.eye(n_e), -np.eye(n_e), np.zeros((n_e, n_t))])
        G = np.hstack([C, np.zeros((n_t, 2 * n_e)), -np.eye(n_t)])
        problem = qpsolvers.Problem(
            np.pad(self.P, (0, slacks)),
            np.concatenate([self.q, rho, rho, rho_t]),
            *((G, h) if n_t else (None, None)),
            *((A, b) if n_e else (None, None)),
            np.pad(lower, (0, slacks)),
            np.pad(upper, (0, slacks), constant_values=np.inf),
        )
        try:
            solution = qpsolvers.solve_problem(problem, solver="piqp")
        except Exception as error:  # back ends raise types of their own
            raise SolverError("piqp", f"{type(error).__name__}: {error}") from error
        if not solution.found or solution.x is None:
            raise SolverError("piqp", "no solution found", "bounds may be far out of scale")
        return solution.x[: len(self.q)]


def build_qp(n_u: int, rows: Iterable[Rows | None]) -> ControlProblem:
    """The program of one step: the sum of what tasks and limits ask for.

    Args:
        n_u: number of actuators.
        rows: of each task and limit; None asks for nothing.

    Raises:
        ParameterError: no rows, a negative weight, a unit of 0, or bounds that cross or are NaN.
        NonFiniteError: another figure is not finite.
        ShapeError: rows of another number of actuators, or not one right side for each row.
    """
    P, q = np.zeros((n_u, n_u)), np.zeros(n_u)
    lower, upper = np.full(n_u, -np.inf), np.full(n_u, np.inf)
    reached: list[tuple[Array, Array, Array]] = [(np.zeros((0, n_u)), np.zeros(0), np.zeros(0))]
    kept = reached.copy()
    for row in (row for row in rows if row is not None):
        if not isinstance(row, Rows):
            raise ParameterError("rows", type(row).__name__, "Squares, Equality, Inequality, Bounds or None")
        if isinstance(row, Bounds):
            lower = np.maximum(lower, _bound(row, "lower", n_u) / DEGREE)
            upper = np.minimum(upper, _bound(row, "upper", n_u) / DEGREE)
            continue
        A, b, *figures = _figures(row, n_u)
        if isinstance(row, Squares):
            weight, unit = figures
            A, b = A * DEGREE / unit[:, None], b / unit
            twice = 2 * A.T
            P += twice @ (weight[:, None] * A)
            q -= twice @ (weight * b)
        elif isinstance(row, Equality):
            reached.append((A, b / DEGREE, figures[0]))
        else:
            unit, penalty = figures
            kept.append((A * (DEGREE / unit)[:, None], b / unit, penalty))
    crossed = np.flatnonzero(lower > upper)
    if crossed.size:
        i = int(crossed[0])
        raise ParameterError(f"lower[{i}]", lower[i] * DEGREE, f"at most upper[{i}] = {upper[i] * DEGREE}")
    return ControlProblem(P, q, _stack(reached), _stack(kept), (lower, upper))


def _figures(row: Squares | Equality | Inequality, n_u: int) -> list[Array]:
    """The matrix as an array, and one figure of each other kind for each of its rows."""
    kind, (A, *rest) = type(row).__name__, map(as_array, row)
    if A.shape[1:] != (n_u,):
        raise ShapeError(f"rows of {kind}", f"(n, {n_u})", A.shape)
    for name, value in zip(row._fields[1:], rest, strict=True):
        if value.shape not in ((), A.shape[:1]):
            raise ShapeError(f"{name} of {kind}", f"{A.shape[:1]}", value.shape, "one entry for each row")
        if (name == "unit" and not (value > 0).all()) or (name == "weight" and not (value >= 0).all()):
            raise ParameterError(f"{name} of {kind}", value.tolist(), "positive: the program is convex")
    if not all(np.isfinite(value).all() for value in (A, *rest)):
        raise NonFiniteError(f"{row._fields[0]}, {row._fields[1]} of {kind}")
    return [A, *(np.broadcast_to(value, len(A)) for value in rest)]


def _bound(row: Bounds, name: str, n_u: int) -> Array:
    value = as_array(getattr(row, name))
    if value.shape not in ((), (n_u,)):
        raise ShapeError(f"{name} of Bounds", f"({n_u},)", value.shape)
    if np.isnan(value).any():
        raise ParameterError(f"{name} of Bounds", value.tolist(), "numbers, or infinite")
    return value


def as_array(x: Numbers) -> Array:
    """float64 in numpy, in which the solvers count."""
    return np.asarray(x.numpy(force=True) if isinstance(x, Tensor) else x, np.float64)


def _stack(parts: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    A, b, rho = zip(*parts, strict=True)
    return np.vstack(A), np.concatenate(b), np.concatenate(rho)
