"""Why a closed loop looks again and stops: the reasons, and the figures behind them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ...exceptions import ParameterError
from ...plant import Stamps
from ..decision import StopReason

_DEG = math.pi / 180
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

    * reached: ``|e| <= tolerance``, e by the mean of ``looks`` to ``most_looks`` readings at rest: further
      ones are taken while the mean is nearer to the tolerance than it is sure;
    * stalled: within the last ``stall_window`` steps the smallest ``|e|`` fell by less than
      ``stall_progress``;
    * actuator limits: as stalled, while some actuator that matters stood at its limit;
    * step limit: ``max_steps`` commands were given;
    * object lost: the plant says so, or the object turned off the focus by more than
      ``off_limit`` [rad]: it is dislocated, and no small step brings it back.
    """

    tolerance: float = 0.25 * _DEG
    """[rad], see :class:`~torch_ekm.control.FocusedPose`; at 0.25 deg each direction has its own."""
    looks: int = 2
    most_looks: int = 4
    stall_window: int = 12
    stall_progress: float = 0.1 * _DEG
    """[rad], likewise"""
    max_steps: int = 60
    off_limit: float = 30 * _DEG

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
class Guards:
    """Limits of a :class:`~torch_ekm.control.ClosedLoop`, the same for every plant; SI units.

    A reading that breaks one is looked at again (``observe()``), ``looks`` times. If it stands, the loop ends
    with a reason of its own, and what learns (learner, figures, servo model) is as it was before the
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
    """Which readings count, and when the hand stops; the same for every controller that is compared."""

    rule: StoppingRule = StoppingRule()
    """Reached, stalled, step limit, actuator limits, object lost."""
    guards: Guards = Guards()
    """Stale sensor, and all reasons that follow it in :class:`StopReason`."""
