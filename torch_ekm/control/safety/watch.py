"""Whether a reading may move the hand or teach: what :class:`Guards` say of each motion of a closed loop."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch

from ...kinematics import ServoModel
from ...kinematics.servo_model import IdealServos
from ...plant import Observation, PlantStatus
from ...typing import Tensor
from ..decision import Decision, Expectation, StopReason
from ..lessons import felt
from .consistency import Consistency
from .fingertips import Fingertips, FingertipWatch
from .readings import ReadingTests, agree, deg
from .safety import Guards, Objection

if TYPE_CHECKING:
    from ...model import KinematicModel

_DEG = math.pi / 180
_STILL = 0.05 * _DEG  # an encoder that moves less stands
_UNDATED = "readings have no date, so their age is not checked: give Observation.time, or stamps"
_WEAK = 0.75  # of what it should bear, that a finger lacks with which nothing is turned
_ASKED = 0.5 * _DEG  # a smaller command to a motor that was stuck before does not show whether it still is


class Verdict(NamedTuple):
    """What is believed after a motion."""

    seen: Observation
    """The reading to go on with; of a blind motion with the pose that the model predicted."""
    teaches: bool
    """Both ends of the motion were measured, and nothing speaks against them."""
    halt: Objection | None = None
    """Why the manipulation must end here."""
    note: str = ""
    """What a guard objects to where the loop goes on."""
    expected: Expectation | None = None
    """What f + g predict of what the encoders did; None: the model has no step."""
    encoders: bool = True
    """The servos may be learned from them."""


class Watch:
    """The guards of one manipulation.

    Args:
        guards: limits.
        model: f, with the hand.
        tolerance: of the target [rad]; errors that grow by more are no noise.
        servo: what is known of the servos; None: they are ideal.
    """

    def __init__(
        self,
        guards: Guards,
        model: KinematicModel,
        tolerance: float = math.inf,
        servo: ServoModel | IdealServos | None = None,
    ) -> None:
        self.guards, self.hand = guards, model.hand
        self.readings, self.fingertips = ReadingTests(guards, model.hand), FingertipWatch(guards, model)
        servo = IdealServos(model.hand.actuator_names) if servo is None else servo
        self.consistency = Consistency(self.readings, model, servo)
        self.blind = 0
        """Motions in succession without a pose."""
        self.gated = 0
        """Motions in succession that nothing but the gate objects to."""
        self.slid = ""
        """How the object has slid in the last motion, farther than the guards let a pose jump; or empty."""
        self.lie = ""
        """A sensor that went wrong while all seemed well, so that nothing is learned; or empty."""
        self._still = torch.zeros(self.hand.n_a, dtype=torch.long)
        self._tolerance, self._away = tolerance, 0
        self._undated = ""
        """That readings have no date, until it is said."""

    def first(self, seen: Observation, look: Callable[[], Observation]) -> Verdict:
        """The reading before the first motion; further ones from ``look`` where it is in doubt."""
        doubt = None
        for left in range(self.guards.looks, -1, -1):
            doubt = None if seen.status is PlantStatus.LOST else self.readings.at_rest(seen)
            if left == 0 or (doubt is None and seen.status is not PlantStatus.NOT_SEEN):
                break
            seen = look()
        self.readings.follow(None, seen)
        self.consistency.begin(seen)
        self._undated = "" if seen.dated else _UNDATED
        self.blind = int(seen.status is PlantStatus.NOT_SEEN)
        return Verdict(seen, doubt is None, doubt)

    def command(self, decision: Decision, seen: Observation) -> Objection | None:
        """Why a motion is refused before it is made; None: it is not. Its size is the gate's concern."""
        return self.fingertips.before(decision, seen)

    def motion(
        self,
        before: Observation,
        decision: Decision,
        sent: Tensor,
        after: Observation,
        expect: Callable[[Tensor], Expectation],
        look: Callable[[], Observation],
    ) -> Verdict:
        """Judge a movement of the motors by ``sent`` [rad].

        Args:
            expect: f + g of what the encoders did.
            look: gives another reading where the first is in doubt.
        """
        self.slid = ""
        seen, last, doubt, expected = self._look(before, decision, sent, after, expect, look)
        if seen.status is PlantStatus.LOST:
            return Verdict(seen, False)
        if doubt is not None and not (doubt.blind or doubt.gated):
            if doubt.reason in (StopReason.POSE_JUMP, StopReason.JOINT_JUMP):
                self.slid = self._slid(doubt.reason, before, expected, last, seen)
            if not self.slid:  # empty but for a pose or a finger that jumps
                return Verdict(seen, False, doubt, "", expected)
            doubt = doubt._replace(gated=True, message=self.slid)
        if doubt is not None and doubt.gated and (last is None or not agree(last, seen, self.guards)):
            doubt = doubt._replace(blind=True)
        tips = self.fingertips.judge(before, decision, seen)
        self.readings.follow(before, seen)
        if tips.force is not seen.fingertip_force:
            seen = dataclasses.replace(seen, fingertip_force=tips.force)
        verdict = self._verdict(before, seen, doubt, expected, tips)
        if (doubt is not None and doubt.blind) or self.slid:
            return verdict
        odd, halt = self.consistency.motion(before, sent, seen, expected)
        if odd is None:
            self.lie = self.lie or ("" if tips.true else tips.note)
            return verdict if tips.true else verdict._replace(teaches=False)
        if odd.encoders:
            self.lie = odd.message
        note = "; ".join(filter(None, (verdict.note, odd.message)))
        halt = verdict.halt or halt
        return verdict._replace(teaches=False, halt=halt, note=note, encoders=not odd.encoders)

    def _look(
        self,
        before: Observation,
        decision: Decision,
        sent: Tensor,
        seen: Observation,
        expect: Callable[[Tensor], Expectation],
        look: Callable[[], Observation],
    ) -> tuple[Observation, Observation | None, Objection | None, Expectation | None]:
        """The reading to be judged, the look before it, what speaks against it, and what was expected."""
        last, expected = None, None
        for left in range(self.guards.looks, -1, -1):
            if seen.status is PlantStatus.LOST:
                break
            if decision.pieces and (last is None or not torch.equal(seen.a, last.a)):
                expected = expect(seen.a - before.a)
            doubt = self.readings.after_motion(before, sent, seen, expected, self.blind)
            if left == 0 or (doubt is None and not self.fingertips.high(seen)):
                return seen, last, doubt, expected
            last, seen = seen, _with_events(look(), seen)
        return seen, last, None, expected

    def _verdict(
        self,
        before: Observation,
        seen: Observation,
        doubt: Objection | None,
        expected: Expectation | None,
        tips: Fingertips,
    ) -> Verdict:
        """Of a reading with which the loop goes on, unless fingertips or too many blind motions end it."""
        measured, halt = self.blind == 0, tips.halt
        if doubt is not None and doubt.blind:
            self.blind += 1
            seen, most = self._predicted(before, expected, seen), self.guards.blind_motions
            if self.blind > most:
                more = f"{doubt.message} ({self.blind} motions running, Guards.blind_motions is {most})"
                halt = halt or Objection(doubt.reason, more)
            return Verdict(seen, False, halt, doubt.message, expected)
        self.blind = 0
        if doubt is None:
            self.gated = 0
            note, self._undated = "; ".join(filter(None, (self._undated, tips.note))), ""
            return Verdict(seen, measured and halt is None, halt, note, expected)
        self.gated += 1  # what is seen again and again is the truth, and the model is wrong
        again = self.gated > self.guards.blind_motions and not self.slid
        return Verdict(seen, measured and again and halt is None, halt, doubt.message, expected)

    def _slid(
        self,
        reason: StopReason,
        before: Observation,
        expected: Expectation | None,
        last: Observation | None,
        seen: Observation,
    ) -> str:
        """What two looks show that agree is true of a pose where the grip has changed, too, and of a joint
        where the pads that press lie on the object."""
        if expected is None or last is None or not agree(last, seen, self.guards):
            return ""
        surprise = felt(self.hand, expected, before, seen)
        changed = surprise is not None and surprise.wrong(before)
        if not (self.consistency.on_surface(seen) if reason is StopReason.JOINT_JUMP else changed):
            return ""
        ds = (seen.state.minus(before.state) - expected.increment)[-6:]
        way, turn = (float(torch.linalg.vector_norm(part)) for part in ds.split(3))
        return f"the object has slid {1e3 * way:.1f} mm and {deg(turn)} farther than predicted"

    def way(self, errors: list[float], decision: Decision, moved: Tensor) -> Objection | None:
        """The object goes away from its target, again and again, while the motors obey. Where it has come
        half the way, no sign is wrong: the grasp turns no further, and the stopping rule says so."""
        da = decision.delta_a
        if min(errors) < 0.5 * errors[0]:  # a way that led there
            return None
        away = errors[-1] - errors[-2] > self._tolerance and float(moved @ da) > 0.5 * float(da @ da)
        self._away = self._away + 1 if away else 0
        if self._away < self.guards.wrong_way:
            return None
        message = (
            f"the object has gone away from its target in {self._away} motions running, while the motors did "
            "as commanded: a motor's or a joint's sign is wrong, or the pose is in another frame; see "
            "'torch-ekm check --plant'"
        )
        return Objection(StopReason.WRONG_WAY, message)

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state."""
        return self.consistency.suspects(seen)

    def weak(self, decision: Decision, seen: Observation) -> str:
        """Fingers that bear less than the object needs, as measured; empty: none."""
        grip, lin = decision.grip, decision.linearization
        if grip is None or lin is None or seen.fingertip_force is None:  # an estimate is no reason
            return ""
        rows, _ = self.hand.pad_rows(lin.contacts.finger)
        bears = zip(rows, grip.force.tolist(), grip.least.tolist(), strict=True)
        return ", ".join(
            f"finger '{lin.contacts.finger[i]}' bears {force:.1f} N of {least:.1f} N"
            for i, force, least in bears
            if force < _WEAK * least
        )

    def rest(self, before: Observation, seen: Observation) -> Observation:
        """A further reading of a hand at rest, or ``before`` where it cannot be one."""
        if seen.status is PlantStatus.LOST:
            return seen
        doubtful = seen.status is PlantStatus.NOT_SEEN or self.readings.at_rest(seen, before) is not None
        return before if doubtful else seen

    def stuck(
        self, before: Observation, decision: Decision, seen: Observation, stuck: Tensor
    ) -> Objection | None:
        """Actuators that do not move, however they are commanded.

        Args:
            stuck: which the servo model calls so.
        """
        size, still = decision.delta_a.abs(), (seen.a - before.a).abs() < _STILL
        again = still & (size > self.guards.stuck_command)
        self._still = torch.where(again, self._still + 1, 0 * self._still)
        found = (self._still > 1) | (stuck & still & (size > _ASKED))
        if not bool(found.any()):
            return None
        names = ", ".join(f"'{self.hand.actuator_names[i]}'" for i in found.nonzero().flatten().tolist())
        message = f"actuator {names} does not move however it is commanded: check motor and tendon"
        return Objection(StopReason.ACTUATOR_STUCK, message)

    @staticmethod
    def _predicted(before: Observation, expected: Expectation | None, seen: Observation) -> Observation:
        """With the pose that the model predicts for what the encoders did."""
        pose = before.state
        if expected is not None:
            pose = pose.plus(expected.increment)
        return dataclasses.replace(
            seen, position=pose.position, rotation=pose.rotation, status=PlantStatus.NOT_SEEN
        )


def _with_events(seen: Observation, earlier: Observation) -> Observation:
    """What happened before an earlier look at the same motion belongs to this one, too."""
    events = (*earlier.info.get("events", ()), *seen.info.get("events", ()))
    return dataclasses.replace(seen, info={**seen.info, "events": events}) if events else seen
