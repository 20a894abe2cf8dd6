"""Whether a reading may move the hand or teach: what :class:`Guards` say of each motion of a closed loop."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..._noise import DEGREE, NOISE
from ...plant import Observation, PlantStatus
from ...typing import Tensor
from ..decision import Decision, Expectation, StopReason
from ..lessons import felt
from .guards import TABLE, Effect, Guards, Objection, check, deg, ended, gravest
from .motions import MotionTests
from .readings import ReadingTests, agree

if TYPE_CHECKING:
    from ...model import KinematicModel
    from ..knowledge import HandKnowledge

_STILL = 0.05 * DEGREE  # an encoder that moves less stands
_UNDATED = "readings have no date, so their age is not checked: give Observation.time, or stamps"


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
        knowledge: of the hand.
    """

    def __init__(
        self,
        guards: Guards,
        model: KinematicModel,
        tolerance: float,
        knowledge: HandKnowledge,
    ) -> None:
        self.guards, self.hand = guards, model.hand
        self.readings = ReadingTests(guards, model.hand)
        self.motions = MotionTests(self.readings, model, knowledge)
        self.blind = 0
        """Motions in succession without a pose."""
        self.gated = 0
        """Motions in succession that nothing but the gate objects to."""
        self.slid = ""
        """How the object has slid in the last motion, farther than the guards let a pose jump; or empty."""
        self.lie = ""
        """A sensor that went wrong while all seemed well, so that nothing is learned; or empty."""
        self.doubt = ""
        """That fingertips and springs contradict each other on a hand of which nothing is known; or empty."""
        self._objected: Counter[str] = Counter()
        """Motions in succession in which a test of the table objects."""
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
        self.motions.begin(seen)
        self._undated = "" if seen.dated else _UNDATED
        self.blind = int(seen.status is PlantStatus.NOT_SEEN)
        return Verdict(seen, doubt is None, doubt)

    def command(self, decision: Decision, seen: Observation, first: bool) -> Objection | None:
        """Why a motion, or the first that turns, is refused before it is made; None: it is not. Its size is
        the gate's concern."""
        return gravest(self.motions.before(decision, seen, first))

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
        seen, last, doubt, expected = self._look(before, decision, sent, after, expect, look)
        self.slid = ""
        if seen.status is PlantStatus.LOST:
            return Verdict(seen, False)
        sure = last is not None and agree(last, seen, self.guards)
        if doubt is not None and doubt.effect is Effect.STOP:
            self.slid = self._slid(doubt.reason, before, expected, seen) if sure else ""
            if not self.slid:
                return Verdict(seen, False, doubt, "", expected)
            doubt = Objection(doubt.reason, self.slid, Effect.UNLEARNED)
        force, said = self.motions.fingertips(before, decision, seen)
        self.readings.follow(before, seen)
        if force is not seen.fingertip_force:
            seen = dataclasses.replace(seen, fingertip_force=force)
        if doubt is not None and (doubt.effect is Effect.BLIND or not sure):
            return self._blind(before, seen, doubt, expected, said)
        if not self.slid:
            said += self._running(self.motions.motion(before, sent, seen, expected))
        return self._seen(seen, doubt, expected, said)

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
            if left == 0 or (doubt is None and not self.motions.high(seen)):
                return seen, last, doubt, expected
            last, seen = seen, _with_events(look(), seen)
        return seen, last, None, expected

    def _running(self, said: list[Objection]) -> list[Objection]:
        """With the end of the manipulation, where a test objects in as many motions running as it may."""
        for name, test in TABLE.items():
            found = next((one for one in said if one.test == name), None)
            n = self._objected[name] = 0 if found is None else self._objected[name] + 1
            if found is not None and 0 < test.running <= n:
                said.append(Objection(found.reason, f"{found.message} (motions running: {n})"))
        return said

    def _blind(
        self,
        before: Observation,
        seen: Observation,
        doubt: Objection,
        expected: Expectation | None,
        said: list[Objection],
    ) -> Verdict:
        """The pose that the model predicts for what the encoders did, for some motions."""
        pose, most = before.state, self.guards.blind_motions
        if expected is not None:
            pose = pose.plus(expected.increment)
        status = PlantStatus.NOT_SEEN
        seen = dataclasses.replace(seen, position=pose.position, rotation=pose.rotation, status=status)
        self.blind += 1
        halt = ended(said)
        if halt is None and self.blind > most:
            more = f"{doubt.message} ({self.blind} motions running, Guards.blind_motions is {most})"
            halt = Objection(doubt.reason, more)
        return Verdict(seen, False, halt, doubt.message, expected)

    def _seen(
        self,
        seen: Observation,
        doubt: Objection | None,
        expected: Expectation | None,
        said: list[Objection],
    ) -> Verdict:
        """Of a reading with its pose."""
        measured, halt = self.blind == 0, ended(said)
        self.blind, self.gated = 0, 0 if doubt is None else self.gated + 1
        # what is seen again and again is the truth, and the model is wrong
        true = doubt is None or (self.gated > self.guards.blind_motions and not self.slid)
        teaches = true and measured and all(one.effect is Effect.TOLD for one in said)
        lies = (one.message for one in said if one.effect is Effect.LIES)
        self.lie = "; ".join(lies) or self.lie
        self.doubt = next((one.message for one in said if one.test == "first scale"), self.doubt)
        notes = [self._undated, "" if doubt is None else doubt.message]
        notes += [one.message for one in said if one.effect is not Effect.STOP]
        self._undated = ""
        encoders = all(one.reason is not StopReason.ENCODER_DRIFT for one in said)
        return Verdict(seen, teaches, halt, "; ".join(filter(None, notes)), expected, encoders)

    def _slid(
        self, reason: StopReason, before: Observation, expected: Expectation | None, seen: Observation
    ) -> str:
        """What two looks show that agree is true of a pose where the grip has changed, too, and of a joint
        where the pads that press lie on the object; empty: it is not."""
        true = False
        if expected is not None and reason is StopReason.JOINT_JUMP:
            true = self.motions.on_surface(seen)
        elif expected is not None and reason is StopReason.POSE_JUMP:
            surprise = felt(self.hand, expected, before, seen)
            true = surprise is not None and surprise.wrong(before)
        if expected is None or not true:
            return ""
        ds = (seen.state.minus(before.state) - expected.increment)[-6:]
        way, turn = (float(torch.linalg.vector_norm(part)) for part in ds.split(3))
        return f"the object has slid {1e3 * way:.1f} mm and {deg(turn)} farther than predicted"

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state; nothing is learned of the
        manipulation if the joints and the object agreed at first."""
        said = self.motions.suspects(seen)
        if said and self.motions.agreed:
            self.lie = said
        return said

    def way(self, errors: list[float], decision: Decision, moved: Tensor) -> Objection | None:
        """The object goes away from its target, again and again, while the motors obey. Where it has come
        half the way, no sign is wrong: the grasp turns no further, and the stopping rule says so."""
        da = decision.delta_a
        if min(errors) < 0.5 * errors[0]:  # a way that led there
            return None
        away = errors[-1] - errors[-2] > self._tolerance and float(moved @ da) > 0.5 * float(da @ da)
        self._away = self._away + 1 if away else 0
        return gravest(check("away", self._away, self.guards.wrong_way - 1))

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
        self._still = (self._still + 1) * (still & (size > self.guards.stuck_command))
        which = (self._still > 1) | (stuck & still & (size > NOISE.dead_zone))
        names = ", ".join(f"'{self.hand.actuator_names[i]}'" for i in which.nonzero().flatten().tolist())
        return gravest(check("stuck", len(names), 0, names=names))


def _with_events(seen: Observation, earlier: Observation) -> Observation:
    """What happened before an earlier look at the same motion belongs to this one, too."""
    events = (*earlier.info.get("events", ()), *seen.info.get("events", ()))
    return dataclasses.replace(seen, info={**seen.info, "events": events}) if events else seen
