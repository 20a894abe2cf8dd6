"""How far a manipulation has come, and why it ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from .._checks import check_kind
from .._noise import DEGREE
from ..exceptions import CommandRefusedError, GraspError, ParameterError
from ..plant import Observation, PlantStatus
from ..plant.plant import mean_reading
from .controller import LookAndMoveController
from .decision import Stop, StopReason
from .focus import A_TARGET, PoseTarget
from .guards import Guards
from .tasks import ActuatorLimit
from .watch import Watch

_WEAK = 0.035  # of the largest gain: a direction that motors do not hold; those that they hold have .07
_LEAP = math.radians(4)  # of a pose beyond what was predicted, where nothing else has changed: worth a word


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
    """Wrong way, all reasons that follow it in :class:`StopReason`, and a weak grasp."""


class Ends:
    """Errors of one manipulation, judged by a :class:`~torch_ekm.control.StoppingRule`."""

    limited = False
    """The last movement was cut short by an actuator's limit."""
    surprise = ""
    """The first reading that was accepted though no motion explains it, or the one with the largest leap."""

    def __init__(
        self, rule: StoppingRule, target: PoseTarget, controller: LookAndMoveController, seen: Observation
    ) -> None:
        check_kind("target", target, PoseTarget, A_TARGET)
        self.rule, self.target, self._controller, self._start = rule, target, controller, seen.state
        self.errors = [self.error(seen)]
        """|e| before each movement and after the last, as a turn [rad]."""
        self._leap = 0.0  # [rad] of the surprise

    def error(self, seen: Observation) -> float:
        """|e| as a turn [rad]."""
        return self._controller.focus.error(self.target, seen.state)

    def look(
        self, seen: Observation, watch: Watch, another: Callable[[], Observation]
    ) -> tuple[Observation, int]:
        """The mean of as many readings at rest as it takes to see whether the target is reached, and how many
        these are."""
        rule, readings, mean = self.rule, [seen], seen
        while mean.status is PlantStatus.HELD and len(readings) < rule.most_looks:
            n, error = len(readings), self.error(mean)
            doubt = watch.readings.pose_noise(seen, self._controller.focus) / math.sqrt(n)
            clear = n >= rule.looks and abs(error - rule.tolerance) > doubt
            if clear or error > rule.tolerance + 3 * doubt:
                break
            further = watch.rest(seen, another())
            if further is seen:
                break
            readings.append(further)
            mean = mean_reading(readings)
        return mean, len(readings)

    def over(self, seen: Observation, looks: int, stopped: bool, declines: bool) -> Stop | None:
        """Why the manipulation ends before the next movement; None: it goes on. ``seen`` is the mean of
        ``looks`` readings; ``stopped``: an end was asked for; ``declines``: what is out of reach."""
        held, focus, rule = seen.status is PlantStatus.HELD, self._controller.focus, self.rule
        if seen.status is PlantStatus.LOST:
            return Stop(StopReason.OBJECT_LOST, seen)
        if focus.off_rotation(seen.state.minus(self._start)) > rule.off_limit:
            return Stop(StopReason.OBJECT_LOST, seen, "dislocated off the focused axis")
        if looks >= rule.looks and held and self.error(seen) <= rule.tolerance:
            return Stop(StopReason.REACHED, seen, self.surprise if self._leap > _LEAP else "")
        reason = rule.judge(self.errors, self.limited)
        if reason is not StopReason.RUNNING or stopped:
            return Stop(StopReason.STOPPED if reason is StopReason.RUNNING else reason, seen)
        why = out_of_reach(self._controller, seen, self.target) if declines and held else ""
        return Stop(StopReason.OUT_OF_REACH, seen, why) if why else None

    def add(self, after: Observation, limited: bool) -> None:
        """One more movement that turns."""
        self.errors.append(self.error(after))
        self.limited = limited

    def leapt(self, off: float, note: str) -> None:
        """The object has turned by ``off`` [rad] more than predicted, and what a guard says of it."""
        if not self.surprise or off > max(self._leap, _LEAP):
            told = "if the object did not slide, check that sensor"
            moved = "if the camera was moved, or took one marker for another, the target is off by as much"
            self._leap, self.surprise = off, f"in motion {len(self.errors) - 1} {note}: {told}; {moved}"


def failed(error: BaseException, final: Observation) -> Stop:
    """By what the plant raised, or the gate before it, or Ctrl-C."""
    if isinstance(error, KeyboardInterrupt):
        return Stop(StopReason.STOPPED, final, "Ctrl-C", error)
    refused = isinstance(error, CommandRefusedError)
    reason = StopReason.COMMAND_REFUSED if refused else StopReason.PLANT_FAILED
    return Stop(reason, final, f"{type(error).__name__}: {error}", error)


@torch.no_grad()
def out_of_reach(controller: LookAndMoveController, seen: Observation, target: PoseTarget) -> str:
    """Why motors cannot bring an object to a target; empty: they can, as far as J_m says.

    Two tests, of first order: the motors hold each direction of the focus, by the singular values of
    ``M_c D E_p J_m`` with D that counts 0.8 mm as 1 deg; and their whole ranges come as far as the target.
    """
    focus, hand = controller.focus, controller.kinematic.hand
    try:
        lin = controller.kinematic.linearize(seen.state, fingertip_force=seen.fingertip_force)
    except GraspError:  # the loop will say so itself
        return ""
    D = torch.tensor([1250 * DEGREE] * 3 + [1.0] * 3, dtype=torch.float64)
    asked = focus.matrix @ (D * target.error(seen.state))
    limits = (limit for limit in controller.limits if isinstance(limit, ActuatorLimit))
    moves = next(limits, ActuatorLimit()).moves(hand)
    scaled = (D[:, None] * lin.object_jacobian)[:, torch.from_numpy(moves)]
    U, found, _ = torch.linalg.svd(focus.matrix @ scaled)
    gains = torch.cat([found, found.new_zeros(len(asked) - len(found))])
    held = gains >= _WEAK * torch.linalg.matrix_norm(scaled, 2)
    if not (focus.is_turn or bool(held.all())):
        parts = sorted(zip(U[:, -1].abs().tolist(), map(str, focus.directions), strict=True), reverse=True)
        weak = " with ".join(name for share, name in parts if share > 0.3)
        few = f"the motors hold {int(held.sum())} of the {len(gains)} directions of the focus"
        return f"{few}, and too little of {weak}: leave a direction out"
    room = torch.from_numpy((hand.actuator_upper - hand.actuator_lower)[np.flatnonzero(moves)])
    share = float((asked @ focus.matrix @ scaled).abs() @ room / (asked @ asked).clamp(min=1e-9))
    if bool(held.all()) and share >= 1:  # the path of a turn about one axis says more
        return ""
    most = f"to first order the whole ranges of the motors come {100 * min(share, 1):.0f} % of the way"
    return f"{most}: choose a nearer target, or another direction"
