"""How far a manipulation has come, and why it ends."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .._checks import check_kind
from ..model import ModelStatus
from ..plant import Observation, PlantStatus
from .decision import Decision, StopReason
from .focus import A_TARGET, FocusedPose, PoseTarget
from .limiting import FIRM
from .safety.safety import Objection, StoppingRule

if TYPE_CHECKING:
    from ..model import KinematicModel

_LEAP = math.radians(4)  # of a pose beyond what was predicted, where nothing else has changed: worth a word
_AT_STOP = math.radians(0.5)  # a joint as near to the end of its range stands there
_BEARS = 0.2e-3  # [m] a link as near to the object as this bears on it


class Ends:
    """Errors of one manipulation, judged by a :class:`~torch_ekm.control.StoppingRule`.

    Args:
        rule: figures.
        target, focus: what is to be reached.
        seen: the first reading.
    """

    limited = False
    """The last movement was cut short by an actuator's limit."""
    leap = ""
    """The largest turn of the object that no motion explains, of those that were believed."""
    surprise = ""
    """The first reading that was believed though no motion explains it."""

    def __init__(self, rule: StoppingRule, target: PoseTarget, focus: FocusedPose, seen: Observation) -> None:
        check_kind("target", target, PoseTarget, A_TARGET)
        self.rule, self.target, self.focus, self._start = rule, target, focus, seen.state
        self.errors = [self.error(seen)]
        """|e| before each movement and after the last, as a turn [rad]."""

    def error(self, seen: Observation) -> float:
        """|e| as a turn [rad]."""
        return self.focus.error(self.target, seen.state)

    def over(self, seen: Observation, looks: int) -> Objection | None:
        """Why the manipulation ends before the next movement; None: it goes on.

        Args:
            looks: readings at rest of which ``seen`` is the mean.
        """
        if seen.status is PlantStatus.LOST:
            return Objection(StopReason.OBJECT_LOST)
        if self.focus.off_rotation(seen.state.minus(self._start)) > self.rule.off_limit:
            return Objection(StopReason.OBJECT_LOST, "dislocated off the focused axis")
        if (
            looks >= self.rule.looks
            and seen.status is PlantStatus.HELD
            and self.error(seen) <= self.rule.tolerance
        ):
            return Objection(StopReason.REACHED, self.leap)
        reason = self.rule.judge(self.errors, self.limited)
        return None if reason is StopReason.RUNNING else Objection(reason)

    def add(self, after: Observation, limited: bool) -> None:
        """One more movement that turns."""
        self.errors.append(self.error(after))
        self.limited = limited

    def leapt(self, off: float, note: str) -> None:
        """The object has turned by ``off`` [rad] more than predicted, and what a guard says of it."""
        found = f"in motion {len(self.errors) - 1} {note}"
        self.surprise = self.surprise or f"; {found}: if the object did not slide, check that sensor"
        if off > _LEAP and not self.leap:
            self.leap = (
                f"{found}: if the camera was moved, or took one marker for another, the target is off by as "
                "much"
            )


def hindrances(seen: Observation, decision: Decision | None, model: KinematicModel) -> str:
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
    bearing = {d.what for d in lin.doubts if d.kind is ModelStatus.LINK_TOUCHES and d.value < _BEARS}
    found += [f"link '{link}', which has no pad, bears on the object" for link in sorted(bearing)]
    stands = (q <= hand.joint_lower + _AT_STOP) | (q >= hand.joint_upper - _AT_STOP)
    stands &= (hand.joint_lower < hand.joint_upper) & model.moving(lin.contacts).numpy()
    found += [f"joint '{hand.joint_names[j]}' stands at its stop" for j in stands.nonzero()[0]]
    slide = [d.what for d in lin.doubts if d.kind is ModelStatus.FRICTION_LIMIT]
    found += [f"pad '{pad}' is at its friction limit" for pad in slide]
    found += [d.message for d in lin.doubts if d.kind is ModelStatus.SENSORS_DISAGREE]
    return "; ".join(found)
