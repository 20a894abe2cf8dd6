"""What speaks against a reading: age, range, jumps, and its innovation against the covariance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ...plant import Observation, PlantStatus
from ...typing import Array, Tensor
from ..decision import Expectation, StopReason
from .fingertips import hold
from .safety import Guards, Objection

if TYPE_CHECKING:
    from ...description import HandDescription
    from ..focus import FocusedPose

_DEG = math.pi / 180
_NAMES = ("the encoders' reading", "the joints' reading", "the object's pose")
_AGAINST = -0.5  # share of a command that the encoders made, from which they went the other way
_LEVER = 0.03  # [m] a rotation that is predicted wrong carries the object's point so much


class ReadingTests:
    """Tests of readings against :class:`~torch_ekm.control.Guards`.

    Args:
        guards: limits.
        hand: gives names and ranges of encoders and joints.
    """

    def __init__(self, guards: Guards, hand: HandDescription) -> None:
        self.guards, self.hand = guards, hand
        self._raw: Observation | None = None
        self._still: Observation | None = None  # since which the encoders read the same, bit by bit
        self._path = {"joints": 0.0, "pose": 0.0}
        self._limits = [
            ("encoder", hand.actuator_names, hand.actuator_lower, hand.actuator_upper),
            ("joint", hand.joint_names, hand.joint_lower, hand.joint_upper),
        ]

    def at_rest(self, seen: Observation, before: Observation | None = None) -> Objection | None:
        """Of a reading without a motion since ``before``."""
        doubt = self._age(seen) or self.motors(before, None, seen)
        if before is None or doubt is not None:
            return doubt
        if before.dated and seen.time < before.time:
            message = f"the clock went back from {before.time:.3f} to {seen.time:.3f} s: check the driver"
            return Objection(StopReason.STALE_SENSOR, message)
        ds = seen.state.minus(before.state).numpy()
        return self._jump(ds, 0 * ds, seen)

    def motors(self, before: Observation | None, sent: Tensor | None, seen: Observation) -> Objection | None:
        """Ranges, and encoders after the motors were sent by ``sent`` [rad]; None: nowhere."""
        doubt = self._range(seen)
        if before is None or doubt is not None:
            return doubt
        if sent is None:
            return self._encoders(before, 0 * seen.a, seen, self.guards.unchanged)
        return self._encoders(before, sent, seen) or self._against(before, sent, seen)

    def after_motion(
        self,
        before: Observation,
        sent: Tensor,
        seen: Observation,
        expected: Expectation | None,
        blind: int,
    ) -> Objection | None:
        """Of a reading after the motors were sent by ``sent`` [rad], the worst first; ``blind`` motions
        without a pose came before."""
        doubt = self._age(seen, before)
        if doubt is None or doubt.blind:  # the camera alone: the rest is still looked at
            doubt = self.motors(before, sent, seen) or self._speed(before, seen) or doubt
        if expected is None or (doubt is not None and not doubt.blind):
            return doubt
        ds, predicted = seen.state.minus(before.state).numpy(), expected.increment.numpy()
        if doubt is not None:  # blind: the joints are still looked at
            ds[-6:] = predicted[-6:]
            return self._jump(ds, predicted, seen) or doubt
        return self._jump(ds, predicted, seen) or self._gate(before, ds, expected, seen, blind)

    def _age(self, seen: Observation, before: Observation | None = None) -> Objection | None:
        """Stale, repeated or missing readings."""
        taken, repeats = seen.taken, self._repeats(seen, before)
        if before is not None and torch.equal(seen.a, before.a):
            if all(self._same(seen).values()):
                message = "encoders, joints and pose are the same bit by bit after a motion: check the driver"
                return Objection(StopReason.STALE_SENSOR, message)
            if self._still is not None and self._hand_moved(self._still, seen):
                message = "encoders are the same bit by bit while joints and object moved: check their driver"
                return Objection(StopReason.STALE_SENSOR, message)
        for k, sensor in enumerate(taken._fields[:3]):  # fingertips: another reading stands in
            age, oldest = seen.time - taken[k], self.guards.max_age[k]
            problem = ""
            if before is not None and sensor == "pose" and seen.status is PlantStatus.NOT_SEEN:
                message = "the camera does not find the object: clear its view, or light it"
                return Objection(StopReason.BLIND, message, blind=True)
            if sensor in repeats:
                problem = f"is the same bit by bit while the encoders moved {deg(repeats[sensor])}"
            elif not seen.dated:
                continue
            elif before is not None and before.dated and taken[k] <= before.time:
                problem = f"was read at {taken[k]:.3f} s, before the motion that began at {before.time:.3f} s"
            elif abs(age) > oldest:
                problem = f"is {age:.3f} s old, Guards.max_age is {oldest:g} s"
            if problem:
                message = f"{_NAMES[k]} {problem}: check its driver or its time stamps"
                return Objection(
                    StopReason.STALE_SENSOR, message, blind=sensor == "pose" and before is not None
                )
        return None

    def _hand_moved(self, one: Observation, other: Observation) -> bool:
        """More than noise, and not the object alone, which may have slid."""
        joint = float((other.q - one.q).abs().max())
        return joint > math.sqrt(2) * self.guards.joint_noise and not agree(one, other, self.guards)

    def _repeats(self, seen: Observation, before: Observation | None) -> dict[str, float]:
        """Sensors that stand still bit by bit, and how far the encoders went meanwhile [rad]."""
        if before is None:
            return {}
        same = self._same(seen)
        if not any(same.values()):
            return {}
        moved = float((seen.a - before.a).abs().max())
        path = {sensor: way + moved for sensor, way in self._path.items() if same[sensor]}
        return {sensor: way for sensor, way in path.items() if way > self.guards.unchanged}

    def _range(self, seen: Observation) -> Objection | None:
        for (what, names, lower, upper), value in zip(self._limits, (seen.a, seen.q), strict=True):
            value = value.detach().cpu().double().numpy()
            beyond = (lower - value).clip(min=value - upper)
            i = int(beyond.argmax())
            if beyond[i] > self.guards.beyond:
                message = (
                    f"{what} '{names[i]}' reads {deg(value[i])}, its range is {deg(lower[i])} "
                    f"to {deg(upper[i])} (Guards.beyond is {deg(self.guards.beyond)}): check it"
                )
                return Objection(StopReason.OUT_OF_RANGE, message)
        return None

    def _encoders(
        self, before: Observation, sent: Tensor, seen: Observation, limit: float | None = None
    ) -> Objection | None:
        """An encoder that went further than it was sent, or back."""
        moved, v, limit = (seen.a - before.a).numpy(), sent.numpy(), limit or self.guards.encoder_jump
        away = np.maximum(np.minimum(v, 0) - moved, moved - np.maximum(v, 0))
        i, names = int(away.argmax()), self.hand.actuator_names
        if away[i] > limit:
            message = (
                f"encoder '{names[i]}' went {deg(moved[i])} where {deg(v[i])} were commanded "
                f"({deg(limit)} more are allowed, Guards.encoder_jump): check its cable and zero"
            )
            return Objection(StopReason.ENCODER_JUMP, message)
        return None

    def _against(self, before: Observation, sent: Tensor, seen: Observation) -> Objection | None:
        """Encoders that went the other way."""
        moved, v = (seen.a - before.a).numpy(), sent.numpy()
        share, i = float(moved @ v) / max(float(v @ v), 1e-12), int((moved * v).argmin())
        if abs(v).max() < self.guards.unchanged or share > _AGAINST:
            return None
        message = (
            f"encoders made {share:.1f} of the motion that was commanded (limit {_AGAINST:g}): "
            f"'{self.hand.actuator_names[i]}' went {deg(moved[i])} where {deg(v[i])} were: a sign of the "
            "motors or of their encoders is wrong; see 'torch-ekm check --plant'"
        )
        return Objection(StopReason.WRONG_WAY, message)

    def _speed(self, before: Observation, seen: Observation) -> Objection | None:
        moved, names = (seen.a - before.a).numpy(), self.hand.actuator_names
        seconds, i = seen.taken.encoders - before.taken.encoders, int(abs(moved).argmax())
        if seen.dated and before.dated and abs(moved[i]) > self.guards.speed * max(seconds, 0.0):
            message = (
                f"encoder '{names[i]}' went {deg(moved[i])} in {seconds:.3g} s (Guards.speed is "
                f"{deg(self.guards.speed)}/s): the driver must wait for the end of a motion, and date it"
            )
            return Objection(StopReason.SPEED_CEILING, message)
        return None

    def _jump(self, ds: Array, predicted: Array, seen: Observation) -> Objection | None:
        """What no motion does."""
        guards, n_q = self.guards, self.hand.n_q
        off = ds - predicted
        i = int(abs(off[:n_q]).argmax())
        if abs(off[i]) > guards.joint_jump:
            message = (
                f"joint '{self.hand.joint_names[i]}' turned {deg(ds[i])} where {deg(predicted[i])} "
                f"were predicted (Guards.joint_jump is {deg(guards.joint_jump)}): check its sensor"
            )
            return Objection(StopReason.JOINT_JUMP, message)
        way, turn = (math.sqrt(part @ part) for part in (off[-6:-3], off[-3:]))
        if (way > guards.translation_jump or turn > guards.rotation_jump) and hold(seen):
            message = (
                f"the pose is {1e3 * way:.1f} mm and {deg(turn)} away from what was predicted, while "
                f"the fingertips hold the object (Guards allow jumps of {1e3 * guards.translation_jump:g} mm "
                f"and {deg(guards.rotation_jump)}): check camera and markers"
            )
            return Objection(StopReason.POSE_JUMP, message)
        return None

    def _gate(
        self, before: Observation, ds: Array, expected: Expectation, seen: Observation, blind: int
    ) -> Objection | None:
        """The innovation against its covariance."""
        sigma, predicted = self._deviation(before, expected, seen, blind), expected.increment.numpy()
        z, n_q = abs(ds - predicted) / sigma, self.hand.n_q
        i = int(z.argmax())
        if z[i] <= self.guards.gate:
            return None
        if i < n_q:
            what, unit, name = f"joint '{self.hand.joint_names[i]}' turned", _DEG, "deg"
        elif i < n_q + 3:
            what, unit, name = f"the object went along {'xyz'[i - n_q]}", 1e-3, "mm"
        else:
            what, unit, name = f"the object turned about {'xyz'[i - n_q - 3]}", _DEG, "deg"
        message = (
            f"{what} {float(ds[i]) / unit:.2f} {name} where {float(predicted[i]) / unit:.2f} ± "
            f"{float(sigma[i]) / unit:.2f} {name} were predicted (Guards.gate is {self.guards.gate:g})"
        )
        return Objection(StopReason.BLIND, message, gated=True)

    def _deviation(self, before: Observation, expected: Expectation, seen: Observation, blind: int) -> Array:
        """sigma of each entry of an increment, see :class:`~torch_ekm.control.Guards`."""
        guards, n_q, predicted = self.guards, self.hand.n_q, expected.increment.numpy()
        variance = self._noise(before, seen)
        # blind motions before this one left the pose as unsure as the model is
        share = guards.relative * (1 + blind)
        way, turn = (math.sqrt(part @ part) for part in (predicted[-6:-3], predicted[-3:]))
        along, about = way + _LEVER * turn, turn + way / _LEVER
        size = np.array([abs(predicted[:n_q]).max()] * n_q + [along] * 3 + [about] * 3)
        return np.sqrt(variance + (share * size) ** 2 + expected.deviation.numpy() ** 2)

    def _noise(self, before: Observation, seen: Observation) -> Array:
        """Variances of a measured increment ``(n_s,)``."""
        joints = np.full(self.hand.n_q, 2 * self.guards.joint_noise**2)
        return np.concatenate([joints, self._stated(before) + self._stated(seen)])

    def share(self, before: Observation, seen: Observation, predicted: Tensor) -> tuple[float, float]:
        """How much of a predicted increment was made, and the size of that in standard deviations."""
        ds, wanted = seen.state.minus(before.state).numpy(), predicted.numpy()
        weighted = wanted / self._noise(before, seen)
        size = float(wanted @ weighted)
        return float(ds @ weighted) / max(size, 1e-12), math.sqrt(size)

    def pose_noise(self, seen: Observation, focus: FocusedPose) -> float:
        """Standard deviation of a pose in the focus, as a turn [rad]: as stated, or the guards'."""
        unit = torch.tensor([self.guards.translation_noise] * 3 + [self.guards.rotation_noise] * 3).double()
        cov = seen.info.get("estimate", {}).get("pose_covariance")
        if cov is None or not bool(torch.isfinite(cov).all()):
            cov = torch.diag(unit.square())
        M = focus.matrix
        return float((focus.tolerance_scale * (M @ cov @ M.mT).diagonal().clamp(min=0.0).sqrt()).max())

    def _stated(self, reading: Observation) -> Array:
        """Variances of a pose ``(6,)``: as stated, and no less than what the guards allow."""
        o, R = self.guards.translation_noise**2, self.guards.rotation_noise**2
        least = np.array([o, o, o, R, R, R])
        stated = reading.info.get("estimate", {}).get("pose_covariance")
        if stated is None:
            return least
        return np.maximum(np.nan_to_num(stated.diagonal().numpy()), least)

    def follow(self, before: Observation | None, seen: Observation) -> None:
        """Remember a reading, and how far the encoders went since joints and pose changed."""
        same, moved = self._same(seen), 0.0 if before is None else float((seen.a - before.a).abs().max())
        self._path = {sensor: way + moved if same[sensor] else 0.0 for sensor, way in self._path.items()}
        if self._still is None or not torch.equal(seen.a, self._still.a):
            self._still = seen
        self._raw = seen

    def _same(self, seen: Observation) -> dict[str, bool]:
        """Sensors that read what they read before, bit by bit."""
        last = self._raw
        if last is None:
            return {"joints": False, "pose": False}
        stands = torch.equal(seen.position, last.position) and torch.equal(seen.rotation, last.rotation)
        return {"joints": torch.equal(seen.q, last.q), "pose": stands}


def deg(angle: Any) -> str:
    """An angle [rad] as a text in degrees."""
    return f"{float(angle) / _DEG:.3g} deg"


def agree(one: Observation, other: Observation, guards: Guards) -> bool:
    """Two readings of a hand at rest show the same."""
    ds = other.state.minus(one.state)
    noise = [guards.joint_noise] * len(one.q) + [guards.translation_noise] * 3 + [guards.rotation_noise] * 3
    return bool((ds.abs() <= math.sqrt(2) * guards.gate * ds.new_tensor(noise)).all())
