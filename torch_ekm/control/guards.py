"""The guards of a closed loop: limits, what speaks against a reading, and what that brings about."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, auto
from typing import Any, NamedTuple

import numpy as np
import torch

from .._noise import DEGREE, NOISE
from ..description import HandDescription
from ..exceptions import ParameterError
from ..plant import Observation, PlantStatus, Stamps
from ..typing import Array, Tensor
from .decision import Expectation, StopReason
from .focus import FocusedPose

_MAX_AGE = Stamps(encoders=0.2, joints=0.2, pose=0.4, fingertips=0.4)
_SENSORS = "the encoders' reading", "the joints' reading", "the object's pose"
_DRIVER = "check its driver or its time stamps"
CHECK_PLANT = "see 'torch-ekm check --plant'"
_MIRRORED = 0.5  # of the distance from a path, within which of its mirror image motors have gone back
_LEVER = 0.03  # [m] a rotation that is predicted wrong carries the object's point so much
_TWICE = math.sqrt(2)  # times the noise of a reading that of a difference is


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

    TOLD = auto()
    """A note."""
    UNLEARNED = auto()
    """Nothing is learned of the motion; the loop goes on from what is seen, and plans again."""
    LIES = auto()
    """Nothing is learned of the whole manipulation."""
    BLIND = auto()
    """The pose is not known, and predicted; the rest is."""
    STOP = auto()
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


class ReadingTests:
    """Tests of readings against :class:`~torch_ekm.control.Guards`; the hand gives names and ranges."""

    def __init__(self, guards: Guards, hand: HandDescription) -> None:
        self.guards, self.hand = guards, hand
        self._last: Observation | None = None
        self._still: Observation | None = None  # since which the encoders read the same, bit by bit
        self._ways = [0.0, 0.0]  # of the encoders since joints, and since the pose, read something else

    def at_rest(self, seen: Observation, before: Observation | None = None) -> Objection | None:
        """Of a reading without a motion since ``before``."""
        said = [*self._ages(seen, None), *self.motors(before, None, seen)]
        if before is not None:
            back = f"the clock went back from {before.time:.3f} to {seen.time:.3f} s: check the driver"
            said += against(before.dated and seen.time < before.time, StopReason.STALE_SENSOR, back)
            ds = seen.state.minus(before.state).numpy()
            said += self._jumps(ds, 0 * ds, seen)
        return gravest(said)

    def after_motion(
        self, before: Observation, sent: Tensor, seen: Observation, expected: Expectation, blind: int
    ) -> Objection | None:
        """Of a reading after the motors were sent by ``sent`` [rad], the gravest; ``blind`` motions without a
        pose came before."""
        said = self._ages(seen, before)
        unseen = bool(said)  # the rest is still looked at
        said += self.motors(before, sent, seen)
        ds, predicted = seen.state.minus(before.state).numpy(), expected.increment.numpy()
        said += self._jumps(ds, predicted, seen, unseen)
        said += [] if unseen else self._gate(before, ds, expected, seen, blind)
        return gravest(said)

    def _ages(self, seen: Observation, before: Observation | None) -> list[Objection]:
        """Stale, repeated or missing readings; of fingertips another reading stands in."""
        said, same, moved, began = [], self._same(seen), 0.0, -math.inf
        if before is not None:
            moved, began = float((seen.a - before.a).abs().max()), before.time if before.dated else began
            if moved == 0 and all(same):
                what = "encoders, joints and pose are the same bit by bit after a motion: check the driver"
                said.append(Objection(StopReason.STALE_SENSOR, what))
            elif moved == 0 and self._still is not None and self._moved(self._still, seen):
                what = "encoders are the same bit by bit while joints and object moved: check their driver"
                said.append(Objection(StopReason.STALE_SENSOR, what))
            if seen.status is PlantStatus.NOT_SEEN:
                what = "the camera does not find the object: clear its view, or light it"
                said.append(Objection(StopReason.BLIND, what, Effect.BLIND))
        for k, what in enumerate(_SENSORS):
            taken, most, way, why = seen.taken[k], self.guards.max_age[k], 0.0, ""
            if before is not None and k and same[k - 1]:
                way = self._ways[k - 1] + moved
            if way > self.guards.unchanged:
                why = f"{what} is the same bit by bit while the encoders moved {deg(way)}"
            elif seen.dated and taken <= began:
                why = f"{what} was read at {taken:.3f} s, before the motion that began at {began:.3f} s"
            elif seen.dated and abs(seen.time - taken) > most:
                why = f"{what} is {seen.time - taken:.3f} s old, Guards.max_age is {most:g} s"
            effect = Effect.STOP if before is None or k < 2 else Effect.BLIND
            said += against(why, StopReason.STALE_SENSOR, f"{why}: {_DRIVER}", effect)
        return said

    def _moved(self, one: Observation, other: Observation) -> bool:
        """More than noise, and not the object alone, which may have slid."""
        joint = float((other.q - one.q).abs().max())
        return joint > _TWICE * self.guards.joint_noise and not agree(one, other, self.guards)

    def motors(self, before: Observation | None, sent: Tensor | None, seen: Observation) -> list[Objection]:
        """Ranges, and encoders after the motors were sent through ``sent`` [rad]; None: nowhere."""
        hand, guards, said = self.hand, self.guards, []
        for what, names, lower, upper, value in (
            ("encoder", hand.actuator_names, hand.actuator_lower, hand.actuator_upper, seen.a),
            ("joint", hand.joint_names, hand.joint_lower, hand.joint_upper, seen.q),
        ):
            read = value.detach().cpu().double().numpy()
            beyond = (lower - read).clip(min=read - upper)
            i = int(beyond.argmax())
            out = f"{what} '{names[i]}' reads {deg(read[i])}, its range is {deg(lower[i])} to {deg(upper[i])}"
            out += f" (Guards.beyond is {deg(guards.beyond)}): check it"
            said += against(beyond[i] > guards.beyond, StopReason.OUT_OF_RANGE, out)
        if before is None:
            return said
        moved, way = (seen.a - before.a).numpy(), np.zeros((1, len(seen.a))) if sent is None else sent.numpy()
        v, most = way[-1], guards.unchanged if sent is None else guards.encoder_jump
        away = np.maximum(np.minimum(v, 0) - moved, moved - np.maximum(v, 0))  # further than sent, or back
        i = int(away.argmax())
        jump = f"encoder '{hand.actuator_names[i]}' went {deg(moved[i])} where {deg(v[i])} were commanded "
        jump += f"({deg(most)} more are allowed, Guards.encoder_jump): check its cable and zero"
        jumped = against(away[i] > most, StopReason.ENCODER_JUMP, jump)
        if abs(v).max() < guards.unchanged:
            return said + jumped
        # no share of the path: a movement that was ended on the way, or an encoder that jumps, has any
        (off, mirrored), i = (_off_path(x, way) for x in (moved, -moved)), int((moved * v).argmin())
        back = (
            f"encoders made {moved @ v / (v @ v):.1f} of the motion that was commanded: they are {deg(off)} "
        )
        back += f"off its path and {deg(mirrored)} off its mirror image (limit {deg(guards.unchanged)}); "
        back += f"'{hand.actuator_names[i]}' went {deg(moved[i])} where {deg(v[i])} were"
        back += f": a sign of the motors or of their encoders is wrong; {CHECK_PLANT}"
        wrong = off > guards.unchanged and mirrored < _MIRRORED * off
        return said + against(wrong, StopReason.WRONG_WAY, back) + jumped

    def _jumps(self, ds: Array, predicted: Array, seen: Observation, unseen: bool = False) -> list[Objection]:
        """What no motion does; of a pose that is not seen: nothing."""
        guards, off, n_q = self.guards, ds - predicted, self.hand.n_q
        i = int(abs(off[:n_q]).argmax())
        jump = f"joint '{self.hand.joint_names[i]}' turned {deg(ds[i])} where {deg(predicted[i])} were "
        jump += f"predicted (Guards.joint_jump is {deg(guards.joint_jump)}): check its sensor"
        said = against(abs(off[i]) > guards.joint_jump, StopReason.JOINT_JUMP, jump)
        held = seen.fingertip_force is not None and int((seen.fingertip_force > NOISE.pressing).sum()) > 1
        if not unseen and held:
            way, turn = (math.sqrt(part @ part) for part in (off[-6:-3], off[-3:]))
            jump = f"the pose is {1e3 * way:.1f} mm and {deg(turn)} away from what was predicted, while the "
            jump += f"fingertips hold the object (Guards allow jumps of {1e3 * guards.translation_jump:g} mm "
            jump += f"and {deg(guards.rotation_jump)}): check camera and markers"
            far = way > guards.translation_jump or turn > guards.rotation_jump
            said += against(far, StopReason.POSE_JUMP, jump)
        return said

    def _gate(
        self, before: Observation, ds: Array, expected: Expectation, seen: Observation, blind: int
    ) -> list[Objection]:
        """The innovation against its covariance, see :class:`~torch_ekm.control.Guards`."""
        n_q, predicted = self.hand.n_q, expected.increment.numpy()
        # blind motions before this one left the pose as unsure as the model is
        share = NOISE.described * (1 + blind)
        way, turn = (math.sqrt(part @ part) for part in (predicted[-6:-3], predicted[-3:]))
        along, about = way + _LEVER * turn, turn + way / _LEVER
        size = np.array([abs(predicted[:n_q]).max()] * n_q + [along] * 3 + [about] * 3)
        sigma = np.sqrt(self._noise(before, seen) + (share * size) ** 2 + expected.deviation.numpy() ** 2)
        z = abs(ds - predicted) / sigma
        i = int(z.argmax())
        names = [f"joint '{name}' turned" for name in self.hand.joint_names]
        names += [f"the object {went} {axis}" for went in ("went along", "turned about") for axis in "xyz"]
        unit, scale = ("mm", 1e-3) if n_q <= i < n_q + 3 else ("deg", DEGREE)
        came, guess, std = ds[i] / scale, predicted[i] / scale, sigma[i] / scale
        odd = f"{names[i]} {came:.2f} {unit} where {guess:.2f} ± {std:.2f} {unit} were predicted "
        odd += f"(Guards.gate is {self.guards.gate:g})"
        return against(z[i] > self.guards.gate, StopReason.BLIND, odd, Effect.UNLEARNED)

    def _noise(self, before: Observation, seen: Observation) -> Array:
        """Variances of a measured increment ``(n_s,)``; of poses as stated, and no less than the guards'."""
        least = np.array(_pose_std(self.guards)) ** 2
        pose = 0 * least
        for cov in (stated(before), stated(seen)):
            pose += least if cov is None else np.maximum(np.nan_to_num(cov.diagonal().numpy()), least)
        return np.concatenate([np.full(self.hand.n_q, 2 * self.guards.joint_noise**2), pose])

    def share(self, before: Observation, seen: Observation, predicted: Tensor) -> tuple[float, float]:
        """How much of a predicted increment was made, and the size of that in standard deviations."""
        ds, wanted = seen.state.minus(before.state).numpy(), predicted.numpy()
        weighted = wanted / self._noise(before, seen)
        size = float(wanted @ weighted)
        return float(ds @ weighted) / max(size, 1e-12), math.sqrt(size)

    def pose_noise(self, seen: Observation, focus: FocusedPose) -> float:
        """Standard deviation of a pose in the focus, as a turn [rad]: as stated, or the guards'."""
        cov = stated(seen)
        if cov is None or not bool(torch.isfinite(cov).all()):
            cov = torch.diag(torch.tensor(_pose_std(self.guards)).double().square())
        M = focus.matrix
        return float((focus.tolerance_scale * (M @ cov @ M.mT).diagonal().clamp(min=0.0).sqrt()).max())

    def follow(self, before: Observation | None, seen: Observation) -> None:
        """Remember a reading, and how far the encoders went since joints and pose changed."""
        same, moved = self._same(seen), 0.0 if before is None else float((seen.a - before.a).abs().max())
        self._ways = [way + moved if one else 0.0 for way, one in zip(self._ways, same, strict=True)]
        if self._still is None or not torch.equal(seen.a, self._still.a):
            self._still = seen
        self._last = seen

    def _same(self, seen: Observation) -> tuple[bool, bool]:
        """Joints, and the pose, read what they read before, bit by bit."""
        last = self._last
        if last is None:
            return False, False
        stands = torch.equal(seen.position, last.position) and torch.equal(seen.rotation, last.rotation)
        return torch.equal(seen.q, last.q), stands


def _off_path(x: Array, way: Array) -> float:
    """Distance of a point from the line through the origin and waypoints ``(n, n_a)``."""
    start = np.vstack([0.0 * x, way[:-1]])
    along = way - start
    share = ((x - start) * along).sum(1) / np.maximum((along * along).sum(1), 1e-12)
    return float(np.linalg.norm(x - start - share.clip(0.0, 1.0)[:, None] * along, axis=1).min())


def agree(one: Observation, other: Observation, guards: Guards) -> bool:
    """Two readings of a hand at rest show the same."""
    ds = other.state.minus(one.state)
    noise = ds.new_tensor([guards.joint_noise] * len(one.q) + _pose_std(guards))
    return bool((ds.abs() <= _TWICE * guards.gate * noise).all())


def _pose_std(guards: Guards) -> list[float]:
    """Of a pose, where nothing better is stated [m, rad]."""
    return [guards.translation_noise] * 3 + [NOISE.rotation] * 3


def stated(seen: Observation) -> Tensor | None:
    """Covariance of its pose, as the plant states it."""
    return seen.info.get("estimate", {}).get("pose_covariance")
