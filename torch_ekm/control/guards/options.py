"""What a closed loop believes of its sensors, and what it never lets its hand do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ...exceptions import ParameterError
from ...plant import Stamps
from ..termination import StopReason

_DEG = math.pi / 180
_MAX_AGE = Stamps(encoders=0.2, joints=0.2, pose=0.4, fingertips=0.4)


class Halt(NamedTuple):
    """Why a guard ends a manipulation."""

    reason: StopReason
    message: str
    """Sensor, figure, limit, and what to do."""


@dataclass(frozen=True)
class Guards:
    """Limits of a :class:`~torch_ekm.control.ClosedLoop`, the same for every plant; SI units.

    A reading that breaks one is looked at again (``observe()``), ``looks`` times. If it stands, the loop ends
    with a reason of its own, and what learns (learner, trust region, servo model) is as it was before the
    motion. Two things are no end: a motion whose pose is unknown is blind, and the model predicts the
    pose; a fingertip at fault is left out, and the model's estimate stands in.

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
    """An encoder goes so much further than it was told, or so far back [rad]."""
    joint_jump: float = 20 * _DEG
    """Of a joint, away from what was predicted of one motion [rad]."""
    rotation_jump: float = 60 * _DEG
    """Of the object, likewise [rad]. Objects that slip out of a pinch do turn by 40 deg."""
    translation_jump: float = 0.03
    """[m]"""
    beyond: float = 15 * _DEG
    """Encoders and joints read no more than this outside their ranges [rad]."""
    increment: float = 20 * _DEG
    """Largest command to an actuator [rad]."""
    speed: float = 3.0
    """Of an encoder, mean over a motion [rad/s]."""
    stuck_command: float = 4 * _DEG
    """An actuator that stands still in two such commands running is stuck [rad]; so is one that the
    servo model calls so."""
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
