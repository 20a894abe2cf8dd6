"""What a grasp can reach, how far it can be turned, and what ends it, before anything moves."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum

import numpy as np
import torch

from .._checks import check_kind
from ..exceptions import GraspError, ParameterError, SolverError
from ..kinematics import GraspState
from ..model import Linearization
from ..plant import Observation, Plant
from ..typing import Float, Tensor
from .controller import LookAndMoveController
from .decision import StopReason
from .focus import A_TARGET, FocusedPose, PoseTarget
from .limits import ActuatorLimit
from .manipulation import Step, Stop
from .model_hand import ModelHand
from .qp import as_array, build_qp
from .safety.safety import OFF_BY_SHIFTS, Caution
from .situation import LinearizedModel, Situation
from .tasks import EffortTask, FocusTask, OffAxisTask

_DEG = math.pi / 180
_BEARS = 0.01  # [N m] of a stop that ends a turn
_ASKED = 25 * _DEG  # [rad] the model is asked about turns as far as this
_BEYOND = 5 * _DEG  # [rad] beyond the predicted reach a target is declined; two of three ends are as near
_WEAK = 0.035  # of the largest gain: a direction that motors do not hold; those that they hold have .07
_FAR = 10 * _DEG  # [rad], as steps count, from which a target of other directions is tried on the model
_SHORT = 1 * _DEG  # [rad] before it, as tolerances count, that end it; those that are reached end .5 off
_LEFT = 0.2  # of an error that the motors leave at the ends of their ranges, to decline it


class ReachEnd(Enum):
    """What ends a turn of the object, as the model predicts it."""

    NOTHING = "nothing"
    """It goes on beyond the angle that was asked about."""
    LINK = "link"
    """A link without a pad comes to bear on the object."""
    FRICTION = "friction"
    """A finger's friction margin is used up: it slides, or no forces balance the object any more."""
    JOINT_STOP = "joint stop"
    ACTUATOR = "actuator"
    STABILITY = "stability"
    """The grasp buckles."""
    CONTACT = "contact lost"


@dataclass(frozen=True)
class Reach:
    """How far an object can be turned about an axis, by the model."""

    angle: float
    """Largest on the way, with the sign that was asked about [rad]."""
    end: ReachEnd
    what: tuple[str, ...]
    """Names of the links, pads, joints or actuators that end it; the likeliest first."""
    message: str
    """The same in a sentence."""
    path: tuple[GraspState, ...]
    """Before the first motion and after each, up to the largest angle."""
    angles: tuple[float, ...]
    """Turned at each state of the path [rad]."""
    safe: float
    """Turned where nothing speaks for a loss yet, neither there nor after the next motion [rad]."""

    @property
    def ends_by(self) -> str:
        """End and names in a few words."""
        return f"{self.end.value}: {', '.join(self.what)}" if self.what else self.end.value

    def __str__(self) -> str:
        return f"{self.angle / _DEG:.1f} deg ({self.ends_by})"


Rehearsal = Callable[[Plant, PoseTarget], Generator[Step, None, Stop]]
"""Motions of a loop on a hand that is not the plant; nothing that they do changes the loop."""


@torch.no_grad()
def follow_to_the_end(
    rehearsal: Rehearsal, controller: LookAndMoveController, seen: Observation, sign: int, limit: float
) -> Reach:
    """See :meth:`~torch_ekm.control.ClosedLoop.reach`."""
    if sign not in (1, -1):
        raise ParameterError("sign", sign, "1 or -1")
    if not 0 < limit <= 170 * _DEG:
        raise ParameterError("limit", limit, "above 0 and at most 170 deg [rad]")
    about, hand = _axis_of(controller.focus), _model_hand(controller, seen)
    if hand.linearization is None:
        controller.kinematic.linearize(seen.state)  # raises, and says why
    start = hand.observe()
    idle = set(hand.at_limits())
    path, angles, calm = [start.state], [0.0], None  # states before the first sign of a loss
    farthest = copy.copy(hand)
    motions = rehearsal(hand, PoseTarget.turned(start.state, about, sign * limit))
    while True:
        try:
            step = next(motions)
        except StopIteration as over:
            stop: Stop = over.value
            break
        if step.retreat and calm is None:
            calm = len(angles)
        turned = float(about @ step.after.state.minus(start.state)[-3:])
        if not hand.failure and sign * turned > sign * angles[-1]:
            path.append(step.after.state)
            angles.append(turned)
            farthest = copy.copy(hand)
    motions.close()
    limits = [name for name in farthest.at_limits() if name not in idle]
    sliding = _sliding(farthest.linearization)
    end, what, message = _end(stop, hand, limits, farthest.at_stops(_BEARS), sliding)
    until = angles[:calm]
    if calm is not None or end is not ReachEnd.NOTHING:  # the last of them leads to the sign
        until = until[:-1] or until
    return Reach(angles[-1], end, what, message, tuple(path), tuple(angles), until[-1])


@dataclass(frozen=True)
class Reachability:
    """``M_c D E_p J_m = U diag(gains) V^T``: what J_m says of a target; D counts 0.8 mm as 1 deg."""

    gains: Float[Tensor, " n_x"]
    """Turn of the object for a turn of the motors, the largest first: they give rank and conditioning."""
    reason: str = ""
    """Why the target is not reachable; empty: it is."""


@torch.no_grad()
def reachability(
    controller: LookAndMoveController, caution: Caution, seen: Observation, target: PoseTarget
) -> Reachability:
    """See :meth:`~torch_ekm.control.ClosedLoop.reachability`."""
    focus, error = controller.focus, check_kind("target", target, PoseTarget, A_TARGET).error(seen.state)
    lin = controller.kinematic.linearize(seen.state, fingertip_force=seen.fingertip_force)
    model, asked = LinearizedModel.about(torch.zeros_like(seen.a), lin), focus.matrix @ error
    whole = Situation(controller.kinematic.hand, focus, seen.state, seen.a, None, error, asked)
    limits = (limit for limit in controller.limits if isinstance(limit, ActuatorLimit))
    within = dataclasses.replace(next(limits, ActuatorLimit()), step=math.inf).rows(model, whole)
    moves = torch.from_numpy(as_array(within.lower) < as_array(within.upper))
    scaled = asked.new_tensor([[1250 * _DEG]] * 3 + [[1.0]] * 3) * lin.object_jacobian[:, moves]
    U, found, _ = torch.linalg.svd(focus.matrix @ scaled)
    gains = torch.cat([found, found.new_zeros(len(asked) - len(found))])
    least = _WEAK * torch.linalg.matrix_norm(scaled, 2)
    if gains[-1] < least:
        parts = sorted(zip(U[:, -1].abs().tolist(), map(str, focus.directions), strict=True), reverse=True)
        weak = " with ".join(name for share, name in parts if share > 0.3)
        held = f"{int((gains >= least).sum())} of the {len(gains)} directions of the focus"
        return Reachability(gains, f"the motors hold {held}, and too little of {weak}: leave a direction out")
    if _is_turn(focus):  # followed step by step where it is long
        return Reachability(gains)
    tasks = (task.rows(model, whole) for task in (EffortTask(), OffAxisTask(), FocusTask()))
    solution, reason = build_qp(len(seen.a), [*tasks, within]).solve(), ""
    left = float(np.abs(solution.slack).max()) / max(focus.error(target, seen.state), 1e-9)
    off = focus.off_rotation(lin.object_jacobian @ torch.from_numpy(solution.u))
    if left > _LEFT:
        reason = (
            f"motors at the ends of their ranges leave {100 * left:.0f} % of the way; choose a nearer target"
        )
    elif off > OFF_BY_SHIFTS * caution.off_rotation:
        reason = f"the object turns {off / _DEG:.0f} deg off the focus on the way; choose a nearer target"
    return Reachability(gains, reason)


def out_of_reach(
    rehearsal: Rehearsal | None,
    controller: LookAndMoveController,
    caution: Caution,
    seen: Observation,
    target: PoseTarget,
) -> str:
    """Why a target is declined; empty: it is not. Far ones are tried where there is a rehearsal."""
    focus, error = controller.focus, target.error(seen.state)
    try:
        against = reachability(controller, caution, seen, target).reason
        if against or rehearsal is None:
            return against
        if not _is_turn(focus):
            if torch.linalg.vector_norm(focus.step_scale * (focus.matrix @ error)) < _FAR:
                return ""
            hand = _model_hand(controller, seen)
            list(rehearsal(hand, target))  # leaves the hand where the motions end
            left, asked = focus.error(target, hand.state), focus.error(target, seen.state)
            short = f"the model leaves {left / asked:.0%} of the way: {hand.failure or 'it comes no nearer'}"
            return short if left > _SHORT else ""
        about = _axis_of(focus)
        asked = float(about @ error[3:])
        if abs(asked) < _ASKED:
            return ""
        sign = 1 if asked >= 0 else -1
        reach = follow_to_the_end(rehearsal, controller, seen, sign, min(abs(asked), 170 * _DEG))
    except (ParameterError, GraspError, SolverError):  # the loop will say so itself
        return ""
    if reach.end is ReachEnd.NOTHING or abs(asked) <= abs(reach.angle) + _BEYOND:
        return ""
    return (
        f"{asked / _DEG:.1f} deg are out of reach: this grasp turns {reach}; up to "
        f"{reach.safe / _DEG:.1f} deg it is safe. Choose a nearer target, or another grasp"
    )


def _sliding(lin: Linearization | None) -> list[str]:
    """Pads in the order of their margins, those that have none to spare."""
    if lin is None or not lin.forces.solved:
        return []
    left = sorted(zip(lin.forces.relative_margin.tolist(), lin.contacts.finger, strict=True))
    return [pad for share, pad in left if share < 0.05]


def _axis_of(focus: FocusedPose) -> Float[Tensor, " 3"]:
    """Of a focus that is the rotation about it.

    Raises:
        ParameterError: the focus is something else.
    """
    if not _is_turn(focus):
        raise ParameterError("focus", focus.matrix.tolist(), "a rotation about one axis")
    return focus.matrix[0, 3:]


def _is_turn(focus: FocusedPose) -> bool:
    return [one.unit for one in focus.directions] == ["deg"]


def _model_hand(controller: LookAndMoveController, seen: Observation) -> ModelHand:
    model = controller.kinematic if controller.enhanced is None else controller.enhanced
    return ModelHand(model, seen.state, seen.a, seen.fingertip_force, controller.forces)


def _end(
    stop: Stop, hand: ModelHand, limits: list[str], stops: list[str], sliding: list[str]
) -> tuple[ReachEnd, tuple[str, ...], str]:
    """Kind, names and sentence, by what stood at its limit at the largest angle."""
    said = hand.failure or stop.message
    if stop.reason is StopReason.REACHED:
        return ReachEnd.NOTHING, (), "nothing ends it within the limit"
    names = [link for link in hand.hand.link_names if f"link '{link}'" in said]
    if names:
        return ReachEnd.LINK, tuple(names), said
    if "buckles" in said:
        return ReachEnd.STABILITY, (), said
    if "no finger touches" in said:
        return ReachEnd.CONTACT, (), said
    if hand.failure or "of the friction" in said:
        return ReachEnd.FRICTION, tuple(sliding), said
    for end, found, verb in (
        (ReachEnd.ACTUATOR, limits, "stands at the end of its range"),
        (ReachEnd.JOINT_STOP, stops, "stands at its stop"),
        (ReachEnd.FRICTION, sliding, "slides"),
    ):
        if found:
            return end, tuple(found), f"{found[0]} {verb}" + (f"; {said}" if said else "")
    return ReachEnd.FRICTION, (), said or stop.reason.value
