"""The quadratic program of a plan: the rows of single motions, summed along the way."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ..control.qp import DEGREE, ControlProblem, ControlSolution, RowSum
from ..typing import Array

_BOUND = 1e4
"""Price of an actuator's bound in a motion that is not made yet, per degree: a path from another start may
break it. Those of the first motion always hold."""


@dataclass(frozen=True)
class MotionRows:
    """What tasks and limits ask of one motion, u in degrees."""

    state: RowSum
    """In u = what the actuators have moved when it is over, from where the path had them before it."""
    motion: RowSum
    """In u = w_k; its bounds are those of the actuators."""
    before: Array
    """Where the path has the actuators before it, from the start [deg]."""
    after: Array
    """And after it."""


def plan_problem(motions: Sequence[MotionRows], reach: float) -> tuple[ControlProblem, NDArray[np.int64]]:
    """The sum over all motions, in ``c_k = w_0 + .. + w_k``, where motion k leaves the actuators.

    ::

        state rows    A (c_k - before_k) ~ b         before_k = w_0 + .. + w_{k-1} of the path
        motion rows   A (c_k - c_{k-1})  ~ b         bounds among them
        goal          the equalities of the last motion

    In these unknowns the rows of a state touch c_k alone, the Hessian is block tridiagonal, and actuators
    that do not move drop out. Equalities of other motions than the last are left out: they say what is to be
    reached, and that stands at the end.

    Args:
        reach: how far an actuator may go from where the path has it [deg]: farther, the rates are others.

    Returns:
        The program over ``c_0 .. c_{K-1}`` of the actuators that may move, and which these are.
    """
    bounds = np.array([(one.motion.lower, one.motion.upper) for one in motions])
    free = np.flatnonzero((bounds != 0).any((0, 1)))
    m = len(free)
    size = len(motions) * m
    P, q, soft = np.zeros((size, size)), np.zeros(size), _Rows(size)
    for k, one in enumerate(motions):
        D = np.zeros((m, size))  # w_k = D c
        D[:, k * m : (k + 1) * m] = np.eye(m)
        here = D.copy()
        if k:
            D[:, (k - 1) * m : k * m] = -np.eye(m)
        for part, way, moved in ((one.state, here, one.before), (one.motion, D, 0.0 * one.before)):
            P += way.T @ part.P[np.ix_(free, free)] @ way
            q += (part.q - part.P @ moved)[free] @ way
            soft.add(part.C[:, free] @ way, part.h + part.C @ moved, part.rho_t)
        lower, upper = bounds[k][:, free]
        if k:
            soft.add(np.vstack([D, -D]), np.concatenate([upper, -lower]), np.full(2 * m, _BOUND))
    box = np.array([one.after for one in motions])[:, free] + reach * np.array([-1.0, 1.0])[:, None, None]
    lower, upper = bounds[0][:, free]  # of the first motion, which is c_0
    box[0, 0], box[1, 0] = np.clip(box[0, 0], lower, upper), np.clip(box[1, 0], lower, upper)
    return _problem(motions[-1], free, P, q, soft, box.reshape(2, -1)), free


def nearer_goal(problem: ControlProblem, path: Array, solution: ControlSolution) -> ControlProblem:
    """The same program with a goal at nine tenths of the way that its solution found towards it.

    Where the goal is beyond what the bounds of an iteration let it reach, its penalty outweighs every wish,
    and the program lives on differences between the rates of its motions that are none. Source: the relaxed
    equalities of Byrd and Omojokun; Nocedal and Wright, Numerical Optimization (2006), section 18.5.

    Args:
        path: c of the path [deg].
    """
    qp = copy.copy(problem.qp)
    now = qp.A[:, : problem.n_u] @ path
    qp.b = now + 0.9 * (qp.b - solution.slack / DEGREE - now)
    return ControlProblem(qp, problem.n_u)


class _Rows:
    """Inequalities ``C c - t <= h``, t >= 0 at a price."""

    def __init__(self, size: int) -> None:
        self.C, self.h, self.price = [np.zeros((0, size))], [np.zeros(0)], [np.zeros(0)]

    def add(self, C: Array, h: Array, price: Array) -> None:
        self.C.append(C)
        self.h.append(h)
        self.price.append(price)


def _problem(
    last: MotionRows, free: NDArray[np.int64], P: Array, q: Array, soft: _Rows, box: Array
) -> ControlProblem:
    size, m, goal = len(q), len(free), last.state
    n_e = len(goal.d)
    E = np.zeros((n_e, size))
    E[:, size - m :] = goal.E[:, free]
    d, rho = goal.d + goal.E @ last.before, goal.rho
    C, h, price = np.vstack(soft.C), np.concatenate(soft.h), np.concatenate(soft.price)
    n_t = len(h)
    width, e, t = size + 2 * n_e + n_t, np.arange(n_e), np.arange(n_t)
    filled, reached, kept = P.nonzero(), E.nonzero(), C.nonzero()
    lower, upper = np.zeros(width), np.full(width, np.inf)
    lower[:size], upper[:size] = box
    goals = [(E[reached], *reached), (np.ones(n_e), e, size + e), (-np.ones(n_e), e, size + n_e + e)]
    qp = require("qpsolvers").Problem(
        _sparse([(P[filled], *filled)], (width, width)),
        np.concatenate([q, rho, rho, price]),
        _sparse([(C[kept], *kept), (-np.ones(n_t), t, size + 2 * n_e + t)], (n_t, width)),
        h,
        _sparse(goals, (n_e, width)) if n_e else None,
        d if n_e else None,
        lower,
        upper,
    )
    return ControlProblem(qp, size)


def _sparse(parts: Sequence[tuple[Any, ...]], shape: tuple[int, int]) -> Any:
    """A matrix from (values, rows, columns)."""
    values, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
    return require("scipy.sparse").csc_matrix((values, (rows, columns)), shape=shape)
