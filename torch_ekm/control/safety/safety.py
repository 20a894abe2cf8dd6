"""Why a closed loop looks again, goes back, stops or gives up: the reasons, and the figures behind them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ...exceptions import ParameterError
from ...plant import Stamps
from ..decision import StopReason

_DEG = math.pi / 180
OFF_BY_SHIFTS = 1.5  # times off_rotation: a shift of 3 mm alone turns the object by 8 to 10 deg
_MAX_AGE = Stamps(encoders=0.2, joints=0.2, pose=0.4, fingertips=0.4)


class Objection(NamedTuple):
    """What speaks against a reading, a command, or going on."""

    reason: StopReason
    message: str = ""
    """Sensor, figure, limit, and what to do."""
    blind: bool = False
    """The pose is not known; the rest is."""
    gated: bool = False
    """Surprising, but possible."""


@dataclass(frozen=True)
class StoppingRule:
    """Explicit parameters of the stopping rule; the same for every controller that is compared.

    * reached: ``|e| <= tolerance`` in ``settle_steps`` observations in a row;
    * stalled: within the last ``stall_window`` steps the smallest ``|e|`` fell by less than
      ``stall_progress``;
    * actuator limits: as stalled, while some actuator that matters stood at its limit;
    * step limit: ``max_steps`` commands were given;
    * object lost: the plant says so, or the object turned off the focus by more than
      ``off_limit`` [rad]: it is dislocated, and no small step brings it back.
    """

    tolerance: float = 0.25 * _DEG
    """[rad], see :class:`~torch_ekm.control.FocusedPose`; at 0.25 deg each direction has its own."""
    settle_steps: int = 2
    stall_window: int = 12
    stall_progress: float = 0.1 * _DEG
    """[rad], likewise"""
    max_steps: int = 60
    off_limit: float = 30 * _DEG

    def __post_init__(self) -> None:
        for name in ("tolerance", "settle_steps", "stall_window", "max_steps", "off_limit"):
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


@dataclass(frozen=True)
class Caution:
    """What announces a loss before it comes, and what is done then; the same for every controller.

    Signs: the model refuses the state; the object has turned off the focus by ``off_rotation``; a link
    without a pad comes to bear on the object; a finger loses its force against the prediction in three
    motions running. One that ``looks`` further readings show as well is heeded:
    the hand goes back along the way that was come, motion by motion, until the signs are gone, for these
    states are known to hold. It grips by ``tighten`` more and tries again at a smaller pace, ``retreats``
    times; at the next sign it goes back once more and gives up. Where going back does not help, it gives up
    at once: an object that has slid off the focus does not come back, and turned on it slips out.
    """

    looks: int = 2
    """Further readings before a sign is believed."""
    off_rotation: float = 8 * _DEG
    """[rad]; ``OFF_BY_SHIFTS`` times as much where the focus holds no turn, a rehearsal apart"""
    link_gap: float = 0.2e-3
    """A link without a pad as near to the object as this counts, unless it was so near at the start [m]."""
    retreats: int = 1
    way_back: int = 4
    """Motions of one retreat at most."""
    tighten: float = 1.0
    """[N]"""
    slip: float = 0.5
    """Where an object moves otherwise than an E-KM predicts, the grip is tightened by so much [N]."""
    grips: int = 5
    """Motions at most that only grip, where a finger bears less than the object needs before the first turn;
    a grasp that stays weak is declined."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "link_gap" and not value >= 0:  # a link may overlap by so much
                raise ParameterError(name, value, "0 or more")


@dataclass(frozen=True)
class Guards:
    """Limits of a :class:`~torch_ekm.control.ClosedLoop`, the same for every plant; SI units.

    A reading that breaks one is looked at again (``observe()``), ``looks`` times. If it stands, the loop ends
    with a reason of its own, and what learns (learner, trust region, servo model) is as it was before the
    motion; where a sensor lied for several, before the manipulation. Two things are no end: a motion whose
    pose is unknown is blind, and the model predicts the pose; a fingertip at fault is left out, and the
    model's estimate stands in.

    A change ``z_i`` is gated: ``|z_i - predicted_i| > gate sigma_i`` is no evidence, with::

        sigma^2 = Sigma_before + Sigma_after + Var[g] + (relative |predicted|)^2

    Sigma of a pose is what the plant states (``info["estimate"]["pose_covariance"]``), else
    ``translation_noise`` and ``rotation_noise``. A gated change that further looks confirm is real (it
    has slid): it is where it is seen, but the motion does not teach.

    Raises:
        ParameterError: a figure outside its range.
    """

    looks: int = 2
    """Further readings of a sensor that is in doubt."""
    max_age: Stamps = _MAX_AGE
    """An older reading is stale [s]; less than the hand rests after a motion."""
    blind_motions: int = 2
    """In succession, without a pose that is seen; the next one is not made."""
    unchanged: float = 1 * _DEG
    """A sensor that repeats its reading bit by bit while the encoders go so far is frozen [rad]."""
    gate: float = 4.0
    """Standard deviations."""
    relative: float = 0.3
    """Error of the model that is no surprise, as a share of the motion."""
    translation_noise: float = 0.4e-3
    """Standard deviation of a pose [m]."""
    rotation_noise: float = 0.3 * _DEG
    """[rad]"""
    joint_noise: float = 1.5 * _DEG
    """[rad]"""
    encoder_jump: float = 8 * _DEG
    """An encoder goes so much further than it was commanded to, or so far back [rad]."""
    joint_jump: float = 20 * _DEG
    """Of a joint, away from what was predicted of one motion [rad]."""
    rotation_jump: float = 60 * _DEG
    """Of the object, likewise [rad]. Objects that slip out of a pinch do turn by 40 deg."""
    translation_jump: float = 0.03
    """[m]"""
    beyond: float = 15 * _DEG
    """Encoders and joints read no more than this outside their ranges [rad]."""
    increment: float = 20 * _DEG
    """Largest command to an actuator, as it leaves the :class:`~torch_ekm.plant.Gate` [rad]."""
    speed: float = 3.0
    """Of an encoder, mean over a motion; and of commands beyond ``increment`` [rad/s]."""
    stuck_command: float = 4 * _DEG
    """An actuator that stands still in two such commands running is stuck [rad]; so is one that the
    servo model calls so."""
    wrong_way: int = 3
    """Motions running that take the object farther from its target, each by more than the rule's tolerance,
    while the motors do as commanded, before half the way is made: a sign is wrong. One more is not made."""
    force_ceiling: float = 12.0
    """Of a pad, as measured, or as estimated where it is not [N]."""
    fingertip_repeats: int = 8
    """A pad that reads the same force bit by bit so often while the encoders move is frozen or saturated."""
    faulty_pads: int = 1
    """So many of the pads in contact may read what joints and springs contradict; dead ones do not count."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = 0 if name in ("looks", "blind_motions", "faulty_pads") else None
            figures = value if isinstance(value, tuple) else (value,)
            if not all(figure > 0 if least is None else figure >= least for figure in figures):
                raise ParameterError(name, value, "greater than 0" if least is None else "0 or more")


@dataclass(frozen=True)
class Safety:
    """Which readings count, when the hand looks again, goes back, stops and gives up; the same for every
    controller that is compared. A grasp that is unstable has no figure: the model has no step.
    """

    rule: StoppingRule = StoppingRule()
    """Reached, stalled, step limit, actuator limits, object lost."""
    caution: Caution = Caution()
    """Given up."""
    guards: Guards = Guards()
    """Stale sensor, and all reasons that follow it in :class:`StopReason`."""
