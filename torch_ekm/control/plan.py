"""A turn as one movement: its path, how sure the model is of it, and how far it is safe to go."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch

from .._noise import DEGREE
from ..estimation.knowledge import HandKnowledge
from ..exceptions import ParameterError
from ..kinematics import GraspState
from ..plant import Observation
from ..typing import Tensor
from .controller import LookAndMoveController
from .decision import Band, Decision, StopReason, Waypoint
from .focus import FocusedPose, PoseTarget
from .model_hand import ModelHand
from .rehearsal import DEVIATIONS, LONGEST, End, PathEnd, Rehearsal, is_loose, lets_go

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AHEAD = 3  # pieces that come no nearer, after which the path ends where it was nearest
_BACK = 1.5  # times off_rotation from which an object that is farther off is not turned back: it slips out
_GRIP = 3  # pieces of a movement that grips: pads that read wrong are seen after it
_CLOSE = 0.3 * DEGREE  # [rad] from which one is enough


@dataclass(frozen=True)
class Plan:
    """The path of a movement, by f + g, with contacts that stick, slide, open and close."""

    target: PoseTarget
    focus: FocusedPose
    start: GraspState
    decision: Decision
    """The movement to make: to the last safe waypoint, or why there is none."""
    waypoints: tuple[Waypoint, ...] = ()
    safe: int = 0
    """How many of the waypoints may be passed."""
    end: End = field(default_factory=End)
    """What ends the path."""
    against: str = ""
    """What is not safe beyond ``safe``; empty: nothing."""

    @property
    def states(self) -> tuple[GraspState, ...]:
        """At the start and at each waypoint."""
        return (self.start, *(one.state for one in self.waypoints))

    @property
    def errors(self) -> tuple[float, ...]:
        """Focused error there, as a turn [rad]."""
        return tuple(self.focus.error(self.target, state) for state in self.states)

    def draw(self) -> Figure:
        """Angle to go, rotation off the axis, friction and normal forces along the path, with bands of two
        standard deviations; grey where it is not safe.

        Raises:
            MissingExtraError: matplotlib is not installed (extra ``plots``).
        """
        from .plan_figure import draw  # matplotlib is needed only here

        return draw(self.errors[1:], self.focus.matrix[0], self.waypoints, self.safe)

    def __str__(self) -> str:
        errors = [error / DEGREE for error in self.errors]
        first = f"{errors[0]:.1f} deg to go; {self.safe} of {len(self.waypoints)} waypoints are safe"
        first += f", then {self.against}" if self.against else ""
        if self.end.kind is not PathEnd.NOTHING:
            first += f"; the path ends {errors[-1]:.1f} deg before the target ({self.end})"
        points = zip(errors[1:], self.waypoints, strict=True)
        return "\n".join([first, *(f"  {left:5.2f} deg to go, {one.band}" for left, one in points)])


@runtime_checkable
class Planner(Protocol):
    """What decides how a loop moves. One of your own needs no more than this method."""

    def plan(
        self,
        controller: LookAndMoveController,
        seen: Observation,
        target: PoseTarget,
        knowledge: HandKnowledge,
        firm: float,
    ) -> Plan:
        """The next movement.

        Args:
            seen: where it begins, as measured.
            firm: share of the wanted grip with which is turned; with less it is gripped first. 0: it is
                turned.
        """
        ...


@dataclass(frozen=True)
class OneStep:
    """The loop of the E-KM paper: one step of the controller after the other."""

    def plan(
        self,
        controller: LookAndMoveController,
        seen: Observation,
        target: PoseTarget,
        knowledge: HandKnowledge,
        firm: float,
    ) -> Plan:
        """See :class:`Planner`."""
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if firm and decision.grip is not None and decision.grip.weak:
            here = PoseTarget(seen.position, seen.rotation)
            grips = controller.decide(seen.state, seen.a, here, seen.fingertip_force)
            decision = dataclasses.replace(grips, turns=False)
        return Plan(target, controller.focus, seen.state, decision)


@dataclass(frozen=True)
class WholeTurn:
    """Rehearse the turn on a :class:`ModelHand`, and go as far along its path as is safe.

    A waypoint is safe where at two standard deviations (:class:`~torch_ekm.control.Bands`) the object stays
    near the axis and each finger keeps a force. The bands of a hand of which nothing is known are wide, and
    its movements small. The error that is left is no reason to stop short: the next look corrects it.

    Sources: chance constraints by propagated covariances, Hewing, Kabzan and Zeilinger, IEEE TCST 28 (2020).
    """

    piece: float = 2.5 * DEGREE
    """Largest step of the rehearsal [rad]."""
    farthest: float = 30 * DEGREE
    """Of one movement [rad]: what the model does not know at all is seen after it."""
    deviations: float = DEVIATIONS
    off_rotation: float = 8 * DEGREE
    """Off the focus [rad]; an object that is up to 1.5 times as far off may come back."""
    force: float = 0.6
    """Of a finger that touches [N]."""
    margin: float = 2 * DEGREE
    """What a first piece alone may go beyond ``off_rotation``; forces do not hold it [rad]."""

    def plan(
        self,
        controller: LookAndMoveController,
        seen: Observation,
        target: PoseTarget,
        knowledge: HandKnowledge,
        firm: float,
        whole: bool = False,
        longest: float = LONGEST,
    ) -> Plan:
        """See :class:`Planner`.

        Args:
            whole: the path goes on where it is not safe.
            longest: way of an actuator in the whole movement [rad].
        """
        focus, hand = controller.focus, None
        if firm:
            decision, hand = self._grip(controller, seen, knowledge, firm)
            if decision is not None:
                return Plan(target, focus, seen.state, decision)
        off = focus.off_rotation(target.error(seen.state))
        most = max(self.off_rotation, min(off, _BACK * self.off_rotation))
        rehearsal = Rehearsal(controller, knowledge, seen, target, self.piece, longest, hand=hand)
        spare = rehearsal.hand.margin
        waypoints: list[Waypoint] = []
        asked = focus.error(target, seen.state)
        safe, against, nearest = 0, "", (asked, 0)
        for waypoint in rehearsal.path():
            waypoints.append(waypoint)
            against = against or self._against(waypoints, most, rehearsal.hand, spare)
            if len(waypoints) == 1:
                against = against or lets_go(rehearsal.hand.hand, waypoint.piece, self.deviations)
            safe += not against
            left = focus.error(target, waypoint.state)
            nearest = min(nearest, (left, len(waypoints)))
            since = len(waypoints) - nearest[1]
            if since >= _AHEAD or (since and nearest[0] < _CLOSE):
                break
            if not whole and (against or asked - left > self.farthest):
                break
        end = End() if nearest[0] < _CLOSE else rehearsal.end
        del waypoints[nearest[1] :]
        safe = min(safe, len(waypoints))
        if safe:
            decision = _joined(controller, seen, waypoints[:safe], rehearsal)
        elif waypoints:
            wanted = focus.matrix @ target.error(seen.state)
            decision = controller.none(StopReason.GIVEN_UP, against, wanted)
        else:
            decision = self._first_order(controller, seen, target)
        return Plan(target, focus, seen.state, decision, tuple(waypoints), safe, end, against)

    def _against(self, path: Sequence[Waypoint], most: float, hand: ModelHand, spare: Tensor) -> str:
        """Why the last of some waypoints, at which the hand stands, is not safe; empty: it is. ``spare`` is
        ``mu_s f_n - |f_t|`` of each pad before the first [N]."""
        band, piece, first = path[-1].band, path[-1].piece, len(path) == 1
        off = self._off(band, most + (self.margin if first else 0.0))
        if off or first or band.force is None or band.force_std is None:
            return off
        low = (band.force - self.deviations * band.force_std).nan_to_num(nan=math.inf)
        if bool((low < self.force).any()):
            return f"a finger may keep only {float(low.min()):.1f} N"
        friction = piece.linearization.contacts.friction.mean()
        least = torch.minimum(self.deviations * friction * band.force_std, spare)
        slides = (hand.margin < least) & ~band.force.isnan()
        return "a finger may slide" if bool(slides.any()) else ""

    def _off(self, band: Band, most: float) -> str:
        off = band.off + self.deviations * band.off_std
        return f"the object may turn {off / DEGREE:.1f} deg off the axis" if off > most else ""

    def _grip(
        self, controller: LookAndMoveController, seen: Observation, knowledge: HandKnowledge, firm: float
    ) -> tuple[Decision | None, ModelHand | None]:
        """The movement that grips as the object needs it, as far as it is safe; None: it is gripped so, or
        grips no better. And the hand of the model, if it still stands where it began."""
        rehearsal = Rehearsal(controller, knowledge, seen, None, self.piece, firm=firm)
        waypoints: list[Waypoint] = []
        for waypoint in rehearsal.path():
            if len(waypoints) == _GRIP or self._off(waypoint.band, self.off_rotation):
                break
            waypoints.append(waypoint)
        if waypoints:
            return dataclasses.replace(_joined(controller, seen, waypoints, rehearsal), turns=False), None
        hand = rehearsal.hand
        if hand.failure is None:
            return None, None if hand.time else hand
        here = PoseTarget(seen.position, seen.rotation)
        decision = controller.decide(seen.state, seen.a, here, seen.fingertip_force)  # the model refuses
        loose = decision.status is StopReason.RUNNING and is_loose(decision, firm)
        return dataclasses.replace(decision, turns=False) if loose else None, None

    def _first_order(
        self, controller: LookAndMoveController, seen: Observation, target: PoseTarget
    ) -> Decision:
        """Where the model refuses the first piece: one step, if the object stays where it should be. Friction
        margins are no reason there: fingertips that read wrong use them up."""
        decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
        if decision.status is not StopReason.RUNNING:
            return decision
        least = math.inf if decision.grip is None else float(decision.grip.force.min())
        after = controller.focus.off_rotation(target.error(seen.state.plus(decision.predicted)))
        go = lets_go(controller.kinematic.hand, decision.pieces[0], self.deviations)
        if least > self.force and after <= self.off_rotation and not go:
            return decision
        off = f"the object is {after / DEGREE:.1f} deg off the axis"
        why = f"a finger keeps {least:.1f} N" if least <= self.force else go or off
        return controller.none(StopReason.GIVEN_UP, why, decision.desired)


def _joined(
    controller: LookAndMoveController, seen: Observation, waypoints: Sequence[Waypoint], rehearsal: Rehearsal
) -> Decision:
    """One movement through the waypoints."""
    pieces, predicted = tuple(one.piece for one in waypoints), waypoints[-1].state.minus(seen.state)
    first, last = rehearsal.first, rehearsal.last
    return Decision(
        torch.stack([one.action for one in pieces]).sum(0),
        StopReason.RUNNING,
        controller.focus.matrix @ predicted[-6:],
        predicted,
        torch.stack([one.linearization.described_jacobian @ one.action for one in pieces]).sum(0),
        pieces,
        limited=last is not None and last.limited,
        grip=None if first is None else first.grip,
        band=waypoints[-1].band,
    )


@dataclass(frozen=True)
class Reach:
    """How far an object can be turned about an axis, by the model."""

    angle: float
    """Largest on the way, with the sign that was asked about [rad]."""
    end: End
    """What ends it."""
    safe: float
    """To the last waypoint that is safe, see :class:`WholeTurn` [rad]."""
    plan: Plan
    """The path."""

    def __str__(self) -> str:
        return f"{self.angle / DEGREE:.1f} deg ({self.end})"


@torch.no_grad()
def reach(
    controller: LookAndMoveController, knowledge: HandKnowledge, seen: Observation, sign: int, limit: float
) -> Reach:
    """See :meth:`~torch_ekm.control.ClosedLoop.reach`."""
    if sign not in (1, -1):
        raise ParameterError("sign", sign, "1 or -1")
    if not 0 < limit <= 170 * DEGREE:
        raise ParameterError("limit", limit, "above 0 and at most 170 deg [rad]")
    if not controller.focus.is_turn:
        raise ParameterError("focus", controller.focus.matrix.tolist(), "a rotation about one axis")
    axis = controller.focus.matrix[0, 3:]
    controller.kinematic.linearize(seen.state)  # raises, and says why
    target = PoseTarget.turned(seen.state, axis, sign * limit)
    plan = WholeTurn().plan(controller, seen, target, knowledge, 0.0, whole=True, longest=math.inf)
    turned = [float(axis @ state.minus(seen.state)[-3:]) for state in plan.states]
    return Reach(sign * max(sign * angle for angle in turned), plan.end, turned[plan.safe], plan)
