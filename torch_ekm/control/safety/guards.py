"""The guards of a closed loop: their limits, and what an objection to a reading brings about."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

from ..._noise import DEGREE, NOISE
from ...exceptions import ParameterError
from ...plant import Stamps
from ..decision import StopReason

_MAX_AGE = Stamps(encoders=0.2, joints=0.2, pose=0.4, fingertips=0.4)


@dataclass(frozen=True)
class Guards:
    """Limits of a :class:`~torch_ekm.control.ClosedLoop`, the same for every plant; SI units.

    A reading that breaks one is looked at again (``observe()``), twice. If it stands, the loop ends with a
    reason of its own, and what learns (learner, figures, servo model) is as it was before the motion; where a
    sensor lied for several, before the manipulation. Two things are no end: a motion whose pose is unknown is
    blind, and the model predicts the pose; one fingertip at fault is left out, and the model's estimate
    stands in.

    A change ``z_i`` is gated: ``|z_i - predicted_i| > gate sigma_i`` is no evidence, with::

        sigma^2 = Sigma_before + Sigma_after + Var[g] + (0.3 |predicted|)^2

    Sigma of a pose is what the plant states (``info["estimate"]["pose_covariance"]``), and at least
    ``translation_noise`` and 0.3 deg. A gated change that further looks confirm is real (it has slid): it is
    where it is seen, but the motion does not teach.

    Raises:
        ParameterError: a figure outside its range.
    """

    max_age: Stamps = _MAX_AGE
    """An older reading is stale [s]; less than the hand rests after a motion."""
    blind_motions: int = 2
    """In succession, without a pose that is seen; the next one is not made."""
    unchanged: float = 1 * DEGREE
    """A sensor that repeats its reading bit by bit while the encoders go so far is frozen [rad]."""
    gate: float = NOISE.outlier
    """Standard deviations."""
    translation_noise: float = 0.4e-3
    """Standard deviation of a pose [m]."""
    joint_noise: float = 1.5 * DEGREE
    """[rad]"""
    encoder_jump: float = 8 * DEGREE
    """An encoder goes so much further than it was commanded to, or so far back [rad]."""
    joint_jump: float = 20 * DEGREE
    """Of a joint, away from what was predicted of one motion [rad]."""
    rotation_jump: float = 60 * DEGREE
    """Of the object, likewise [rad]. Objects that slip out of a pinch do turn by 40 deg."""
    translation_jump: float = 0.03
    """[m]"""
    beyond: float = 15 * DEGREE
    """Encoders and joints read no more than this outside their ranges [rad]."""
    increment: float = 20 * DEGREE
    """Largest command to an actuator, as it leaves the :class:`~torch_ekm.plant.Gate` [rad]."""
    speed: float = 3.0
    """Of commands beyond ``increment`` [rad/s]."""
    stuck_command: float = 4 * DEGREE
    """An actuator that stands still in two such commands running is stuck [rad]; so is one that the
    servo model calls so."""
    force_ceiling: float = 12.0
    """Of a pad, as measured, or as estimated where it is not [N]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = 0 if name == "blind_motions" else 1e-12
            if not all(figure >= least for figure in (value if isinstance(value, tuple) else (value,))):
                raise ParameterError(name, value, "0 or more" if least == 0 else "greater than 0")


class Effect(IntEnum):
    """What follows where a test objects and another look does not help, the mildest first."""

    TOLD = 0
    """A note."""
    UNLEARNED = 1
    """Nothing is learned of the motion; the loop goes on from what is seen, and plans again."""
    LIES = 2
    """Nothing is learned of the whole manipulation."""
    BLIND = 3
    """The pose is not known, and predicted; the rest is."""
    STOP = 4
    """The hand holds."""


class Objection(NamedTuple):
    """What speaks against a reading, a command, or going on."""

    reason: StopReason
    message: str = ""
    """Sensor, figure, limit, and what to do."""
    effect: Effect = Effect.STOP
    running: int = 0
    """It ends the manipulation where it is raised in so many motions in succession; 0: never by that."""


def against(
    wrong: Any, reason: StopReason, message: str, effect: Effect = Effect.STOP, running: int = 0
) -> list[Objection]:
    """An objection where something is wrong, else none."""
    return [Objection(reason, message, effect, running)] if wrong else []


def gravest(said: list[Objection]) -> Objection | None:
    """The objection with the gravest effect, of equals the first; None: nothing speaks against it."""
    return max(said, key=lambda one: one.effect, default=None)


def deg(angle: Any) -> str:
    """An angle [rad] as a text in degrees."""
    return f"{float(angle) / DEGREE:.3g} deg"
