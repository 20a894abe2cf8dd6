"""Whether a reading is plausible, after a motion and on the way: the tests of :class:`Guards`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from .._noise import DEGREE, NOISE
from ..estimation.knowledge import HandKnowledge
from ..model import KinematicModel
from ..plant import Observation, PlantStatus
from ..typing import Array, Tensor
from .decision import Decision, Expectation, StopReason
from .guards import Effect, Guards, Objection, ReadingTests, against, agree, deg, gravest
from .lessons import felt
from .motions import FingertipTests, MotionTests
from .rehearsal import DEVIATIONS

_LOOKS = 2  # further readings of a sensor that is in doubt
_STILL = 0.05 * DEGREE  # an encoder that moves less stands
_UNDATED = "readings have no date, so their age is not checked: give Observation.time, or stamps"
_RUNNING = 2  # frames that leave the band: one may be a wrong picture
_SWINGS = math.radians(1.0)  # [rad] by which a moving object lags behind its equilibrium
_FADES = 0.5  # of the force that was planned, below which a finger is about to let go

Look = Callable[[], Observation]


class Verdict(NamedTuple):
    """The reading that is used after a motion."""

    seen: Observation
    """The reading to go on with; of a blind motion with the pose that the model predicted."""
    teaches: bool
    """Both ends of the motion were measured, and no test fails."""
    halt: Objection | None = None
    """Why the manipulation must end here."""
    note: str = ""
    """What a guard objects to where the loop goes on."""
    expected: Expectation | None = None
    """What f + g predict of what the encoders did; None: the object is lost."""


class Watch:
    """The guards of one manipulation."""

    blind = 0
    """Motions in succession without a pose."""
    gated = 0
    """Motions in succession that nothing but the gate objects to."""
    slid = ""
    """How the object has slid in the last motion, farther than the guards let a pose jump; or empty."""
    lie = ""
    """A sensor that contradicts the others, so that nothing is learned; or empty."""
    doubt = ""
    """A fingertip at fault, or on a hand of which nothing is known all of them; or empty."""

    def __init__(self, guards: Guards, model: KinematicModel, knowledge: HandKnowledge) -> None:
        self.guards, self.hand = guards, model.hand
        self.readings = ReadingTests(guards, model.hand)
        self.motions = MotionTests(self.readings, model)
        self.fingertips = FingertipTests(guards, model, knowledge.forces.usual)
        self._running: dict[tuple[StopReason, int], int] = {}  # motions in succession in which it is raised
        self._still = torch.zeros(self.hand.n_a, dtype=torch.long)
        self._undated = ""

    def first(self, seen: Observation, look: Look) -> tuple[Observation, Objection | None]:
        """The reading before the first motion, and what speaks against it; ``look`` gives another where it is
        in doubt."""
        doubt = None
        for left in range(_LOOKS, -1, -1):
            doubt = None if seen.status is PlantStatus.LOST else self.readings.at_rest(seen)
            if left == 0 or (doubt is None and seen.status is not PlantStatus.NOT_SEEN):
                break
            seen = look()
        self.readings.follow(None, seen)
        self._begun = seen
        self._undated = "" if seen.dated else _UNDATED
        self.blind = int(seen.status is PlantStatus.NOT_SEEN)
        return seen, doubt

    def motion(
        self,
        before: Observation,
        decision: Decision,
        sent: Tensor,
        after: Observation,
        expect: Callable[[Tensor], Expectation],
        look: Look,
    ) -> Verdict:
        """Judge a movement of the motors by ``sent`` [rad]; ``expect`` gives f + g of what the encoders did,
        ``look`` another reading where the first is in doubt."""
        seen, last, doubt, expected = self._look(before, sent, after, expect, look)
        self.slid = ""
        if expected is None:
            return Verdict(seen, False)
        sure = last is not None and agree(last, seen, self.guards)
        if doubt is not None and doubt.effect is Effect.STOP:
            self.slid = self._slid(doubt.reason, before, expected, seen) if sure else ""
            if not self.slid:
                return Verdict(seen, False, doubt, "", expected)
            doubt = Objection(doubt.reason, self.slid, Effect.UNLEARNED)
        force, said = self.fingertips.after(before, decision, seen)
        self.readings.follow(before, seen)
        if force is not seen.fingertip_force:
            seen = dataclasses.replace(seen, fingertip_force=force)
        if doubt is not None and (doubt.effect is Effect.BLIND or not sure):  # the model predicts the pose
            pose = before.state.plus(expected.increment)
            at = {"position": pose.position, "rotation": pose.rotation, "status": PlantStatus.NOT_SEEN}
            self.blind += 1
            return self._verdict(dataclasses.replace(seen, **at), False, doubt, expected, said)
        if not self.slid:
            said += self._in_succession(self.motions.after(before, sent, seen, expected))
        measured, self.blind, self.gated = self.blind == 0, 0, 0 if doubt is None else self.gated + 1
        # what is seen again and again is the truth, and the model is wrong
        true = doubt is None or (self.gated > self.guards.blind_motions and not self.slid)
        return self._verdict(seen, true and measured, doubt, expected, said)

    def _look(
        self,
        before: Observation,
        sent: Tensor,
        seen: Observation,
        expect: Callable[[Tensor], Expectation],
        look: Look,
    ) -> tuple[Observation, Observation | None, Objection | None, Expectation | None]:
        """The reading to be judged, the look before it, what speaks against it, and what was expected; None:
        the object is lost."""
        last, expected = None, None
        for left in range(_LOOKS, -1, -1):
            if seen.status is PlantStatus.LOST:
                break
            if expected is None or last is None or not torch.equal(seen.a, last.a):
                expected = expect(seen.a - before.a)
            doubt = self.readings.after_motion(before, sent, seen, expected, self.blind)
            if left == 0 or (doubt is None and not self.fingertips.high(seen)):
                return seen, last, doubt, expected
            last, seen = seen, _with_events(look(), seen)
        return seen, last, None, None

    def _in_succession(self, said: list[Objection]) -> list[Objection]:
        """With the end of the manipulation, where a test objects in as many motions running as it may."""
        raised = {(one.reason, one.running): one for one in said if one.running}
        self._running = {key: self._running.get(key, 0) + 1 for key in raised}
        told = {key: f"{one.message} (motions running: {self._running[key]})" for key, one in raised.items()}
        return said + [Objection(key[0], told[key]) for key, n in self._running.items() if n >= key[1]]

    def _verdict(
        self,
        seen: Observation,
        teaches: bool,
        doubt: Objection | None,
        expected: Expectation,
        said: list[Objection],
    ) -> Verdict:
        most = self.guards.blind_motions
        if doubt is not None and self.blind > most:
            more = f"{doubt.message} ({self.blind} motions running, Guards.blind_motions is {most})"
            said = [*said, Objection(doubt.reason, more)]
        goes_on = [one for one in said if one.effect is not Effect.STOP]
        lies = "; ".join(one.message for one in goes_on if one.effect is Effect.LIES)
        told = [one.message for one in goes_on if one.reason is StopReason.FINGERTIP_FAULT]
        self.lie, self.doubt = lies or self.lie, next(iter(told), self.doubt)
        notes = [self._undated, "" if doubt is None else doubt.message, *(one.message for one in goes_on)]
        self._undated = ""
        teaches = teaches and all(one.effect is Effect.TOLD for one in said)
        halt = next((one for one in said if one.effect is Effect.STOP), None)
        return Verdict(seen, teaches, halt, "; ".join(filter(None, notes)), expected)

    def _slid(self, reason: StopReason, before: Observation, expected: Expectation, seen: Observation) -> str:
        """How far the object slid, where two looks agree on a jump; empty: the jump is a fault. A jump of the
        pose is a slide where the pads' forces changed, of a joint where pads that press lie on the object."""
        came = felt(self.hand, expected, before, seen) if reason is StopReason.POSE_JUMP else None
        changed = came is not None and came.wrong
        if not (changed or (reason is StopReason.JOINT_JUMP and self.motions.on_surface(seen))):
            return ""
        ds = (seen.state.minus(before.state) - expected.increment)[-6:]
        way, turn = (float(torch.linalg.vector_norm(part)) for part in ds.split(3))
        return f"the object has slid {1e3 * way:.1f} mm and {deg(turn)} farther than predicted"

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state; nothing is learned of the
        manipulation if the joints and the object agreed at first."""
        said = self.motions.suspects(seen, self._begun)
        if said and self.motions.on_surface(self._begun):
            self.lie = said
        return said

    def rest(self, before: Observation, seen: Observation) -> Observation:
        """A further reading of a hand at rest, or ``before`` where it cannot be one."""
        if seen.status is PlantStatus.LOST:
            return seen
        doubtful = seen.status is PlantStatus.NOT_SEEN or self.readings.at_rest(seen, before) is not None
        return before if doubtful else seen

    def stuck(
        self, before: Observation, decision: Decision, seen: Observation, stuck: Tensor
    ) -> Objection | None:
        """Actuators that do not move, however they are commanded; some the servo model calls ``stuck``."""
        size, still = decision.delta_a.abs(), (seen.a - before.a).abs() < _STILL
        self._still = (self._still + 1) * (still & (size > self.guards.stuck_command))
        which = (self._still > 1) | (stuck & still & (size > NOISE.dead_zone))
        names = ", ".join(f"'{self.hand.actuator_names[i]}'" for i in which.nonzero().flatten().tolist())
        told = f"actuator {names} does not move however it is commanded: check motor and tendon"
        return gravest(against(names, StopReason.ACTUATOR_STUCK, told))


def _with_events(seen: Observation, earlier: Observation) -> Observation:
    """What happened before an earlier look at the same motion belongs to this one, too."""
    events = (*earlier.info.get("events", ()), *seen.info.get("events", ()))
    return dataclasses.replace(seen, info={**seen.info, "events": events}) if events else seen


class OnTheWay:
    """Whether a movement goes on: no finger presses too hard or fades, the object is held, and near its path.

    The object's rotation in a picture is held against that of the path where the encoders were when it was
    taken, and against the band there, which grows with the way; forces against those of the path, of which a
    finger keeps half and more.
    """

    why = ""
    """What stopped the movement; empty: nothing."""

    def __init__(self, guards: Guards, seen: Observation, decision: Decision) -> None:
        self._guards, self._seen, self._band, pieces = guards, seen, decision.band, decision.pieces
        ends = torch.stack([one.action for one in pieces]).cumsum(0)
        self._whole = ends[-1] / (ends[-1] @ ends[-1]).clamp(min=1e-12)
        self._way = np.maximum.accumulate([0.0, *(ends @ self._whole).tolist()])  # of each waypoint
        self._twists = np.cumsum([np.zeros(6), *(one.increment[-6:].numpy() for one in pieces)], axis=0)
        forces = seen.fingertip_force, *(one.force for one in pieces)
        known = [force.numpy() for force in forces if force is not None]
        self._forces = np.array(known) if len(known) == len(forces) else None
        self._times, self._encoders = [seen.taken.encoders], [seen.a.numpy()]
        self._off = 0

    def __call__(self, seen: Observation) -> bool:
        """A reading on the way; True: the movement goes on."""
        self._times.append(seen.taken.encoders)
        self._encoders.append(seen.a.numpy())
        force = None if seen.fingertip_force is None else seen.fingertip_force.numpy()
        if seen.status is PlantStatus.LOST:
            self.why = "the object is lost"
        elif force is not None and (force > self._guards.force_ceiling).any():
            self.why = f"a finger presses with {force.max():.1f} N"
        elif force is not None and self._forces is not None:
            planned = self._planned(self._forces, seen.a)
            fades = (self._forces[0] > NOISE.pressing) & (force < _FADES * planned)
            missing = np.where(fades, planned - force, 0.0)
            i = int(missing.argmax())
            if missing[i] > 3 * NOISE.force:
                self.why = f"a finger keeps {force[i]:.1f} N of {planned[i]:.1f} N"
        if not self.why and self._band is not None and seen.status is PlantStatus.HELD:
            done, twist = self._off_path(seen)
            off, band = float(twist[-3:].norm()), self._band
            std = max(band.off_std, float(band.twist_std[-3:].max()))
            self._off = self._off + 1 if off > DEVIATIONS * done * std + _SWINGS else 0
            if self._off >= _RUNNING:
                self.why = f"the object is {math.degrees(off):.1f} deg off its path"
        return not self.why

    def _off_path(self, seen: Observation) -> tuple[float, Tensor]:
        """Share of the way where the picture was taken, and the twist of the object there that the path does
        not have [m, rad]."""
        a = torch.from_numpy(_between(seen.taken.pose, self._times, np.array(self._encoders)))
        done = min(max(float((a - self._seen.a) @ self._whole), 0.0), 1.0)
        twist = seen.state.minus(self._seen.state)[-6:]
        return done, twist - torch.from_numpy(self._planned(self._twists, a))

    def _planned(self, values: Array, a: Tensor) -> Array:
        """Between those of the waypoints, where the encoders are [rad]."""
        return _between(float((a - self._seen.a) @ self._whole), self._way, values)


def _between(at: float, knots: list[float] | Array, values: Array) -> Array:
    """Linear from knot to knot, and the nearest value beyond them."""
    return np.array([np.interp(at, knots, column) for column in values.T])
