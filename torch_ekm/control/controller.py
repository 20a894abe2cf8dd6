"""Look-and-move: from a pose error to the motor increment that the (enhanced) model predicts will mend it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..enhanced.enhanced_model import EnhancedModel
from ..exceptions import GraspError, NoContactError, NonFiniteError, ShapeError
from ..kinematics.grasp_state import GraspState
from ..typing import Float, Tensor
from .focus import FocusedPose, PoseTarget
from .qp import ControlProblem, ControlSolution, solve_qp
from .termination import StopReason

if TYPE_CHECKING:
    from ..model import KinematicModel, Linearization

_DEGREE = np.pi / 180


@dataclass(frozen=True)
class ControllerOptions:
    """Every figure of the controller, in SI units (angles [rad])."""

    focus_step: float = 2.5 * _DEGREE
    """Limiting function: at most this much of the focused error is asked for in one step."""
    contact_step: float | None = 1.2e-3
    """And no contact is asked to move farther than this [m]: a wide object turns in smaller steps.
    None: no such limit."""
    focus_gain: float = 0.8
    """Share of a small focused error that one step asks for. A model that is right meets all of it,
    camera noise included; below 1 the loop averages the noise over some steps."""
    actuator_step: float = 16 * _DEGREE
    """|da| of one actuator in one step. A safety limit, not the one that sets the pace: where it cuts
    a step short, the focused pose is served at the expense of grip and off-axis motion."""
    effort_weight: float = 1e-2
    """W = effort_weight I, per deg^2 of actuator motion."""
    off_rotation_weight: float = 0.3
    """Weight of rotation off the focused axis, per deg^2."""
    off_translation_weight: float = 0.05
    """Weight of translation off the focus, per mm^2."""
    off_step_rotation: float = 0.5 * _DEGREE
    off_step_translation: float = 0.5e-3
    """How much off-axis error is corrected in one step: [rad], [m]."""
    grip_force: float | None = 5.0
    """Wanted normal force of the opposing finger (the one that presses most) [N]; None: not regulated."""
    grip_weight: float = 4.0
    """Weight of grip force errors, per N^2."""
    grip_step: float = 0.7
    """At most this much of a grip force error is corrected in one step [N]."""
    grip_min: float = 0.8
    """Soft lower bound on every finger's normal force [N]."""
    margin_min: float | None = None
    """Soft lower bound on every contact's friction margin ``mu f_n - |f_t|``, as the model has it [N];
    None: no such rows."""
    uncertainty_weight: float = 0.0
    """w_sig, weight of the learner's variance of the focused pose, per deg^2 (rotation) and per mm^2
    (translation); 0: what the learner is unsure of costs nothing."""
    joint_margin: float = 0.5 * _DEGREE
    """Joints are kept this far from their stops."""
    joint_horizon: float = 8 * _DEGREE
    """Joints have a row where actuator motions of this size could bring them to a stop. Longer ones
    are rare, and every row costs time."""
    fixed_actuators: tuple[str, ...] | None = None
    """Actuators that must not move; None: those that the hand's description calls posture actuators."""
    sqp_iterations: int = 6
    sqp_damping: float = 0.6
    """Damped iterations for a model that is not linear in the action."""
    sqp_tolerance: float = 1e-3 * _DEGREE
    solver: str = "piqp"


@dataclass(frozen=True)
class Decision:
    """What the controller wants done, what it expects, and how sure the numbers are."""

    delta_a: Float[Tensor, " n_a"]
    """Increment to command, relative to the encoders [rad]."""
    status: StopReason
    """RUNNING, or why no increment can be given."""
    desired: Float[Tensor, " n_x"]
    """dx_d, the limited error of the focused pose."""
    predicted: Float[Tensor, " n_s"]
    """(f + g)(s, da)."""
    nominal: Float[Tensor, " n_s"]
    """f(s, da) = J_m da: what the kinematic model alone predicts."""
    limited: bool = False
    """The step could not be met in full because actuators stand at their limits."""
    slack: float = 0.0
    """Largest focused error that the step leaves unmet [unit of the focus]."""
    linearization: Any = None
    solution: ControlSolution | None = None
    message: str = ""
    info: dict[str, Any] = field(default_factory=dict)


class LookAndMoveController:
    """Optimal look-and-move controller on a kinematic model or an enhanced one.

    At each step it solves (section III.B of the E-KM paper, made feasible)::

        min_da  da^T W da + off-axis and grip-force errors, weighted + rho |sl|_1
                + w_sig tr(M_c Sigma_g(s, da) M_c^T)                           (optional)
        s.t.    M_c E_p (f + g)(s, da) + sl = dx_d,    dx_d = e min(gain, 1/|S^-1 e|, c/|v(e)|)
                a_min <= a + da <= a_max,  |da| <= da_max
                q_min <= q + dq <= q_max,  f_n + (df_n/da) da >= f_min     (soft)
                m + (dm/da) da >= m_min,  m = mu f_n - |f_t|               (soft, optional)

    With ``g`` the equality is nonlinear and is solved by a damped SQP on ``J_m + dg/da``:
    searching along the model's own direction instead turns the object off axis.
    The variance is quadratic in da with an action-linear kernel, so the problem stays a convex QP;
    for other learners it is the gradient with the positive semidefinite part of the curvature.
    Grip force is regulated on what the fingertips measure; only its *sensitivity* comes from the
    model, because a grip force computed from a wrong model drops the object.

    Args:
        model: a :class:`KinematicModel`, or an :class:`EnhancedModel` around one.
        focus: what of the pose must be reached, or the axis about which the object is to be turned.
        options: figures; defaults suit the iCub hand.
    """

    def __init__(
        self,
        model: KinematicModel | EnhancedModel,
        focus: FocusedPose | Float[Tensor, 3],
        options: ControllerOptions | None = None,
    ) -> None:
        self.enhanced = model if isinstance(model, EnhancedModel) else None
        self.kinematic: KinematicModel = model.model if isinstance(model, EnhancedModel) else model  # type: ignore[assignment]
        self.focus = focus if isinstance(focus, FocusedPose) else FocusedPose.rotation_about(focus)
        self.options = options if options is not None else ControllerOptions()
        hand = self.kinematic.hand
        self._a_lower, self._a_upper = hand.actuator_lower, hand.actuator_upper
        fixed = self.options.fixed_actuators
        if fixed is None:
            fixed = tuple(actuator.name for actuator in hand.actuators if actuator.posture)
        self._fixed = [hand.actuator_names.index(name) for name in fixed]
        self._pad_index = {pad.name: i for i, pad in enumerate(hand.pads)}
        self._moving = np.flatnonzero(hand.joint_upper > hand.joint_lower)
        self._previous: Linearization | None = None

    def reset(self) -> None:
        """Forget the contact forces of the last grasp; a :class:`ClosedLoop` does so when it begins."""
        self._previous = None

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
            fingertip_force: measured normal force of each pad [N]; None: no grip rows.

        Returns:
            A :class:`Decision`. A grasp that cannot be modelled gives ``delta_a = 0`` and a
            status that says so, never an exception.

        Raises:
            NonFiniteError: an observation is NaN or infinite.
            ShapeError: an observation has the wrong size.
            SolverError: the QP solver failed (it cannot be infeasible: all rows have slack).
            ParameterError: ``uncertainty_weight`` with a learner whose variance does not depend on da.
        """
        n_a, n_q = len(self._a_lower), state.q.shape[-1]
        _check("a", a, n_a)
        if fingertip_force is not None:
            _check("fingertip_force", fingertip_force, len(self._pad_index))
        error = target.error(state)
        _check("target", error, 6)
        focused = self.focus.matrix @ error
        desired = self.limit(focused)
        zero, still = a.new_zeros(n_a), a.new_zeros(n_q + 6)
        try:
            lin = self.kinematic.linearize(state, previous=self._previous)
        except NoContactError as failure:
            return Decision(zero, StopReason.OBJECT_LOST, desired, still, still, message=str(failure))
        except GraspError as failure:
            return Decision(zero, StopReason.UNSTABLE_GRASP, desired, still, still, message=str(failure))

        if lin.forces.solved:
            self._previous = lin
        desired = self.limit(focused, self._contact_travel(state, lin.contacts.point, focused))
        J_m = lin.manipulation_jacobian
        da, value, J = zero, still, J_m
        solution: ControlSolution | None = None
        iterations = self.options.sqp_iterations if self.enhanced is not None else 1
        for _ in range(iterations):
            if self.enhanced is not None:
                value, J = self.enhanced.linearize(state, da, J_m)
            # (f + g)(da + d) ~ value + J d  =  (value - J da) + J (da + d)
            offset = value - J @ da
            problem = self._problem(state, a, error, desired, lin, J, offset, fingertip_force)
            if self.options.uncertainty_weight > 0 and self.enhanced is not None:
                self._add_uncertainty(problem, self.enhanced, state, da)
            solution = solve_qp(problem, self.options.solver)
            best = torch.as_tensor(solution.u * _DEGREE, dtype=a.dtype)
            change = best - da
            done = float(change.abs().max()) <= self.options.sqp_tolerance
            da = best if self.enhanced is None or done else da + self.options.sqp_damping * change
            if done:
                break
        nominal = J_m @ da
        predicted = nominal if self.enhanced is None else self.enhanced.linearize(state, da, J_m)[0]
        assert solution is not None
        slack = float(np.abs(solution.slack).max()) * _DEGREE
        return Decision(
            da,
            StopReason.RUNNING,
            desired,
            predicted,
            nominal,
            limited=slack > 0.05 * float(desired.abs().max()) and self._at_limit(a, da),
            slack=slack,
            linearization=lin,
            solution=solution,
        )

    def limit(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> Float[Tensor, " n_x"]:
        """``dx_d = e min(gain, 1/|S^-1 e|, c/|v(e)|)``: keeps the direction, linear near the goal.

        Args:
            error: e, focused error.
            travel: ``|v(e)|``, how far the contact that moves most would be carried by all of it [m].
        """
        opt = self.options
        size = float(torch.linalg.vector_norm(error)) / opt.focus_step
        if opt.contact_step is not None:
            size = max(size, travel / opt.contact_step)
        return error * min(opt.focus_gain, 1.0 / size) if size > 0 else error

    def _contact_travel(self, state: GraspState, point: Float[Tensor, "n_c 3"], error: Tensor) -> float:
        """``max_i |v + w x (x_i - o)|`` of the object's twist ``(v; w) = M_c^T e`` [m]."""
        v, w = (self.focus.matrix.mT @ error).split(3)
        carried = v + torch.linalg.cross(w.expand_as(point), point - state.position)
        return float(torch.linalg.vector_norm(carried, dim=-1).max())

    def _problem(
        self,
        state: GraspState,
        a: Tensor,
        error: Tensor,
        desired: Tensor,
        lin: Any,
        J: Tensor,
        offset: Tensor,
        force: Tensor | None,
    ) -> ControlProblem:
        """Rows in scaled units: u in degrees of actuator, rotations in degrees, translations in mm."""
        opt, n_q = self.options, state.q.shape[-1]
        J_p, c_p = J[n_q:], offset[n_q:]
        E = self.focus.matrix @ J_p  # [rad/rad] = [deg/deg]
        d = (desired - self.focus.matrix @ c_p) / _DEGREE
        off = self.focus.off_matrix
        is_translation = off[:, :3].abs().sum(-1) > 0
        step = torch.where(is_translation, opt.off_step_translation, opt.off_step_rotation).to(off.dtype)
        unit = torch.where(is_translation, 1e-3, _DEGREE).to(off.dtype)
        weight = torch.where(is_translation, opt.off_translation_weight, opt.off_rotation_weight)
        wanted = (off @ error).clamp(-step, step) - off @ c_p
        least_squares = [
            (_np((off @ J_p) * _DEGREE / unit[:, None]), _np(wanted / unit), _np(weight).astype(float))
        ]
        soft: list[tuple[np.ndarray, np.ndarray]] = []
        if force is not None and opt.grip_force is not None:
            rows, want, low = self._grip(lin, force)
            least_squares.append((rows, want, np.full(len(want), opt.grip_weight)))
            soft.append((-rows, -low))
        if opt.margin_min is not None:
            # what a wrong model says is missing is not all asked for at once
            low = np.minimum(opt.margin_min - _np(lin.margins), opt.grip_step)
            soft.append((-_np(lin.margin_sensitivity) * _DEGREE, -low))
        q, J_q, c_q = _np(state.q), _np(J[:n_q]), _np(offset[:n_q])
        hand, moving = self.kinematic.hand, self._moving
        reach = np.abs(J_q).sum(1) * min(opt.actuator_step, opt.joint_horizon) + 2 * opt.joint_margin
        for sign, stop in ((1.0, hand.joint_upper), (-1.0, hand.joint_lower)):
            room = sign * (stop - q) - opt.joint_margin
            near = moving[room[moving] < reach[moving]]
            if near.size:  # rows only where a stop is within reach of this step; at the stop: go no further
                soft.append((sign * J_q[near], (np.maximum(room, 0.0) - sign * c_q)[near] / _DEGREE))
        lower = np.clip(self._a_lower - _np(a), -opt.actuator_step, opt.actuator_step) / _DEGREE
        upper = np.clip(self._a_upper - _np(a), -opt.actuator_step, opt.actuator_step) / _DEGREE
        lower[self._fixed] = upper[self._fixed] = 0.0
        W = opt.effort_weight * np.eye(len(lower))
        return ControlProblem(W, lower, upper, (_np(E), _np(d)), least_squares, soft)

    def _add_uncertainty(
        self, problem: ControlProblem, enhanced: EnhancedModel, state: GraspState, da: Tensor
    ) -> None:
        """Add ``w_sig v(da)``, ``v = tr(M_c Sigma_g M_c^T)`` in deg^2 and mm^2, about the present da."""
        translation = self.focus.matrix[:, :3].abs().sum(-1, keepdim=True) > 0
        rows = self.focus.matrix / torch.where(translation, 1e-3, _DEGREE)
        weight = torch.cat([rows.new_zeros(state.q.shape[-1]), rows.square().sum(0)])
        v = enhanced.variance(state, da, self.options.uncertainty_weight * weight)
        # v(da) + g.(u - da) + 1/2 (u - da)^T H (u - da), constants left out; u in degrees
        problem.weight = problem.weight + 0.5 * _np(v.curvature) * _DEGREE**2
        problem.linear = _np(v.gradient - v.curvature @ da) * _DEGREE

    def _grip(self, lin: Any, force: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows ``(df_n/da) u``, the wanted change and the lowest allowed change of the normal forces [N].

        The finger that presses most opposes all others: it is regulated to ``grip_force``, and the
        others to equal shares of it, so that no finger is left without a grip.
        """
        opt = self.options
        assert opt.grip_force is not None
        rows = _np(lin.normal_force_sensitivity) * _DEGREE
        measured = _np(force)[[self._pad_index[name] for name in lin.contacts.finger]]
        wanted = np.full(len(measured), opt.grip_force / max(len(measured) - 1, 1))
        wanted[int(np.argmax(measured))] = opt.grip_force
        want = np.clip(wanted - measured, -opt.grip_step, opt.grip_step)
        low = np.minimum(opt.grip_min - measured, opt.grip_step)
        return rows, want, low

    def _at_limit(self, a: Tensor, da: Tensor) -> bool:
        after, margin = _np(a + da), 0.01 * _DEGREE
        moved = np.ones(len(after), dtype=bool)
        moved[self._fixed] = False
        return bool((((after <= self._a_lower + margin) | (after >= self._a_upper - margin)) & moved).any())


def _np(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy().astype(np.float64)


def _check(name: str, value: Tensor, size: int) -> None:
    if tuple(value.shape) != (size,):
        raise ShapeError(name, f"({size},)", value.shape)
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        raise NonFiniteError(name, torch.nonzero(~finite)[:3].tolist())
