"""When a controller stops, and why."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from ..exceptions import ParameterError


class StopReason(Enum):
    """Why a manipulation ended; ``RUNNING`` while it has not."""

    RUNNING = "running"
    REACHED = "reached"
    STALLED = "stalled"
    STEP_LIMIT = "step limit"
    ACTUATOR_LIMITS = "actuator limits"
    UNSTABLE_GRASP = "unstable grasp"
    GIVEN_UP = "given up"
    """With the object in the hand, see :class:`~torch_ekm.control.Caution`."""
    OUT_OF_REACH = "out of reach"
    """Declined before anything moved, see ``decline`` of :class:`~torch_ekm.control.ClosedLoop`."""
    OBJECT_LOST = "object lost"
    TIME_OUT = "time-out"
    STOPPED = "stopped"
    """By :meth:`ClosedLoop.stop`."""
    STALE_SENSOR = "stale sensor"
    """This and what follows: see :class:`~torch_ekm.control.Guards`."""
    BLIND = "object not seen"
    ENCODER_JUMP = "encoder jump"
    JOINT_JUMP = "joint jump"
    POSE_JUMP = "pose jump"
    OUT_OF_RANGE = "reading out of range"
    FINGERTIP_FAULT = "fingertip fault"
    ACTUATOR_STUCK = "actuator stuck"
    COMMAND_CEILING = "command ceiling"
    SPEED_CEILING = "speed ceiling"
    FORCE_CEILING = "force ceiling"


@dataclass(frozen=True)
class StoppingRule:
    """Explicit parameters of the stopping rule; the same for every controller that is compared.

    * reached: ``|e| <= tolerance`` in ``settle_steps`` observations in a row;
    * stalled: within the last ``stall_window`` steps the smallest ``|e|`` fell by less than
      ``stall_progress``;
    * actuator limits: as stalled, while some actuator that matters stood at its limit;
    * step limit: ``max_steps`` commands were given; time-out: ``max_seconds`` are over;
    * object lost: the plant says so, or the object turned off the focus by more than
      ``off_limit`` [rad]: it is dislocated, and no small step brings it back.
    """

    tolerance: float = math.radians(0.25)
    """[unit of the focused pose: rad for a rotation]"""
    settle_steps: int = 2
    stall_window: int = 12
    stall_progress: float = math.radians(0.1)
    """[same unit]"""
    max_steps: int = 60
    off_limit: float = math.radians(30.0)
    max_seconds: float = math.inf
    """From the first observation on; a motion under way is finished [s]."""

    def __post_init__(self) -> None:
        for name in ("tolerance", "settle_steps", "stall_window", "max_steps", "off_limit", "max_seconds"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")

    def judge(self, errors: list[float], limited: bool = False) -> StopReason:
        """Judge the history of ``|e|``, one entry for each observation, the newest last.

        Args:
            limited: the last step was cut short by an actuator's limit.
        """
        recent = errors[-self.settle_steps :]
        if len(recent) == self.settle_steps and max(recent) <= self.tolerance:
            return StopReason.REACHED
        if len(errors) > self.stall_window:
            before, after = min(errors[: -self.stall_window]), min(errors[-self.stall_window :])
            if before - after < self.stall_progress:
                return StopReason.ACTUATOR_LIMITS if limited else StopReason.STALLED
        if len(errors) > self.max_steps:
            return StopReason.STEP_LIMIT
        return StopReason.RUNNING
