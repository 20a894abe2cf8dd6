"""Look-and-move: from a pose error to the motor increment that corrects it by the (enhanced) model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._checks import check_finite, check_kind, check_shape
from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..exceptions import EKMError, GraspError, NoContactError, ParameterError, SolverError
from ..kinematics import GraspState
from ..model import KinematicModel, ModelStatus
from ..typing import Float, Tensor
from .decision import Decision, Expectation, Grip, StopReason
from .focus import A_TARGET, FocusedPose, PoseTarget
from .limits import ActuatorLimit, JointLimit, Limit, NormalForceLimit
from .pace import Pace, contact_travel
from .qp import DEGREE, ControlProblem, ControlSolution, as_array, build_qp
from .situation import LinearizedModel, Situation
from .tasks import EffortTask, FocusTask, GripForceTask, OffAxisTask, Task

if TYPE_CHECKING:
    from ..estimation.force_sensitivity import ForceSensitivity
    from ..model import Linearization
    from ..model.linearization import FollowedFigures

#: What a step should do by default: effort, off-axis motion, grip force, focus. The figures suit the iCub
#: hand.
DEFAULT_TASKS: tuple[Task, ...] = (EffortTask(), OffAxisTask(), GripForceTask(), FocusTask())
#: What a step must not do by default: limits of actuators, normal forces and joints.
DEFAULT_LIMITS: tuple[Limit, ...] = (ActuatorLimit(), NormalForceLimit(), JointLimit())

_LIST = "a list of objects with a method rows(model, seen)"

# of the SQP for a model that is not linear in the action
_ITERATIONS = 6
_DAMPING = 0.6  # share of each change that is made
_TOLERANCE = 1e-3 * DEGREE  # [rad] a smaller change is the last


class LookAndMoveController:
    """Optimal look-and-move controller on a kinematic model or an enhanced one.

    At each step it solves (section III.B of the E-KM paper, made feasible)::

        min_da  sum of the tasks' squares and of rho |sl|_1
        s.t.    M_c E_p (f + g)(s, da) + sl = dx_d,    dx_d = e min(gain, step/|e|, c/|v(e)|)
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
        pace: how far a step goes; None: a new :class:`Pace`, which adapts if the model is an enhanced one.

    Raises:
        ParameterError: no kinematic model, or a task or limit without a method ``rows``.
    """

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        focus: FocusedPose | Float[Tensor, " 3"],
        tasks: Sequence[Task] | None = None,
        limits: Sequence[Limit] | None = None,
        pace: Pace | None = None,
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
        self.pace = Pace(adapts=self.enhanced is not None) if pace is None else pace
        self.forces: ForceSensitivity | None = None
        """What was learned of how the pads' forces answer; a :class:`ClosedLoop` sets it."""
        self.tighter = 0.0
        """Grip force on top of the one that suits the object [N]."""
        for part in (*self.tasks, *self.limits):
            if isinstance(part, type) or not callable(getattr(part, "rows", None)):
                raise ParameterError("tasks, limits", part, _LIST)
        self._weight = float(torch.linalg.vector_norm(self.kinematic.weight))
        self._previous: tuple[Linearization, Tensor] | None = None

    def follow(self, figures: FollowedFigures) -> None:
        """Let f of the enhanced model follow the figures of the hand as they are learned."""
        if self.enhanced is not None and self.kinematic.figures is not figures:
            self.kinematic = self.enhanced.model = self.kinematic.with_figures(figures)

    def reset(self) -> None:
        """Forget the contact forces and the tighter grip of the last grasp; a :class:`ClosedLoop` does so
        when it begins."""
        self._previous, self.tighter = None, 0.0

    def expect(self, lin: Linearization, moved: Float[Tensor, " n_a"]) -> Expectation:
        """``(f + g)(s, w)`` of what the encoders did from a linearized state, and how sure g is of it."""
        nominal = lin.step(moved)
        if self.enhanced is None:
            return Expectation(moved, nominal, nominal, torch.zeros_like(nominal))
        g, variance = self.enhanced.correction(lin.state, moved, len(nominal))
        return Expectation(moved, nominal, nominal + g, variance.sqrt())

    def _linearize(self, state: GraspState, a: Tensor, fingertip_force: Tensor | None) -> Linearization:
        """The kinematic model with the forces that the fingertips and the last forces speak for."""
        last, expected = None, None
        if self._previous is not None:
            last, then = self._previous
            expected = last.forces_after(a - then)
        lin = self.kinematic.linearize(
            state, fingertip_force=fingertip_force, expected=expected, previous=last
        )
        if self.forces is not None:
            pads = self.kinematic.hand.pad_indices(lin.contacts.finger)
            lin = lin.with_normal_sensitivity(self.forces.corrected(lin.normal_force_sensitivity, pads))
        if lin.forces.solved:
            self._previous = lin, a
        return lin

    def _joint_force(self, lin: Linearization) -> Tensor | None:
        """Normal forces without the pads', where these leave a torque of the joints unexplained."""
        if all(doubt.kind is not ModelStatus.UNEXPLAINED_TORQUE for doubt in lin.doubts):
            return None
        try:
            forces = self.kinematic.linearize(lin.state, lin.contacts).forces
        except GraspError:
            return None
        return forces.normal if forces.solved else None

    def retreat(self, at: Decision, delta_a: Float[Tensor, " n_a"]) -> Decision:
        """The decision to undo a motion, instead of the one that was taken ``at`` the state."""
        lin, still = at.linearization, at.predicted.new_zeros(at.predicted.shape)
        predicted, nominal = still, still
        if lin is not None:
            predicted, nominal = self.expect(lin, delta_a).increment, lin.described_jacobian @ delta_a
        desired = self.focus.matrix @ predicted[-6:]
        return Decision(
            delta_a, StopReason.RUNNING, desired, predicted, nominal, share=0.0, linearization=lin
        )

    def decide(
        self,
        state: GraspState,
        a: Float[Tensor, " n_a"],
        target: PoseTarget,
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
    ) -> Decision:
        """Choose the next increment.

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
        hand = self.kinematic.hand
        check_shape("a", a, (hand.n_a,))
        check_finite("a", a)
        if fingertip_force is not None:
            check_shape("fingertip_force", fingertip_force, (len(hand.pads),))
            check_finite("fingertip_force", fingertip_force)
            least = self.kinematic.options.forces.normal_std
            fingertip_force = fingertip_force.where(fingertip_force.abs() >= least, torch.nan)
            if bool(fingertip_force.isnan().all()):
                fingertip_force = None
        error = check_kind("target", target, PoseTarget, A_TARGET).error(state)
        check_shape("target", error, (6,))
        check_finite("target", error)
        focused = self.focus.matrix @ error
        try:
            lin = self._linearize(state, a, fingertip_force)
        except NoContactError as failure:
            if self._previous is not None or fingertip_force is None:
                return self._none(StopReason.OBJECT_LOST, failure, focused)
            held = NoContactError(f"{failure}; but pads measure forces: check the object's size and pose")
            return self._none(StopReason.UNSTABLE_GRASP, held, focused)
        except GraspError as failure:
            return self._none(StopReason.UNSTABLE_GRASP, failure, focused)

        travel = contact_travel(self.focus.matrix.mT @ focused, lin.contacts.point - state.position)
        desired, share = self._ask(focused, travel, fingertip_force is not None)
        alone = None if fingertip_force is None else self._joint_force(lin)
        seen = Situation(
            hand, self.focus, state, a, fingertip_force, error, desired, alone, self._weight, self.tighter
        )
        if self.forces is not None:
            drift = self.forces.drift[hand.pad_indices(lin.contacts.finger)]
            seen = dataclasses.replace(seen, drift=as_array(drift))
        grips = (task.wanted(lin, seen) for task in self.tasks if isinstance(task, GripForceTask))
        seen = dataclasses.replace(seen, grip=next(grips, None))
        try:
            start = LinearizedModel.about(a.new_zeros(hand.n_a), lin, self.enhanced)
            da, predicted, problem, solution = self._solve(lin, seen, start)
            phi = self.pace.cut(lin, da, predicted, seen, share)
            if phi < 1:
                desired, share = phi * desired, phi * share
                seen = dataclasses.replace(seen, desired=desired)
                da, predicted, problem, solution = self._solve(lin, seen, start)
        except SolverError as failure:  # it cannot be infeasible, as all rows have slack
            return self._none(StopReason.UNSTABLE_GRASP, failure, focused)
        nominal = lin.described_jacobian @ da
        slack = float(np.abs(solution.slack).max(initial=0.0))
        asked = float((self.focus.tolerance_scale * desired).abs().max())
        limited = slack > 0.05 * asked and self._at_limit(a, da, problem)
        grip = self._grip(lin, seen)
        return Decision(
            da, StopReason.RUNNING, desired, predicted, nominal, share, limited, slack, lin, grip=grip
        )

    def _grip(self, lin: Linearization, seen: Situation) -> Grip | None:
        """What the fingers bear and should bear; None where nothing is known or asked of it."""
        f_n = seen.normal_force(lin)
        least = next((limit for limit in self.limits if isinstance(limit, NormalForceLimit)), None)
        if f_n is None or least is None:
            return None
        force, needed = torch.from_numpy(f_n), torch.from_numpy(least.least(f_n, seen))
        std = torch.zeros_like(force)
        if self.forces is not None:
            std = self.forces.variance.sqrt()[seen.hand.pad_indices(lin.contacts.finger)]
        return Grip(force, needed, std, seen.grip or 0.0)

    def _none(self, status: StopReason, failure: EKMError, focused: Tensor) -> Decision:
        """No motion, and why."""
        hand = self.kinematic.hand
        zero, still = focused.new_zeros(hand.n_a), focused.new_zeros(hand.n_q + 6)
        return Decision(zero, status, self._ask(focused)[0], still, still, message=str(failure))

    def _ask(self, focused: Tensor, travel: float = 0.0, measures: bool = True) -> tuple[Tensor, float]:
        """dx_d and its share of the largest step; the pace counts in turns."""
        scale = self.focus.step_scale
        desired, share = self.pace.ask(scale * focused, travel, measures)
        return desired / scale, share

    def _solve(
        self, lin: Linearization, seen: Situation, start: LinearizedModel
    ) -> tuple[Tensor, Tensor, ControlProblem, ControlSolution]:
        """The best increment, what the model predicts of it, and the last program with its solution."""
        enhanced, da, model = self.enhanced, seen.a.new_zeros(len(seen.a)), start
        linear = enhanced is None or enhanced.affine
        for iteration in range(1 if linear else _ITERATIONS):
            if iteration:
                model = LinearizedModel.about(da, lin, enhanced)
            problem = build_qp(len(da), [part.rows(model, seen) for part in (*self.tasks, *self.limits)])
            solution = problem.solve()
            best = torch.as_tensor(solution.u, dtype=da.dtype)
            change = best - da
            done = linear or float(change.abs().max()) <= _TOLERANCE
            da = best if done else da + _DAMPING * change
            if done:
                break
        predicted = model.offset + model.jacobian @ da
        if enhanced is not None and not linear:
            predicted = enhanced.linearize(seen.state, da, lin.manipulation_jacobian)[0]
        return da, predicted, problem, solution

    def _at_limit(self, a: Tensor, da: Tensor, problem: ControlProblem) -> bool:
        """An actuator that may move ends at the end of its range."""
        hand, after, margin = self.kinematic.hand, as_array(a + da), 0.01 * DEGREE
        lower, upper = problem.bounds
        at_end = (after <= hand.actuator_lower + margin) | (after >= hand.actuator_upper - margin)
        return bool((at_end & ((lower != 0) | (upper != 0))).any())
