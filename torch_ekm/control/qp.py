"""The controller's quadratic program: rows in, one function sums them, another solves the sum.

It is solved for u in degrees: of the order of 1, like its rows.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .._extras import require
from .._noise import DEGREE
from ..contact.forces.active_set import EqualityProgram, solve_by_active_set
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


@dataclass(frozen=True)
class ControlSolution:
    """The best increment."""

    u: Array
    """[rad]"""
    slack: Array
    """``b - A u``: what of the equalities could not be met, in their unit."""
    violation: float
    """Largest violation of an inequality, in its unit."""


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

    @property
    def qp(self) -> Any:
        """The same with its slacks, a ``qpsolvers.Problem`` over ``z = [u; sl+; sl-; t]``."""
        (A, b, rho), (C, h, rho_t), (lower, upper) = self.equality, self.inequality, self.bounds
        n_e, n_t = len(b), len(h)
        slacks = 2 * n_e + n_t
        A = np.hstack([A, np.eye(n_e), -np.eye(n_e), np.zeros((n_e, n_t))])
        G = np.hstack([C, np.zeros((n_t, 2 * n_e)), -np.eye(n_t)])
        return require("qpsolvers").Problem(
            np.pad(self.P, (0, slacks)),
            np.concatenate([self.q, rho, rho, rho_t]),
            *((G, h) if n_t else (None, None)),
            *((A, b) if n_e else (None, None)),
            np.pad(lower, (0, slacks)),
            np.pad(upper, (0, slacks), constant_values=np.inf),
        )

    def solve(self) -> ControlSolution:
        """The best u: by an active set where all rows can be met, else by the open-source solver PIQP.

        Raises:
            SolverError: the solver did not find a solution, or is not installed.
        """
        (A, b, _), (C, h, _) = self.equality, self.inequality
        u = self._without_slack()
        u = np.clip(self._by_piqp() if u is None else u, *self.bounds)
        broken = float(np.max(C @ u - h, initial=0.0))
        return ControlSolution(u * DEGREE, (b - A @ u) * DEGREE, broken)

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
        qpsolvers = require("qpsolvers")
        try:
            solution = qpsolvers.solve_problem(self.qp, solver="piqp")
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
        _check(row, n_u)
        if isinstance(row, Squares):
            unit, weight = as_array(row.unit).reshape(-1, 1), as_array(row.weight).reshape(-1, 1)
            A, b = as_array(row.A) * DEGREE / unit, as_array(row.b) / unit[:, 0]
            twice = 2 * A.T
            P += twice @ (weight * A)
            q -= twice @ (weight[:, 0] * b)
        elif isinstance(row, Equality):
            d = as_array(row.b) / DEGREE
            reached.append((as_array(row.A), d, np.full(len(d), as_array(row.penalty))))
        elif isinstance(row, Inequality):
            h = as_array(row.h) / row.unit
            kept.append((as_array(row.C) * (DEGREE / row.unit), h, np.full(len(h), row.penalty)))
        else:
            lower = np.maximum(lower, as_array(row.lower) / DEGREE)
            upper = np.minimum(upper, as_array(row.upper) / DEGREE)
    crossed = np.flatnonzero(lower > upper)
    if crossed.size:
        i = int(crossed[0])
        raise ParameterError(f"lower[{i}]", lower[i] * DEGREE, f"at most upper[{i}] = {upper[i] * DEGREE}")
    return ControlProblem(P, q, _stack(reached), _stack(kept), (lower, upper))


def _check(row: Rows, n_u: int) -> None:
    kind, A, b = type(row).__name__, as_array(row[0]), as_array(row[1])
    if A.shape[-1:] not in ((), (n_u,)):
        raise ShapeError(f"rows of {kind}", f"(n, {n_u})", A.shape)
    if isinstance(row, Bounds):
        for name, value in zip(row._fields, (A, b), strict=True):
            if value.shape not in ((), (n_u,)):
                raise ShapeError(f"{name} of Bounds", f"({n_u},)", value.shape)
            if np.isnan(value).any():
                raise ParameterError(f"{name} of Bounds", value.tolist(), "numbers, or infinite")
        return
    if b.shape not in ((), A.shape[:-1]):
        raise ShapeError(f"{row._fields[1]} of {kind}", f"{A.shape[:-1]}", b.shape, "one entry for each row")
    if isinstance(row, Squares | Inequality) and not (as_array(row.unit) > 0).all():
        raise ParameterError(f"unit of {kind}", row.unit, "greater than 0")
    if isinstance(row, Squares) and not (as_array(row.weight) >= 0).all():
        raise ParameterError("weight", row.weight, "at least 0: the program is convex")
    if not all(np.isfinite(as_array(value)).all() for value in row):
        raise NonFiniteError(f"{row._fields[0]}, {row._fields[1]} of {kind}")


def as_array(x: Numbers) -> Array:
    """float64 in numpy, in which the solvers count."""
    return np.asarray(x.numpy(force=True) if isinstance(x, Tensor) else x, np.float64)


def _stack(parts: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    A, b, rho = zip(*parts, strict=True)
    return np.vstack(A), np.concatenate(b), np.concatenate(rho)
