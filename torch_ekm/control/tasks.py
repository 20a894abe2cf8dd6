"""What a step should do, what it must not do, and how far the chosen direction is followed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from .._checks import check_positive
from .._noise import DEGREE
from ..description import HandDescription
from ..exceptions import ParameterError, UnknownNameError
from ..kinematics.se3 import hat
from ..model import Linearization
from ..typing import Array, Float, Tensor
from .decision import Decision
from .program import Bounds, Equality, Inequality, LinearizedModel, Situation, Squares, as_array, grip_shares

_UNMEASURED = 2.0  # [N] more that is wanted where no pad measures
_OFF_ROTATION, _OFF_TRAVEL = 1.5 * DEGREE, 2.5e-3  # [rad], [m] that a step may leave the focus
_CREEP = 1.0  # [N] of margin that may be missing where friction and weight are equal
_LEAST = 0.35  # of the largest step, that only a measured grip cuts further


@runtime_checkable
class Task(Protocol):
    """What a step should do. One of your own needs no more than this method.

    One that also says how hard the finger that opposes the others is to press, ``wanted(kinematic, seen)``
    [N], takes the place of :class:`GripForceTask`.
    """

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares | Equality | None:
        """Rows in ``u = da`` [rad]; None: nothing is asked for here."""
        ...


@dataclass(frozen=True)
class FocusTask:
    """``D M_c E_p (f + g)(s, u) + sl = D dx_d``: the step meets the limited error if it can, else comes as
    near as it can (exact l1 slack). D is the ``tolerance_scale`` of the :class:`FocusedPose`."""

    penalty: float = 1e3
    """rho, per degree of a focused rotation that is left unmet."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Equality:
        focus, n_q = seen.focus, model.kinematic.n_q
        M, scale = focus.matrix, focus.tolerance_scale
        left = seen.desired - M @ model.offset[n_q:]
        A = scale[:, None] * (M @ model.jacobian[n_q:])
        return Equality(A, scale * left, self.penalty)


@dataclass(frozen=True)
class OffAxisTask:
    """The object stays where it is, and comes back, in the directions that the focus leaves free."""

    rotation_weight: float = 4.0
    """Per deg^2."""
    translation_weight: float = 0.2
    """Per mm^2; with a quarter of it an object that is turned there and back creeps farther along the grip,
    with five times as much a pad that slides holds a turn back."""
    rotation_step: float = 1.0 * DEGREE
    translation_step: float = 0.5e-3
    """How much of the error is corrected in one step: [rad], [m]."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        off, translation, n_q = seen.focus.off_matrix, seen.focus.off_translation, model.kinematic.n_q
        step = torch.where(translation, self.translation_step, self.rotation_step).to(off.dtype)
        wanted = (off @ seen.error).clamp(-step, step) - off @ model.offset[n_q:]
        weight = torch.where(translation, self.translation_weight, self.rotation_weight)
        unit = torch.where(translation, 1e-3, DEGREE).to(off.dtype)
        return Squares(off @ model.jacobian[n_q:], wanted, weight, unit)


@dataclass(frozen=True)
class GripForceTask:
    """``f_n + (df_n/da) u + d = f``: f_n as the fingertips measure it, only its sensitivity by the model,
    corrected by what was learned of it; d is what the last motions left.

    A grip force that a wrong model computes may drop the object; without fingertip sensors there is no other.

    The finger that presses most opposes all others: it is regulated to ``force``, and the others to
    equal shares of it, so that no finger is left without a grip.

    The grip follows from the object: each side bears half the weight and what turning asks for, which grows
    with the lever r of the contacts about the axis, with a ``1/safety`` of its friction::

        f = clip(safety/mu (m g/2 + turning_load r), least, most)

    Where no pad measures, 2 N more are wanted than that: estimates of single fingers are wrong by 1 N, and
    one that bears less than it seems to lets a heavy object turn off the axis.
    """

    force: float | None = None
    """[N]; None: by the object."""
    safety: float = 2.5
    turning_load: float = 95.0
    """Tangential force for each metre of the lever [N/m]."""
    least: float = 5.0
    """[N]"""
    most: float = 8.5
    """[N]; also of a grip that was tightened."""
    weight: float = 4.0
    """Per N^2."""
    step: float = 0.7
    """At most this much of an error is corrected in one step [N]."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares | None:
        f_n = seen.normal_force(model.kinematic)
        if f_n is None:
            return None
        pads = seen.pads(model.kinematic)
        grip = self.wanted(model.kinematic, seen) if seen.grip is None else seen.grip
        wanted = grip_shares(f_n[pads], grip)
        change = np.clip(wanted - f_n[pads], -self.step, self.step) - seen.drift_of(pads)
        return Squares(as_array(model.kinematic.normal_force_sensitivity)[pads], change, self.weight)

    def wanted(self, kinematic: Linearization, seen: Situation) -> float:
        """f, of the finger that opposes the others [N]."""
        if self.force is not None:
            return min(self.force + seen.tighter, max(self.force, self.most))
        contacts = kinematic.contacts
        mu, arms = max(float(contacts.friction.mean()), 1e-3), contacts.point - seen.state.position
        turning = (row for row in seen.focus.matrix if bool(row[3:].any()))
        lever = max((contact_travel(row, arms) for row in turning), default=0)
        force = self.safety / mu * (seen.weight / 2 + self.turning_load * lever)
        more = seen.tighter + (_UNMEASURED if seen.fingertip_force is None else 0.0)
        return min(max(force, self.least) + more, self.most)


@dataclass(frozen=True)
class EffortTask:
    """``w u^T u``: of the steps that do as well, the smallest. It makes the best step unique.

    Raises:
        ParameterError: w is not positive.
    """

    weight: float = 1e-2
    """w, the diagonal of the paper's W; per deg^2 of an actuator."""

    def __post_init__(self) -> None:
        check_positive("weight", self.weight)

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        n_a = len(seen.a)
        return Squares(np.eye(n_a), np.zeros(n_a), self.weight, DEGREE)


#: What a step should do by default; the figures suit the iCub hand.
DEFAULT_TASKS: tuple[Task, ...] = (EffortTask(), OffAxisTask(), GripForceTask(), FocusTask())


@runtime_checkable
class Limit(Protocol):
    """What a step must not do. One of your own needs no more than this method.

    One that also says what each pad in contact should bear, ``least(f_n, seen)`` ``(n_c,)`` [N], takes the
    place of :class:`NormalForceLimit`: a grasp that does not bear it is weak.
    """

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality | Bounds | None:
        """Rows in ``u = da`` [rad]; None: nothing is near this limit."""
        ...


@dataclass(frozen=True)
class ActuatorLimit:
    """``a_min <= a + u <= a_max, |u| <= step``; some actuators do not move at all.

    The step is a safety limit and does not say how far to go: where it cuts a motion short, the focused pose
    is served at the expense of grip and off-axis motion.
    """

    step: float = 16 * DEGREE
    """[rad]"""
    fixed: tuple[str, ...] | None = None
    """Actuators that must not move; None: those that the hand's description calls posture actuators."""

    def moves(self, hand: HandDescription) -> Array:
        """Which actuators may move.

        Raises:
            UnknownNameError: no actuator of the hand has a name in ``fixed``; the message lists them.
        """
        fixed = [one.name for one in hand.actuators if one.posture] if self.fixed is None else self.fixed
        for name in fixed:
            if name not in hand.actuator_names:
                raise UnknownNameError("actuator", name, hand.actuator_names)
        return np.array([name not in fixed for name in hand.actuator_names])

    def rows(self, model: LinearizedModel, seen: Situation) -> Bounds:
        hand, a = seen.hand, as_array(seen.a)
        ends = np.stack([hand.actuator_lower, hand.actuator_upper]) - a
        return Bounds(*np.where(self.moves(hand), np.clip(ends, -self.step, self.step), 0.0))


@dataclass(frozen=True)
class JointLimit:
    """``q_min + margin <= q + dq(u) <= q_max - margin``, dq as linearized; nearer than that: no further."""

    margin: float = 0.5 * DEGREE
    """[rad]"""
    horizon: float = 8 * DEGREE
    """A joint has a row where actuator motions of this size could bring it to a stop [rad]. Longer ones are
    rare, and every row costs time."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality:
        hand, n_q = seen.hand, model.kinematic.n_q
        q, J, c = as_array(seen.state.q), as_array(model.jacobian[:n_q]), as_array(model.offset[:n_q])
        reach = np.abs(J).sum(1) * self.horizon + 2 * self.margin
        moving = hand.joint_upper > hand.joint_lower
        C, h = [], []
        for sign, stop in ((1.0, hand.joint_upper), (-1.0, hand.joint_lower)):
            room = sign * (stop - q) - self.margin
            near = np.flatnonzero(moving & (room < reach))
            C.append(sign * J[near])
            h.append((np.maximum(room, 0.0) - sign * c)[near])
        return Inequality(np.concatenate(C), np.concatenate(h), DEGREE)


@dataclass(frozen=True)
class NormalForceLimit:
    """``least_i <= f_n + (df_n/da) u + d <= maximum`` of each finger, f_n as measured, with::

        least_i = max(minimum, share f*_i)

    f*_i is what :class:`GripForceTask` wants of a finger, which follows from load and friction: no finger
    fades.

    A finger that measures more than ``maximum`` is loosened; where no pad measures, the estimate counts. If
    only the model's estimate exceeds it, the finger is pressed no harder, and not loosened: pads may read too
    little, and springs may be others than described. Where both limits contradict each other, the upper one
    holds.

    Raises:
        ParameterError: ``maximum`` is not above ``minimum``.
    """

    minimum: float = 0.8
    """[N]"""
    share: float = 0.4
    """Of the force that is wanted of a finger."""
    step: float = 0.7
    """At most this much of what is missing, or too much, is asked for in one step [N]."""
    maximum: float = 10.0
    """[N]; the iCub's fingertips hold with 5 N, heavy objects with 8 N, and measure up to 15 N."""

    def __post_init__(self) -> None:
        if not self.maximum > self.minimum:
            raise ParameterError("maximum", self.maximum, f"above the minimum of {self.minimum:g} N")

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality | None:
        f_n, forces = seen.normal_force(model.kinematic), model.kinematic.forces
        if f_n is None:
            return None
        pads = seen.pads(model.kinematic)
        most = np.maximum(f_n, as_array(forces.normal)) if forces.solved else f_n
        most = most if seen.joint_force is None else np.maximum(most, as_array(seen.joint_force))
        f_n, most, drift = f_n[pads], most[pads], seen.drift_of(pads)
        high = np.minimum(np.maximum(self.maximum - f_n, -self.step), np.maximum(self.maximum - most, 0.0))
        low = np.minimum(np.minimum(self.least(f_n, seen) - f_n, self.step), high)
        S = as_array(model.kinematic.normal_force_sensitivity)[pads]
        return Inequality(np.concatenate([-S, S]), np.concatenate([drift - low, high - drift]))

    def least(self, f_n: Array, seen: Situation) -> Array:
        """least_i of each contact ``(n_c,)`` [N]."""
        if seen.grip is None:
            return np.full(len(f_n), self.minimum)
        return np.maximum(self.minimum, self.share * grip_shares(f_n, seen.grip))


#: What a step must not do by default: limits of actuators, normal forces and joints.
DEFAULT_LIMITS: tuple[Limit, ...] = (ActuatorLimit(), NormalForceLimit(), JointLimit())


@dataclass(frozen=True)
class LimitingFunction:
    """``dx_d = e min(gain, step/|e|, contact_travel/|v(e)|)``: keeps the direction, linear near the goal.

    v(e) is the way that the whole error would carry the contact that moves most. The limiting function of the
    E-KM paper (section III.B) is that of ``step``; the other two hold off noise and wide objects.
    """

    gain: float = 0.8
    """Share of a small focused error that one step asks for. A model that is right meets all of it,
    camera noise included; below 1 the loop averages the noise over some steps."""
    step: float = 2.5 * DEGREE
    """At most this much of the focused error is asked for [rad]; at 2.5 deg each direction's own step."""
    contact_travel: float | None = 1.2e-3
    """And no contact is asked to move farther than this [m]: a wide object turns in smaller steps.
    None: no such limit."""

    def __call__(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> Float[Tensor, " n_x"]:
        """dx_d, of a focused error e with ``travel`` = ``|v(e)|`` [m], see :func:`contact_travel`."""
        size = self.steps(error, travel)
        return error * min(self.gain, 1 / size) if size > 0 else error

    def steps(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> float:
        """How many of the largest steps make up an error."""
        size = float(torch.linalg.vector_norm(error)) / self.step
        return size if self.contact_travel is None else max(size, travel / self.contact_travel)


def contact_travel(twist: Float[Tensor, " 6"], lever: Float[Tensor, "n_c 3"]) -> float:
    """``max_i |v + w x l_i|`` of contacts at l from the object's point o [m]."""
    v, w = twist.numpy().reshape(2, 3)
    carried = v + lever.numpy() @ hat(w).T
    return math.sqrt((carried * carried).sum(-1).max())


@dataclass(frozen=True)
class StepBound:
    """``phi = min(1, 1.5 deg/|w_off|, 2.5 mm/|v_off|, (m + c)/(m - m_after)), c = 1 N mu f/W``.

    phi is the share of a step that is made. w_off and v_off are the predicted rotation and translation off
    the focus; m_after the predicted friction margins. A contact that slides holds no weight W across its way:
    the heavier the object is for its grip, the less may be missing. The bound scales a step, and does not
    turn it: the same bounds as rows of the program lose objects where friction is low.

    A step is not cut below 0.35 of the largest one: standing still turns nothing. But a grip f is tightened
    first: below 0.75 of the wanted one steps become smaller, and at 0.55 of it, where pads measure it, there
    are none.
    """

    def share(self, decision: Decision, seen: Situation, asked: float) -> float:
        """phi of a step; ``asked`` is its size in units of the largest."""
        grip = 1.0 if decision.grip is None else decision.grip.bears
        phi = max(min(self._share(decision, seen), grip), min(1.0, _LEAST / max(asked, 1e-9)))
        return phi if seen.fingertip_force is None else min(phi, grip)  # an estimate is no reason to wait

    def _share(self, decision: Decision, seen: Situation) -> float:
        lin, focus = decision.pieces[0].linearization, seen.focus
        off = (focus.off_matrix @ decision.predicted[-6:]).numpy()
        translation = focus.off_translation.numpy()
        rotation, travel = (math.sqrt(part @ part) for part in (off[~translation], off[translation]))
        phi = min(1.0, _OFF_ROTATION / max(rotation, 1e-12), _OFF_TRAVEL / max(travel, 1e-12))
        f_n = seen.normal_force(lin)
        if f_n is None or not lin.forces.solved:
            return phi
        friction = float(lin.contacts.friction.mean()) * float(f_n.max())
        spare = _CREEP * friction / max(seen.weight, 1e-3)
        before, after = lin.margins.numpy(), lin.margins_after(decision.delta_a).numpy()
        missing = after < -spare
        allowed = (before[missing] + spare) / (before[missing] - after[missing])
        return min(phi, float(np.clip(allowed, 0.0, 1.0).min(initial=1.0)))
