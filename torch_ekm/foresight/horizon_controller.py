"""Look-and-move with foresight: the whole turn is planned, its first motion made, the rest planned again."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..control import (
    Bounds,
    ControlProblem,
    ControlSolution,
    Limit,
    LimitingFunction,
    LookAndMoveController,
    Situation,
    StepBound,
    Task,
    build_qp,
)
from ..control.limiting import contact_travel
from ..control.qp import DEGREE, as_array
from ..exceptions import GraspError, ParameterError, SolverError
from ..typing import Float, Tensor
from .configuration import Configuration, settled
from .limits import SlipLimit
from .path import Path, PathModel, Rates, continued, joined
from .plan_problem import MotionRows, nearer_goal, plan_problem
from .plan_rows import PlanRows, error_of, situation

if TYPE_CHECKING:
    from ..control import Decision, FocusedPose, PoseTarget
    from ..enhanced import EnhancedModel
    from ..kinematics import GraspState
    from ..model import KinematicModel, Linearization

_PACE = 1e4
"""Penalty of a motion that is longer than the pace allows, per degree: above that of the goal."""


_Step = tuple[Tensor, Tensor, ControlProblem, ControlSolution]

_DOUBTFUL = 0.7
"""Where the step bound would make a smaller share of a first motion, a single step may be better."""
_WAITS = 0.5
"""Share of the mean motion below which a plan's first motion counts as waiting."""
_SHORT = 0.05 * DEGREE
"""A goal that a program misses by more is brought nearer [unit of the focus]."""
_STRIDES = 4
"""Single steps of which a first guess is made, each worth several motions."""
_REACH = 8.0
"""How far an iteration may bring an actuator from where the last path has it [deg]."""


class HorizonController(LookAndMoveController):
    """Plans w_0 .. w_{K-1} and commands w_0.

    ```
    min  sum_k sum of the tasks' squares at motion k  +  rho |sl|_1
    s.t. z_{k+1} = z_k (+) (dz/da)(z_k) w_k            state, contacts and forces, see Rollout
         M_c e(z_K) + sl = 0                            the goal stands at the end
         |M_c E_p ds_k| <= pace step_k                  no motion is longer than the limiting function allows
         the limits, at every motion
    ```

    Args:
        horizon: motions that are foreseen at most. Fewer where the goal is nearer; where one is enough, it is
            the look-and-move controller's.
        sqp_iterations: quadratic programs of the first plan at most.
        receding_iterations: and of those that go on from the last one.
        along: limits on the way, beside those of every step.

    The others are those of :class:`LookAndMoveController`, which turns grasps as far and loses fewer objects
    beyond Table I (measured: the page "Foresight" of the benchmarks).
    """

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        focus: FocusedPose | Float[Tensor, 3],
        tasks: Sequence[Task] | None = None,
        limits: Sequence[Limit] | None = None,
        limiting: LimitingFunction | None = None,
        *,
        horizon: int = 12,
        along: Sequence[Limit] = (SlipLimit(),),
        sqp_iterations: int = 2,
        receding_iterations: int = 1,
        sqp_damping: float = 0.6,
        sqp_tolerance: float = 0.1 * DEGREE,
        bound: StepBound | None = None,
        solver: str = "piqp",
    ) -> None:
        super().__init__(
            model, focus, tasks, limits, limiting, sqp_iterations=sqp_iterations, sqp_damping=sqp_damping,
            sqp_tolerance=sqp_tolerance, bound=bound, solver=solver,
        )  # fmt: skip
        if not horizon >= 1:
            raise ParameterError("horizon", horizon, "at least one motion")
        self.horizon, self.receding_iterations, self.along = horizon, receding_iterations, tuple(along)
        self.paths = PathModel(self.kinematic, self.enhanced)
        self.plan: Path | None = None
        """The last decision's; None: there was none, or the grasp could not be foreseen."""
        self._before: tuple[Rates, Tensor] | None = (
            None  # of the decision before, and what it left of the error
        )
        self._now: tuple[Rates, Tensor] | None = None
        self._first: _Step | None = None  # this decision's

    def reset(self) -> None:
        """Forget the plan as well."""
        super().reset()
        self.plan = self._before = self._now = self._first = None

    def decide(
        self,
        state: GraspState,
        a: Float[Tensor, " n_a"],
        target: PoseTarget,
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
    ) -> Decision:
        """The first motion of a plan; see :meth:`LookAndMoveController.decide`."""
        self.plan = self._now = self._first = None
        decision = super().decide(state, a, target, fingertip_force)
        self._before = self._now
        return decision

    def retreat(self, at: Decision, delta_a: Float[Tensor, " n_a"]) -> Decision:
        """The way back is none of the plan's."""
        self._before = None
        return super().retreat(at, delta_a)

    def _solve(self, lin: Linearization, seen: Situation) -> _Step:
        if self._first is not None:  # the same decision, asked for less
            longest = torch.linalg.vector_norm(seen.desired)
            way = torch.linalg.vector_norm(self.focus.matrix @ self._first[1][-6:])
            return self._cut(lin, self._first, min(1.0, float(longest / way.clamp_min(1e-12))))
        K, left = self._motions_left(lin, seen)
        if K > 1:
            try:
                step = self._planned(lin, seen, K, left)
            except (GraspError, SolverError):  # somewhere on the way: one step is foreseen as ever
                step = super()._solve(lin, seen)
            share, refused = self._share(lin, seen, step), self._buckles() or self._waits(seen, step, K, left)
            if refused or share < _DOUBTFUL:
                single = super()._solve(lin, seen)
                if refused or self._share(lin, seen, single) > share:
                    self.plan = self._now = None
                    return single
            self._first = step
            return step
        return super()._solve(lin, seen)

    def _share(self, lin: Linearization, seen: Situation, step: _Step) -> float:
        """Of a motion that the step bound would make."""
        asked = self._steps(lin, seen, seen.desired)
        return self.bound.share(lin, step[0], step[1], seen, self._wanted_grip(lin, seen), asked)

    def _steps(self, lin: Linearization, seen: Situation, focused: Tensor) -> float:
        """How many of the largest steps, at pace 1, make up a focused way."""
        travel = contact_travel(self.focus.matrix.mT @ focused, lin.contacts.point - seen.state.position)
        return self.limiting.steps(focused, travel)

    def _waits(self, seen: Situation, step: _Step, K: int, left: Tensor) -> bool:
        """The plan puts off its motions: something is in the way, and will be, too, when it plans again."""
        focused = self.focus.matrix @ seen.error
        way = float(focused @ (self.focus.matrix @ step[1][-6:]) / torch.linalg.vector_norm(focused))
        return way < _WAITS * float(torch.linalg.vector_norm(focused - left)) / K

    def _buckles(self) -> bool:
        """The grasp would, on the way of the plan."""
        return self._now is not None and float(self._now[0].linearization.stability.min()) <= 0

    def _cut(self, lin: Linearization, step: _Step, share: float) -> _Step:
        """A part of a motion."""
        da, _, problem, solution = step
        da = share * da
        return da, self.predict(lin, da)[0], problem, dataclasses.replace(solution, u=as_array(da))

    def _planned(self, lin: Linearization, seen: Situation, K: int, left: Tensor) -> _Step:
        """The first motion of the best plan."""
        start = Configuration.of(lin)
        asked = PlanRows(self.tasks, (*self.limits, *self.along), self.limiting, self.pace, self.enhanced)
        path = self._guess(lin, seen, K, left)
        for _ in range(self.sqp_iterations if self._before is None else self.receding_iterations):
            rates = self.paths.linearize(path)
            motions = asked.about(seen, path, rates, left)
            path, solution = self._best(start, rates, motions)
            if float((path.actions[0] - rates.actions[0]).abs().max()) <= self.sqp_tolerance:
                break
        self._now, self.plan = (rates, left), path
        da, rows = path.actions[0], motions[0].motion
        first = dataclasses.replace(solution, u=as_array(da))
        problem = build_qp(len(da), [Bounds(*(DEGREE * x for x in (rows.lower, rows.upper)))])
        return da, self.predict(lin, da)[0], problem, first

    def _motions_left(self, lin: Linearization, seen: Situation) -> tuple[int, Tensor]:
        """K, and what of the focused error will be left after as many motions."""
        focused = self.focus.matrix @ seen.error
        steps = self._steps(lin, seen, focused) / self.pace
        if self.limiting.gain * steps <= 1:
            return 1, 0 * focused
        K = min(math.ceil(steps - 1e-9), self.horizon)
        first = float(torch.linalg.vector_norm(seen.desired) / torch.linalg.vector_norm(focused))
        return K, focused * max(0.0, 1 - first - (K - 1) / steps)

    def _best(
        self, start: Configuration, rates: Rates, motions: list[MotionRows]
    ) -> tuple[Path, ControlSolution]:
        """The path of the best actions, by the rates about which the rows were taken."""
        problem, free = plan_problem(motions, _REACH)
        solution = problem.solve(self.solver)
        if np.abs(solution.slack).max(initial=0.0) > _SHORT:
            path = np.concatenate([one.after[free] for one in motions])
            solution = nearer_goal(problem, path, solution).solve(self.solver)
        old = rates.actions
        way = np.zeros(old.shape)
        way[:, free] = solution.u.reshape(len(motions), -1)
        actions = torch.as_tensor(np.diff(way, axis=0, prepend=0.0), dtype=old.dtype)
        if not (self.enhanced is None or self.enhanced.affine):
            actions = old + self.sqp_damping * (actions - old)
        return self.paths.follow(start, rates, actions), solution

    def _guess(self, lin: Linearization, seen: Situation, K: int, left: Tensor) -> Path:
        """The rest of the last plan, from where the grasp is now; at first, single steps."""
        start = Configuration.of(lin)
        if self._before is not None:
            rates, rest = self._before
            share = 1.0 if bool(rest.abs().max() > 0) else max(len(rates.actions) - 1, 1) / K
            rates = continued(rates, K, share)
            return self.paths.follow(start, rates, rates.actions)
        pads = torch.tensor(seen.hand.pad_indices(lin.contacts.finger))
        z, moved_by, at = start, torch.zeros_like(seen.a), 0
        parts, actions, increments = [], [], []
        while at < K:
            count = min(-(-K // _STRIDES), K - at)
            error = error_of(z.state, seen)
            desired = (self.focus.matrix @ error - left) * count / (K - at)
            now = situation(
                seen, z.state, moved_by, error, desired, pads, z.forces.normal - start.forces.normal
            )
            da, ds, _, _ = super()._solve(lin, now)
            amid, after = self.paths.steps(z, lin, da, ds, count)
            parts.append((after, amid))
            actions += [da / count] * count
            increments += [ds / count] * count
            z, moved_by, at = after.select(-1), moved_by + da, at + count
            if at < K:
                held = settled(z)
                lin = self.kinematic.linearize(z.state, z.contacts, forces=held.forces, on_unstable="flag")
        after, middles = (functools.reduce(joined, part) for part in zip(*parts, strict=True))
        nodes = joined(start.expand(1), after)
        return Path(torch.stack(actions), nodes, middles, torch.stack(increments))
