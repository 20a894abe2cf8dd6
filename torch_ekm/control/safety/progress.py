"""How far a manipulation has come, and whether it goes on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ..._checks import check_kind
from ...model import ModelStatus
from ...plant import Observation, PlantStatus
from ...typing import Tensor
from ..belief import Belief
from ..decision import Decision, StopReason
from ..focus import FocusedPose, PoseTarget
from ..pace import FIRM
from .safety import OFF_BY_SHIFTS, Objection, Safety

if TYPE_CHECKING:
    from ...model import KinematicModel

_LEAP = math.radians(4)  # of a pose beyond what was predicted, where nothing else has changed: worth a word
_AT_STOP = math.radians(0.5)  # a joint as near to the end of its range stands there
_STRAYED = 2.0  # tolerances of the error by which a turn that stalls has left its best state


class Progress:
    """Errors, motions and alarms of one manipulation, judged by :class:`~torch_ekm.control.Safety`.

    Args:
        safety: figures.
        target, focus: what is to be reached.
        seen: the first reading.
        rehearsed: on the model, from which the hand strays: the object may turn off shifts no further.
    """

    halt: Objection | None = None
    """What a guard says against going on."""
    limited = False
    """The last step was cut short by an actuator's limit."""
    leap = ""
    """The largest turn of the object that no motion explains, of those that were believed."""
    surprise = ""
    """The first reading that was believed though no motion explains it."""
    alarms = 0
    """How often a sign of a loss was heeded."""

    def __init__(
        self,
        safety: Safety,
        target: PoseTarget,
        focus: FocusedPose,
        seen: Observation,
        rehearsed: bool = False,
    ) -> None:
        check_kind(
            "target", target, PoseTarget, "a PoseTarget, e.g. PoseTarget.turned(state, axis, degrees=20)"
        )
        self.safety, self.target, self.focus = safety, target, focus
        self.belief = Belief(focus, target, seen)
        self.errors = [focus.error(target, seen.state)]
        """|e| before each motion and after the last, as a turn [rad]."""
        self.way: list[Tensor] = []
        """What the encoders did [rad], motion by motion, without what was undone."""
        self._best = self.errors[0], 0  # the smallest of them, and the motions until then
        self._start = seen.state
        self._judged: tuple[Observation, tuple[float, float]] | None = None
        more = 1.0 if focus.turns or rehearsed else OFF_BY_SHIFTS
        self._off_allowed = more * safety.caution.off_rotation
        self._bearing: set[str] | None = None  # links without a pad that bear on the object at the start

    def over(self, seen: Observation, stopped: bool) -> Objection | None:
        """Why the manipulation ends before the next decision; None: it goes on.

        Args:
            stopped: :meth:`ClosedLoop.stop` was called.
        """
        if self.halt is not None:
            return self.halt
        if seen.status is PlantStatus.LOST:
            return Objection(StopReason.OBJECT_LOST)
        if self.lost(seen):
            return Objection(StopReason.OBJECT_LOST, "dislocated off the focused axis")
        if stopped:
            return Objection(StopReason.STOPPED)
        reason = self.safety.rule.judge(self.errors, self.limited)
        if reason is StopReason.RUNNING:
            return None
        return Objection(reason, self.leap if reason is StopReason.REACHED else "")

    def lost(self, seen: Observation) -> bool:
        """The plant reports it, or the object is dislocated."""
        return seen.status is PlantStatus.LOST or self._off_rotation(seen) > self.safety.rule.off_limit

    def sign(self, seen: Observation, decision: Decision) -> str:
        """What speaks for a loss to come; empty: nothing."""
        if decision.status is not StopReason.RUNNING:
            return decision.message
        turned, bearing = self._off_rotation(seen), _bearing(decision, self.safety.caution.link_gap)
        self._bearing = bearing if self._bearing is None else self._bearing
        if turned > self._off_allowed:
            return f"the object has turned {math.degrees(turned):.1f} deg off the focus"
        return "" if bearing <= self._bearing else _bears(min(bearing - self._bearing))

    def hindrances(self, seen: Observation, decision: Decision | None, model: KinematicModel) -> str:
        """What f, linearized for the decision, sees that keeps the object from its target; empty: nothing."""
        if decision is None or decision.linearization is None:
            return ""
        lin, grip, q, hand = decision.linearization, decision.grip, seen.q.numpy(), model.hand
        found = []
        if grip is not None and float(grip.force.max()) < FIRM * grip.wanted:
            found.append(
                f"turning waits for a grip of {grip.wanted:.1f} N, and no finger bears more than "
                f"{float(grip.force.max()):.1f} N"
            )
        found += map(_bears, sorted(_bearing(decision, self.safety.caution.link_gap)))
        stands = (q <= hand.joint_lower + _AT_STOP) | (q >= hand.joint_upper - _AT_STOP)
        stands &= (hand.joint_lower < hand.joint_upper) & model.moving(lin.contacts).numpy()
        found += [f"joint '{hand.joint_names[j]}' stands at its stop" for j in stands.nonzero()[0]]
        slide = [d.what for d in lin.doubts if d.kind is ModelStatus.FRICTION_LIMIT]
        found += [f"pad '{pad}' is at its friction limit" for pad in slide]
        found += [d.message for d in lin.doubts if d.kind is ModelStatus.SENSORS_DISAGREE]
        return "; ".join(found)

    def stays_off(self, before: Observation, seen: Observation) -> bool:
        """The object has turned off the focus, and a motion back has not turned it back."""
        off = self._off_rotation(seen)
        return off > max(self._off_allowed, self._off_rotation(before))

    def add(self, after: Observation, blind: bool) -> None:
        """One more motion.

        Args:
            blind: the pose was not measured.
        """
        error = self._error(after)
        # a goal that nobody saw is not reached
        self.errors.append(max(error, 1.001 * self.safety.rule.tolerance) if blind else error)

    def leapt(self, off: float, note: str) -> None:
        """The object has turned by ``off`` [rad] more than predicted, and what a guard says of it."""
        found = f"in motion {len(self.errors) - 1} {note}"
        self.surprise = self.surprise or f"; {found}: if the object did not slide, check that sensor"
        if off > _LEAP and not self.leap:
            self.leap = (
                f"{found}: if the camera was moved, or took one marker for another, the target is off by as "
                "much"
            )

    def come(self, after: Observation, moved: Tensor) -> None:
        """One more motion that counts, of the encoders by ``moved`` [rad]; the way back is a command, too."""
        most = self.safety.guards.increment
        self.way.append(moved.clamp(-most, most))
        error = self._error(after)
        if error < self._best[0]:
            self._best = error, len(self.way)

    def strayed(self, seen: Observation, began: Observation) -> bool:
        """The object was nearer to its target by more than two tolerances, and going back may bring it there.

        Args:
            began: what was seen before the way back. An object that slid on the way does not come back by
                it: the hand stops where it is further off by as much.
        """
        least, motions = self._best
        error, allowed = self._error(seen), _STRAYED * self.safety.rule.tolerance
        strays = least + allowed < error <= self._error(began) + allowed
        return strays and len(self.way) > motions and seen.status is PlantStatus.HELD

    def _off_rotation(self, seen: Observation) -> float:
        """Of the object off the focus since the start [rad]."""
        return self._of(seen)[1]

    def _error(self, seen: Observation) -> float:
        return self._of(seen)[0]

    def _of(self, seen: Observation) -> tuple[float, float]:
        """|e| and the rotation off the focus, computed once for each reading."""
        if self._judged is None or self._judged[0] is not seen:
            off = self.focus.off_rotation(seen.state.minus(self._start))
            self._judged = seen, (self.focus.error(self.target, seen.state), off)
        return self._judged[1]


def _bearing(decision: Decision, gap: float) -> set[str]:
    """Links without a pad that are as near to the object as ``gap`` [m]."""
    doubts = () if decision.linearization is None else decision.linearization.doubts
    return {d.what for d in doubts if d.kind is ModelStatus.LINK_TOUCHES and d.value < gap}


def _bears(link: str) -> str:
    return f"link '{link}', which has no pad, bears on the object"
