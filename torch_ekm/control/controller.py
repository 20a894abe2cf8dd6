"""Look-and-move: from a pose error to the motor increment that corrects it by the (enhanced) model."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from .._checks import check_finite, check_kind, check_shape
from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..estimation.filters import ForceSensitivity
from ..estimation.hand_figures import DescribedFigures, HandFigures
from ..exceptions import EKMError, GraspError, NoContactError, ParameterError, SolverError
from ..kinematics import GraspState
from ..model import ContactMotion, KinematicModel, Linearization, ModelStatus
from ..typing import Float, Tensor
from .decision import Decision, Expectation, Grip, Piece, StopReason, made_of, shares
from .focus import A_TARGET, FocusedPose, PoseTarget
from .program import (
    DEGREE,
    ControlProblem,
    ControlSolution,
    LinearizedModel,
    Situation,
    as_array,
    build_qp,
    of_pads,
)
from .tasks import DEFAULT_LIMITS, DEFAULT_TASKS, Limit, LimitingFunction, StepBound, Task, contact_travel

_BOUND = StepBound()
_LIST = "a list of objects with a method rows(model, seen)"

# of the SQP for a model that is not linear in the action
_ITERATIONS = 6
_DAMPING = 0.6  # share of each change that is made
_TOLERANCE = 1e-3 * DEGREE  # [rad] a smaller change is the last


class LookAndMoveController:
    """Optimal look-and-move controller on a kinematic model or an enhanced one.

    At each step it solves (section III.B of the E-KM paper, made feasible)::

        min_da  sum of the tasks' squares and of rho |sl|_1
        s.t.    M_c E_p (f + g)(s, da) + sl = phi dx_d,    dx_d = e min(gain, step/|e|, c/|v(e)|)
                the limits

    With ``g`` the program is nonlinear and is solved by a damped SQP on ``J_m + dg/da``:
    searching along the model's own direction instead turns the object off axis.

    Where no pad measures, or one reads less than ``ForceOptions.normal_std`` and may be dead, the model's
    estimate without it stands in: joints, springs and the other pads determine what it bears.

    Args:
        model: a :class:`KinematicModel`, or an :class:`EnhancedModel` around one.
        focus: what of the pose must be reached, or the axis about which the object is to be turned.
        tasks: what a step should do (:class:`Task`); None: :data:`DEFAULT_TASKS`.
        limits: what it must not do (:class:`Limit`); None: :data:`DEFAULT_LIMITS`.
        limiting: how much of the error a single step asks for; a plan has pieces of its own, see
            :class:`~torch_ekm.control.WholeTurn`.
        bound: phi, how much of that is made; None: all of it.

    Raises:
        ParameterError: no kinematic model, or a task or limit without a method ``rows``.
    """

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        focus: FocusedPose | Float[Tensor, " 3"],
        tasks: Sequence[Task] | None = None,
        limits: Sequence[Limit] | None = None,
        *,
        limiting: LimitingFunction | None = None,
        bound: StepBound | None = _BOUND,
    ) -> None:
        self.kinematic, self.enhanced = kinematic_and_enhanced(model)
        check_kind(
            "model", self.kinematic, KinematicModel, "a KinematicModel, or an EnhancedModel around one"
        )
        self.focus = focus if isinstance(focus, FocusedPose) else FocusedPose.rotation_about(focus)
        self.tasks = DEFAULT_TASKS if tasks is None else tuple(check_kind("tasks", tasks, Sequence, _LIST))
        self.limits = (
            DEFAULT_LIMITS if limits is None else tuple(check_kind("limits", limits, Sequence, _LIST))
        )
        self.limiting, self.bound = LimitingFunction() if limiting is None else limiting, bound
        self.forces: ForceSensitivity | None = None
        """What was learned of how the pads' forces answer; a :class:`ClosedLoop` sets it."""
        self.tighter = 0.0
        """Grip force on top of the one that suits the object [N]."""
        for part in (*self.tasks, *self.limits):
            if isinstance(part, type) or not callable(getattr(part, "rows", None)):
                raise ParameterError("tasks, limits", part, _LIST)
        self._wanted = next(filter(None, (getattr(one, "wanted", None) for one in self.tasks)), None)
        self._least = next(filter(None, (getattr(one, "least", None) for one in self.limits)), None)
        self._weight = float(torch.linalg.vector_norm(self.kinematic.weight))
        self.previous: tuple[Linearization, Tensor] | None = None
        """The last linearization of this grasp whose forces were found, and the encoders there."""

    def follow(self, figures: HandFigures | DescribedFigures, forces: ForceSensitivity) -> None:
        """Let f of the enhanced model follow the figures of the hand and its forces as they are learned."""
        if self.enhanced is None:
            return
        self.forces = forces
        if self.kinematic.figures is not figures:
            self.kinematic = self.enhanced.model = self.kinematic.with_figures(figures)

    def reset(self, tighter: float = 0.0) -> None:
        """Forget the contact forces of the last grasp, and grip tighter than suits the object [N]; a
        :class:`ClosedLoop` does so when it begins."""
        self.previous, self.tighter = None, tighter

    def expect(self, pieces: Sequence[Piece], moved: Float[Tensor, " n_a"]) -> Expectation:
        """``(f + g)(s, w)`` of what the tendons did in place of the pieces, and how sure g is of it.

        What they did otherwise is spread over the pieces as their ways are.
        """
        pieces = made_of(pieces, moved)
        extra = moved - sum(one.action for one in pieces)
        start = f = both = pieces[0].state
        deviation, made, last = torch.zeros_like(pieces[0].nominal), [], pieces[-1]
        for one, share in zip(pieces, shares(pieces), strict=True):
            part = share * extra
            w, g = one.action + part, torch.zeros_like(one.nominal)
            nominal = one.nominal + one.linearization.manipulation_jacobian @ part
            if self.enhanced is not None:
                g, variance = self.enhanced.correction(one.state, w, len(nominal))
                deviation = deviation + variance.sqrt()  # g errs alike along a path
            f, both = f.plus(nominal), both.plus(nominal + g)
            lin = one.linearization
            said = one.said + self._of_pads(lin, lin.described_normal_sensitivity @ part)
            made.append(Piece(lin, w, nominal, nominal + g, one.force, said))
        nominal, increment = made[0].nominal, made[0].increment
        if len(made) > 1:
            nominal, increment = f.minus(start), both.minus(start)
        lin, normal = last.linearization, last.force
        if normal is not None:
            normal = normal + self._of_pads(lin, lin.normal_force_sensitivity @ extra)
        return Expectation(moved, nominal, increment, deviation, tuple(made), normal)

    def went(self, a: Float[Tensor, " n_a"], pieces: Sequence[Piece]) -> None:
        """Forces go on from the last piece of a movement that began at encoders a [rad]."""
        last, before = pieces[-1].linearization, sum(one.action for one in pieces[:-1])
        if last.forces.solved:
            self.previous = last, a + before

    def linearize(
        self, state: GraspState, a: Float[Tensor, " n_a"], fingertip_force: Float[Tensor, " n_pads"] | None
    ) -> Linearization:
        """The kinematic model with the forces that fingertips and the last forces speak for.

        Raises:
            GraspError: the model refuses the grasp as it is.
        """
        last, expected = None, None
        if self.previous is not None:
            last, then = self.previous
            expected = last.forces_after(a - then)
        lin = self.kinematic.linearize(
            state, fingertip_force=fingertip_force, expected=expected, previous=last
        )
        if not lin.forces.solved:
            return self.corrected(lin)
        self.previous = lin, a
        answered = lin if self.forces is None else ContactMotion(self.kinematic, lin).answered(lin)
        return self.corrected(answered)

    def corrected(self, lin: Linearization) -> Linearization:
        """With what was learned of how the pads' forces answer."""
        if self.forces is None:
            return lin
        rows, pads = self.kinematic.hand.pad_rows(lin.contacts.finger)
        corrected = lin.normal_force_sensitivity.clone()
        corrected[rows] = self.forces.corrected(corrected[rows], pads)
        return lin.with_normal_sensitivity(corrected)

    def decide(
        self,
        state: GraspState,
        a: Float[Tensor, " n_a"],
        target: PoseTarget,
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
    ) -> Decision:
        """Choose the next increment: one step of the paper's loop.

        Args:
            state: measured joint angles and object pose.
            a: actuator encoders [rad].
            target: where the object shall be.
            fingertip_force: measured normal force of each pad [N]; None: the model's estimate stands in.

        Returns:
            A :class:`Decision`. A grasp that cannot be modelled gives ``delta_a = 0`` and a
            status that says so, never an exception; one that is next to buckling has a Jacobian that is
            out of all scale, and is unstable where the QP solver fails on it.

        Raises:
            NonFiniteError: an observation is NaN or infinite.
            ShapeError: an observation has the wrong size.
            EKMError: what the tasks and limits raise.
        """
        force = self.believed(a, fingertip_force)
        error = check_kind("target", target, PoseTarget, A_TARGET).error(state)
        focused = self.focus.matrix @ error
        try:
            lin = self.linearize(state, a, force)
        except NoContactError as failure:
            if self.previous is not None or force is None:
                return self.none(StopReason.OBJECT_LOST, failure, focused)
            held = NoContactError(f"{failure}; but pads measure forces: check the object's size and pose")
            return self.none(StopReason.UNSTABLE_GRASP, held, focused)
        except GraspError as failure:
            return self.none(StopReason.UNSTABLE_GRASP, failure, focused)
        travel = contact_travel(self.focus.matrix.mT @ focused, lin.contacts.point - state.position)
        scale = self.focus.step_scale
        desired = self.limiting(scale * focused, travel) / scale
        seen = self.situation(lin, a, force, error, desired)
        decision = self.choose(lin, seen)
        if self.bound is None or decision.status is not StopReason.RUNNING:
            return decision
        asked = self.limiting.steps(
            scale * desired, travel * float(desired.norm() / focused.norm().clamp(1e-12))
        )
        phi = self.bound.share(decision, seen, asked)
        return decision if phi == 1 else self.choose(lin, dataclasses.replace(seen, desired=phi * desired))

    def believed(self, a: Tensor, fingertip_force: Tensor | None) -> Tensor | None:
        """The fingertips' forces, NaN where a pad may be dead; None: no pad measures.

        Raises:
            NonFiniteError, ShapeError: see :meth:`decide`.
        """
        hand = self.kinematic.hand
        check_shape("a", a, (hand.n_a,))
        check_finite("a", a)
        if fingertip_force is None:
            return None
        check_shape("fingertip_force", fingertip_force, (len(hand.pads),))
        check_finite("fingertip_force", fingertip_force)
        least = self.kinematic.options.forces.normal_std
        force = fingertip_force.where(fingertip_force.abs() >= least, torch.nan)
        return None if bool(force.isnan().all()) else force

    def situation(
        self,
        lin: Linearization,
        a: Float[Tensor, " n_a"],
        force: Float[Tensor, " n_pads"] | None,
        error: Float[Tensor, " 6"],
        desired: Float[Tensor, " n_x"],
    ) -> Situation:
        """What the rows of tasks and limits are made from: forces as :meth:`believed` [N], e, and dx_d."""
        hand = self.kinematic.hand
        alone = None  # without the pads, where these leave a torque of the joints unexplained
        if force is not None and any(one.kind is ModelStatus.UNEXPLAINED_TORQUE for one in lin.doubts):
            with contextlib.suppress(GraspError):
                forces = self.kinematic.linearize(lin.state, lin.contacts).forces
                alone = forces.normal if forces.solved else None
        drift = None
        if self.forces is not None:
            rows, pads = hand.pad_rows(lin.contacts.finger)
            drift = np.zeros(len(lin.contacts.finger))
            way = (self.focus.matrix.mT @ desired)[3:].norm()
            drift[rows] = as_array(way * self.forces.by_way[pads])
        seen = Situation(
            hand, self.focus, lin.state, a, force, error, desired, alone, self._weight, self.tighter, drift
        )
        return seen if self._wanted is None else dataclasses.replace(seen, grip=self._wanted(lin, seen))

    def choose(self, lin: Linearization, seen: Situation) -> Decision:
        """The best increment for a dx_d."""
        try:
            da, predicted, problem, solution = self._solve(lin, seen)
        except SolverError as failure:  # it cannot be infeasible, as all rows have slack
            return self.none(StopReason.UNSTABLE_GRASP, failure, seen.desired)
        slack = float(np.abs(solution.slack).max(initial=0.0))
        asked = float((self.focus.tolerance_scale * seen.desired).abs().max())
        limited = slack > 0.05 * asked and self._at_limit(seen.a, da, problem)
        said = self._of_pads(lin, lin.described_normal_sensitivity @ da)
        force = seen.normal_force(lin)
        if force is not None:
            force = torch.from_numpy(force + (0.0 if seen.drift is None else seen.drift))
            force = self._of_pads(lin, force + lin.normal_force_sensitivity @ da, torch.nan)
        piece = Piece(lin, da, lin.step(da), predicted, force, said)
        return Decision(
            da, StopReason.RUNNING, seen.desired, predicted, lin.described_jacobian @ da, (piece,), limited,
            slack, grip=self.grip(lin, seen),
        )  # fmt: skip

    def _of_pads(self, lin: Linearization, values: Tensor, nothing: float = 0.0) -> Tensor:
        return of_pads(self.kinematic.hand, lin.contacts.finger, values, nothing)

    def grip(self, lin: Linearization, seen: Situation) -> Grip | None:
        """What the fingers bear and should bear; None where nothing is known or asked of it."""
        f_n = seen.normal_force(lin)
        if f_n is None or self._least is None:
            return None
        f_n = f_n[seen.pads(lin)]
        force, needed = torch.from_numpy(f_n), torch.from_numpy(self._least(f_n, seen))
        return Grip(force, needed, seen.grip or 0.0)

    def none(self, status: StopReason, failure: EKMError | str, desired: Tensor) -> Decision:
        """No motion, and why."""
        hand = self.kinematic.hand
        zero, still = desired.new_zeros(hand.n_a), desired.new_zeros(hand.n_q + 6)
        return Decision(zero, status, desired, still, still, message=str(failure))

    def _solve(
        self, lin: Linearization, seen: Situation
    ) -> tuple[Tensor, Tensor, ControlProblem, ControlSolution]:
        """The best increment, what the model predicts of it, and the last program with its solution."""
        enhanced, da = self.enhanced, seen.a.new_zeros(len(seen.a))
        linear = enhanced is None or enhanced.affine
        for _ in range(1 if linear else _ITERATIONS):
            model = LinearizedModel.about(da, lin, enhanced, seen.bend)
            problem = build_qp(len(da), [part.rows(model, seen) for part in (*self.tasks, *self.limits)])
            solution = problem.solve()
            best = torch.as_tensor(solution.u, dtype=da.dtype)
            change = best - da
            done = linear or float(change.abs().max()) <= _TOLERANCE
            da = best if done else da + _DAMPING * change
            if done:
                break
        if not linear:
            model = LinearizedModel.about(da, lin, enhanced, seen.bend)
        return da, model.offset + model.jacobian @ da, problem, solution

    def _at_limit(self, a: Tensor, da: Tensor, problem: ControlProblem) -> bool:
        """An actuator that may move ends at the end of its range."""
        hand, after, margin = self.kinematic.hand, as_array(a + da), 0.01 * DEGREE
        lower, upper = problem.bounds
        at_end = (after <= hand.actuator_lower + margin) | (after >= hand.actuator_upper - margin)
        return bool((at_end & ((lower != 0) | (upper != 0))).any())
