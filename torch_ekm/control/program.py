"""The controller's quadratic program: what its rows are made from, their sum, and its solution.

It is solved for u in degrees: of the order of 1, like its rows.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .._arrays import EqualityProgram, solve_by_active_set
from .._extras import require
from .._noise import DEGREE
from ..description import HandDescription
from ..enhanced import EnhancedModel
from ..exceptions import NonFiniteError, ParameterError, ShapeError, SolverError
from ..kinematics import GraspState
from ..model import Linearization
from ..typing import Array, Float, Tensor
from .focus import FocusedPose

Numbers = Tensor | Array | float


def of_pads(
    hand: HandDescription, names: Sequence[str], values: Float[Tensor, " n_c"], nothing: float = 0.0
) -> Float[Tensor, " n_pads"]:
    """A figure of each contact as one of each pad of the hand: ``nothing`` where that does not touch."""
    rows, pads = hand.pad_rows(names)
    found = values.new_full((len(hand.pads),), nothing)
    found[pads] = values[rows]
    return found


@dataclass(frozen=True)
class Situation:
    """What was seen and what is wanted, the same for all iterations of a decision."""

    hand: HandDescription
    focus: FocusedPose
    state: GraspState
    a: Float[Tensor, " n_a"]
    """Encoders [rad]."""
    fingertip_force: Float[Tensor, " n_pads"] | None
    """Measured normal force of each pad [N], NaN where unknown; None: no pad measures."""
    error: Float[Tensor, " 6"]
    """e, the twist to the target [m, rad]."""
    desired: Float[Tensor, " n_x"]
    """dx_d, what one step shall do to the focused pose."""
    joint_force: Float[Tensor, " n_c"] | None = None
    """Normal force of each contact by joints and springs alone [N], where they contradict the pads."""
    weight: float = 0.0
    """Of the object [N]."""
    tighter: float = 0.0
    """Wanted on top of the grip that suits the object [N]."""
    drift: Array | None = None
    """By which the normal forces change as the object turns by :attr:`desired`, whatever the motors do [N];
    None: 0."""
    bend: Float[Tensor, " n_s"] | None = None
    """c of ``f(s, u) ~ J u + c`` about a motion that is not small, J that of the linearization; None: 0."""
    grip: float | None = None
    """Wanted of the finger that opposes the others, see :class:`GripForceTask` [N]; None: nothing."""

    def drift_of(self, contacts: list[int]) -> Array:
        """:attr:`drift` of some of the contacts."""
        return np.zeros(len(contacts)) if self.drift is None else self.drift[contacts]

    def pads(self, kinematic: Linearization) -> list[int]:
        """Which contacts are pads'; the others are links without one."""
        return self.hand.pad_rows(kinematic.contacts.finger)[0]

    def normal_force(self, kinematic: Linearization) -> Array | None:
        """``f_n`` of each contact [N]: as its pad measures it, or else as the model estimates it.

        None: nothing is measured, and the model finds no forces either.
        """
        estimated = as_array(kinematic.forces.normal) if kinematic.forces.solved else None
        if self.fingertip_force is None:
            return estimated
        rows, pads = self.hand.pad_rows(kinematic.contacts.finger)
        measured = np.full(len(kinematic.contacts.finger), np.nan)  # of a link without a pad
        measured[rows] = as_array(self.fingertip_force)[pads]
        return np.where(np.isnan(measured), 0.0 if estimated is None else estimated, measured)


def grip_shares(f_n: Array, grip: float) -> Array:
    """What is wanted of each finger ``(n_c,)`` [N]: the one that presses most, with ``grip``, opposes all
    that share."""
    wanted = np.full(len(f_n), grip / max(len(f_n) - 1, 1))
    wanted[f_n.argmax()] = grip
    return wanted


@dataclass(frozen=True)
class LinearizedModel:
    """``(f + g)(s, u) ~ offset + jacobian u`` near one action."""

    kinematic: Linearization
    """f alone, with its contacts and forces and how they answer to the actuators."""
    offset: Float[Tensor, " n_s"]
    jacobian: Float[Tensor, "n_s n_a"]
    """Rows: joints [rad/rad], object point [m/rad], object rotation [rad/rad]."""

    @classmethod
    def about(
        cls,
        action: Float[Tensor, " n_a"],
        kinematic: Linearization,
        enhanced: EnhancedModel | None = None,
        bend: Float[Tensor, " n_s"] | None = None,
    ) -> LinearizedModel:
        """``(f + g)(a + d) ~ value + J d = (value - J a) + J (a + d)`` about one action a."""
        J = kinematic.manipulation_jacobian
        offset = J.new_zeros(len(J)) if bend is None else bend
        if enhanced is not None:
            value, J = enhanced.linearize(kinematic.state, action, J)
            offset = offset + value - J @ action
        return cls(kinematic, offset, J)


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
