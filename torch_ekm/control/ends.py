"""How far a manipulation has come, and why it ends."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .._checks import check_kind
from .._noise import DEGREE, NOISE
from ..exceptions import CommandRefusedError, ParameterError
from ..model import ModelStatus
from ..plant import Observation, PlantStatus
from .decision import Decision, StopReason
from .focus import A_TARGET, PoseTarget
from .limiting import FIRM
from .manipulation import Stop
from .reach import out_of_reach
from .safety.guards import Guards, Objection

if TYPE_CHECKING:
    from ..model import KinematicModel
    from .controller import LookAndMoveController

_LEAP = math.radians(4)  # of a pose beyond what was predicted, where nothing else has changed: worth a word
_AT_STOP = math.radians(0.5)  # a joint as near to the end of its range stands there


@dataclass(frozen=True)
class StoppingRule:
    """Explicit parameters of the stopping rule; the same for every controller that is compared.

    * reached: ``|e| <= tolerance``, e by the mean of ``looks`` to ``most_looks`` readings at rest: further
      ones are taken while the mean is nearer to the tolerance than it is sure;
    * stalled: within the last ``stall_window`` steps the smallest ``|e|`` fell by less than
      ``stall_progress``;
    * actuator limits: as stalled, while some actuator that matters stood at its limit;
    * step limit: ``max_steps`` commands were given;
    * object lost: the plant says so, or the object turned off the focus by more than
      ``off_limit`` [rad]: it is dislocated, and no small step brings it back.
    """

    tolerance: float = 0.25 * DEGREE
    """[rad], see :class:`~torch_ekm.control.FocusedPose`; at 0.25 deg each direction has its own."""
    looks: int = 2
    most_looks: int = 4
    stall_window: int = 12
    stall_progress: float = 0.1 * DEGREE
    """[rad], likewise"""
    max_steps: int = 60
    off_limit: float = 30 * DEGREE

    def __post_init__(self) -> None:
        for name in ("tolerance", "looks", "most_looks", "stall_window", "max_steps", "off_limit"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")

    def judge(self, errors: list[float], limited: bool = False) -> StopReason:
        """Judge the history of ``|e|``, one entry for each observation, the newest last.

        Args:
            limited: the last step was cut short by an actuator's limit.
        """
        if len(errors) > self.stall_window:
            before, after = min(errors[: -self.stall_window]), min(errors[-self.stall_window :])
            if before - after < self.stall_progress:
                return StopReason.ACTUATOR_LIMITS if limited else StopReason.STALLED
        if len(errors) > self.max_steps:
            return StopReason.STEP_LIMIT
        return StopReason.RUNNING


@dataclass(frozen=True)
class Safety:
    """Which readings count, and when the hand stops; the same for every controller that is compared."""

    rule: StoppingRule = StoppingRule()
    """Reached, stalled, step limit, actuator limits, object lost."""
    guards: Guards = field(default_factory=Guards)
    """Stale sensor, and all reasons that follow it in :class:`StopReason`."""


class Ends:
    """Errors of one manipulation, judged by a :class:`~torch_ekm.control.StoppingRule`.

    Args:
        rule: figures.
        target: what is to be reached.
        controller: its focus and model.
        seen: the first reading.
    """

    limited = False
    """The last movement was cut short by an actuator's limit."""
    leap = ""
    """The largest turn of the object that no motion explains, of those that were believed."""
    surprise = ""
    """The first reading that was believed though no motion explains it."""

    def __init__(
        self, rule: StoppingRule, target: PoseTarget, controller: LookAndMoveController, seen: Observation
    ) -> None:
        check_kind("target", target, PoseTarget, A_TARGET)
        self.rule, self.target, self._controller, self._start = rule, target, controller, seen.state
        self.errors = [self.error(seen)]
        """|e| before each movement and after the last, as a turn [rad]."""

    def error(self, seen: Observation) -> float:
        """|e| as a turn [rad]."""
        return self._controller.focus.error(self.target, seen.state)

    def over(
        self, seen: Observation, looks: int, last: Decision | None, stopped: bool, decline: bool
    ) -> Objection | None:
        """Why the manipulation ends before the next movement; None: it goes on.

        Args:
            looks: readings at rest of which ``seen`` is the mean.
            last: the decision on the last movement; None: nothing has moved.
            stopped: somebody has asked for the end.
            decline: a target out of reach ends it before anything moves.
        """
        if seen.status is PlantStatus.LOST:
            return Objection(StopReason.OBJECT_LOST)
        if self._controller.focus.off_rotation(seen.state.minus(self._start)) > self.rule.off_limit:
            return Objection(StopReason.OBJECT_LOST, "dislocated off the focused axis")
        held = seen.status is PlantStatus.HELD
        if looks >= self.rule.looks and held and self.error(seen) <= self.rule.tolerance:
            return Objection(StopReason.REACHED, self.leap)
        reason, why = self.rule.judge(self.errors, self.limited), ""
        if reason is StopReason.STALLED:
            why = _hindrances(seen, last, self._controller.kinematic)
        elif reason is StopReason.RUNNING and stopped:
            reason = StopReason.STOPPED
        elif reason is StopReason.RUNNING and decline and last is None and held:
            why = out_of_reach(self._controller, seen, self.target)
            reason = StopReason.OUT_OF_REACH if why else reason
        return None if reason is StopReason.RUNNING else Objection(reason, why)

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


def failed(error: BaseException, final: Observation) -> Stop:
    """By what the plant raised, or the gate before it, or Ctrl-C."""
    if isinstance(error, KeyboardInterrupt):
        return Stop(StopReason.STOPPED, final, "Ctrl-C", error)
    refused = isinstance(error, CommandRefusedError)
    reason = StopReason.COMMAND_REFUSED if refused else StopReason.PLANT_FAILED
    return Stop(reason, final, f"{type(error).__name__}: {error}", error)


def _hindrances(seen: Observation, decision: Decision | None, model: KinematicModel) -> str:
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
    bearing = {d.what for d in lin.doubts if d.kind is ModelStatus.LINK_TOUCHES and d.value < 2 * NOISE.gap}
    found += [f"link '{link}', which has no pad, bears on the object" for link in sorted(bearing)]
    stands = (q <= hand.joint_lower + _AT_STOP) | (q >= hand.joint_upper - _AT_STOP)
    stands &= (hand.joint_lower < hand.joint_upper) & model.moving(lin.contacts).numpy()
    found += [f"joint '{hand.joint_names[j]}' stands at its stop" for j in stands.nonzero()[0]]
    slide = [d.what for d in lin.doubts if d.kind is ModelStatus.FRICTION_LIMIT]
    found += [f"pad '{pad}' is at its friction limit" for pad in slide]
    found += [d.message for d in lin.doubts if d.kind is ModelStatus.SENSORS_DISAGREE]
    return "; ".join(found)
