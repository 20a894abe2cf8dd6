"""The guards of a closed loop: their limits, the one table of their tests, and the judge of these."""

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
    unchanged: float = 1 * DEGREE
    """A sensor that repeats its reading bit by bit while the encoders go so far is frozen [rad]."""
    gate: float = NOISE.outlier
    """Standard deviations."""
    relative: float = NOISE.described
    """Error of the model that is no surprise, as a share of the motion."""
    translation_noise: float = 0.4e-3
    """Standard deviation of a pose [m]."""
    rotation_noise: float = NOISE.rotation
    """[rad]"""
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
    """Of an encoder, mean over a motion; and of commands beyond ``increment`` [rad/s]."""
    stuck_command: float = 4 * DEGREE
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


class Test(NamedTuple):
    """One row of the table."""

    reason: StopReason
    says: str
    """Sensor, figure and limit."""
    remedy: str = ""
    effect: Effect = Effect.STOP
    running: int = 0
    """It ends the manipulation where it objects in so many motions in succession; 0: never by that."""


_DRIVER = "check its driver or its time stamps"
_MAGNET = "it drifts, or slips; check its magnet and cable"
_PLANT = "see 'torch-ekm check --plant'"
_STANDS_IN = "the model's estimate stands in"
_R, _E = StopReason, Effect

TABLE: dict[str, Test] = {
    # a reading
    "all repeat": Test(
        _R.STALE_SENSOR, "encoders, joints and pose are the same bit by bit after a motion",
        "check the driver"),
    "encoders repeat": Test(
        _R.STALE_SENSOR, "encoders are the same bit by bit while joints and object moved",
        "check their driver"),
    "not seen": Test(
        _R.BLIND, "the camera does not find the object", "clear its view, or light it", _E.BLIND),
    "repeats": Test(
        _R.STALE_SENSOR, "{what} is the same bit by bit while the encoders moved {way}", _DRIVER),
    "before": Test(
        _R.STALE_SENSOR, "{what} was read at {taken:.3f} s, before the motion that began at {began:.3f} s",
        _DRIVER),
    "age": Test(_R.STALE_SENSOR, "{what} is {age:.3f} s old, Guards.max_age is {limit:g} s", _DRIVER),
    "clock": Test(
        _R.STALE_SENSOR, "the clock went back from {began:.3f} to {time:.3f} s", "check the driver"),
    "range": Test(
        _R.OUT_OF_RANGE,
        "{what} '{name}' reads {angle}, its range is {lower} to {upper} (Guards.beyond is {most})",
        "check it"),
    "encoder jump": Test(
        _R.ENCODER_JUMP,
        "encoder '{name}' went {went} where {sent} were commanded ({most} more are allowed, "
        "Guards.encoder_jump)", "check its cable and zero"),
    "encoders against": Test(
        _R.WRONG_WAY,
        "encoders made {share:.1f} of the motion that was commanded (limit -{limit:g}): '{name}' went {went} "
        "where {sent} were", f"a sign of the motors or of their encoders is wrong; {_PLANT}"),
    "speed": Test(
        _R.SPEED_CEILING, "encoder '{name}' went {went} in {seconds:.3g} s (Guards.speed is {most}/s)",
        "the driver must wait for the end of a motion, and date it"),
    "joint jump": Test(
        _R.JOINT_JUMP,
        "joint '{name}' turned {turned} where {predicted} were predicted (Guards.joint_jump is {most})",
        "check its sensor"),
    "pose jump": Test(
        _R.POSE_JUMP,
        "the pose is {way:.1f} mm and {turn} away from what was predicted, while the fingertips hold the "
        "object (Guards allow jumps of {most_way:g} mm and {most})", "check camera and markers"),
    "gate": Test(
        _R.BLIND,
        "{what} {came:.2f} {unit} where {predicted:.2f} ± {sigma:.2f} {unit} were predicted (Guards.gate is "
        "{limit:g})", effect=_E.UNLEARNED),
    # a motion
    "drifts": Test(
        _R.ENCODER_DRIFT,
        "encoder '{name}' went {went} though its motor was sent nowhere (limit {most})", _MAGNET,
        _E.LIES, running=3),
    "joints against": Test(
        _R.WRONG_WAY,
        "joints and object made {share:.1f} of the motion that the encoders' motion predicts (limit "
        "-{limit:g})", f"a sign of the motors, of their encoders or of the joints is wrong; {_PLANT}",
        _E.UNLEARNED, running=2),
    "drifts as driven": Test(
        _R.ENCODER_DRIFT,
        "encoder '{name}' went {rate} more than its joints in each motion, whichever way ({figure:.1f} "
        "standard deviations, more where its servo agrees, limit {limit:g})", _MAGNET, _E.LIES, running=1),
    "away": Test(
        _R.WRONG_WAY,
        "the object has gone away from its target in {figure:.0f} motions running, while the motors did as "
        "commanded", f"a motor's or a joint's sign is wrong, or the pose is in another frame; {_PLANT}"),
    "stuck": Test(
        _R.ACTUATOR_STUCK, "actuator {names} does not move however it is commanded",
        "check motor and tendon"),
    # fingertips
    "weak": Test(_R.WEAK_GRASP, "{fingers}"),
    "late": Test(_R.STALE_SENSOR, "the fingertips were read at {taken:.3f} s", _STANDS_IN, _E.TOLD),
    "scale": Test(
        _R.FINGERTIP_FAULT,
        "the fingertips read {measured:.1f} N, joints and springs give {other:.1f} N, as a rule {times:.2g} "
        "times that on this hand ({scale:g} times are allowed)", "check their scale; nothing is learned",
        _E.LIES),
    "first scale": Test(
        _R.FINGERTIP_FAULT,
        "the fingertips read {measured:.1f} N, joints and springs give {other:.1f} N ({scale:g} times are "
        "allowed)", "check their scale, and the description's springs", _E.TOLD),
    "at fault": Test(_R.FINGERTIP_FAULT, "{said}", _STANDS_IN, _E.TOLD),
    "several at fault": Test(
        _R.FINGERTIP_FAULT, "{said} (Guards.faulty_pads is {limit})",
        "check range and cable of the fingertips, or those of the joint sensors if several fingertips "
        "disagree"),
    "ceiling": Test(
        _R.FORCE_CEILING,
        "fingertip '{name}' presses with {figure:.1f} N {how}, Guards.force_ceiling is {limit:g} N",
        "free the object, lower GripForceTask.force, or choose a nearer target (ClosedLoop.reach)"),
}  # fmt: skip


class Objection(NamedTuple):
    """What speaks against a reading, a command, or going on."""

    reason: StopReason
    message: str = ""
    """Sensor, figure, limit, and what to do."""
    effect: Effect = Effect.STOP
    test: str = ""
    """Its name in the table."""


def check(
    test: str, figure: float, limit: float, angles: dict[str, float] | None = None, **words: Any
) -> list[Objection]:
    """What a test of the table says of a figure: nothing up to its limit. Angles [rad] are in degrees."""
    if not figure > limit:
        return []
    reason, says, remedy, effect, _ = TABLE[test]
    words |= {name: deg(angle) for name, angle in (angles or {}).items()}
    message = says.format(figure=float(figure), limit=limit, **words)
    return [Objection(reason, f"{message}: {remedy}" if remedy else message, effect, test)]


def gravest(said: list[Objection]) -> Objection | None:
    """The objection with the gravest effect, of equals the first; None: nothing speaks against it."""
    return max(said, key=lambda one: one.effect, default=None)


def ended(said: list[Objection]) -> Objection | None:
    """The first that ends the manipulation."""
    return next((one for one in said if one.effect is Effect.STOP), None)


def deg(angle: Any) -> str:
    """An angle [rad] as a text in degrees."""
    return f"{float(angle) / DEGREE:.3g} deg"
