"""What speaks against one reading: age, range, jumps, and its innovation against the covariance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..._noise import DEGREE, NOISE
from ...plant import Observation, PlantStatus
from ...typing import Array, Tensor
from ..decision import Expectation
from .guards import Effect, Guards, Objection, check, gravest

if TYPE_CHECKING:
    from ...description import HandDescription
    from ..focus import FocusedPose

_SENSORS = {
    "encoders": "the encoders' reading", "joints": "the joints' reading", "pose": "the object's pose",
}  # fmt: skip
AGAINST = 0.3  # share of a motion that is made the other way; healthy hands make .4 of it and more
_LEVER = 0.03  # [m] a rotation that is predicted wrong carries the object's point so much


class ReadingTests:
    """Tests of readings against :class:`~torch_ekm.control.Guards`.

    Args:
        guards: limits.
        hand: gives names and ranges of encoders and joints.
    """

    def __init__(self, guards: Guards, hand: HandDescription) -> None:
        self.guards, self.hand = guards, hand
        self._last: Observation | None = None
        self._still: Observation | None = None  # since which the encoders read the same, bit by bit
        self._path = {"joints": 0.0, "pose": 0.0}  # way of the encoders since these read something else

    def at_rest(self, seen: Observation, before: Observation | None = None) -> Objection | None:
        """Of a reading without a motion since ``before``."""
        said = [*self._ages(seen, None), *self._motors(before, None, seen)]
        if before is not None:
            back = before.time - seen.time if before.dated else 0.0
            said += check("clock", back, 0.0, began=before.time, time=seen.time)
            ds = seen.state.minus(before.state).numpy()
            said += self._jumps(ds, 0 * ds, seen)
        return gravest(said)

    def motors(self, before: Observation | None, sent: Tensor | None, seen: Observation) -> Objection | None:
        """Ranges, and encoders after the motors were sent by ``sent`` [rad]; None: nowhere."""
        return gravest(self._motors(before, sent, seen))

    def after_motion(
        self,
        before: Observation,
        sent: Tensor,
        seen: Observation,
        expected: Expectation | None,
        blind: int,
    ) -> Objection | None:
        """Of a reading after the motors were sent by ``sent`` [rad], the gravest; ``blind`` motions without a
        pose came before."""
        said = self._ages(seen, before)
        unseen = bool(said)  # the rest is still looked at
        said += [*self._motors(before, sent, seen), *self._speed(before, seen)]
        if expected is not None:
            ds, predicted = seen.state.minus(before.state).numpy(), expected.increment.numpy()
            said += self._jumps(ds, predicted, seen, unseen)
            said += [] if unseen else self._gate(before, ds, expected, seen, blind)
        return gravest(said)

    def _ages(self, seen: Observation, before: Observation | None) -> list[Objection]:
        """Stale, repeated or missing readings; of fingertips another reading stands in."""
        said, same, moved = [], self._same(seen), 0.0
        if before is not None:
            moved = float((seen.a - before.a).abs().max())
            if moved == 0:
                said += check("all repeat", all(same.values()), 0)
                said += check(
                    "encoders repeat", self._still is not None and self._moved(self._still, seen), 0
                )
            said += check("not seen", seen.status is PlantStatus.NOT_SEEN, 0)
        for k, (sensor, what) in enumerate(_SENSORS.items()):
            way = self._path[sensor] + moved if before is not None and same.get(sensor) else 0.0
            found = check("repeats", way, self.guards.unchanged, {"way": way}, what=what)
            if seen.dated:
                taken, age = seen.taken[k], seen.time - seen.taken[k]
                if before is not None and before.dated:
                    late = taken <= before.time
                    found += check("before", late, 0, what=what, taken=taken, began=before.time)
                found += check("age", abs(age), self.guards.max_age[k], what=what, age=age)
            if sensor == "pose" and before is not None:
                found = [one._replace(effect=Effect.BLIND) for one in found]
            said += found
        return said

    def _moved(self, one: Observation, other: Observation) -> bool:
        """More than noise, and not the object alone, which may have slid."""
        joint = float((other.q - one.q).abs().max())
        return joint > math.sqrt(2) * self.guards.joint_noise and not agree(one, other, self.guards)

    def _motors(self, before: Observation | None, sent: Tensor | None, seen: Observation) -> list[Objection]:
        hand, guards, said = self.hand, self.guards, []
        for what, names, lower, upper, value in (
            ("encoder", hand.actuator_names, hand.actuator_lower, hand.actuator_upper, seen.a),
            ("joint", hand.joint_names, hand.joint_lower, hand.joint_upper, seen.q),
        ):
            read = value.detach().cpu().double().numpy()
            beyond = (lower - read).clip(min=read - upper)
            i = int(beyond.argmax())
            angles = {"angle": read[i], "lower": lower[i], "upper": upper[i], "most": guards.beyond}
            said += check("range", beyond[i], guards.beyond, angles, what=what, name=names[i])
        if before is None:
            return said
        moved, v = (seen.a - before.a).numpy(), np.zeros(len(seen.a)) if sent is None else sent.numpy()
        most = guards.unchanged if sent is None else guards.encoder_jump
        away = np.maximum(np.minimum(v, 0) - moved, moved - np.maximum(v, 0))  # further than sent, or back
        i = int(away.argmax())
        angles = {"went": moved[i], "sent": v[i], "most": most}
        said += check("encoder jump", away[i], most, angles, name=hand.actuator_names[i])
        if abs(v).max() >= guards.unchanged:
            share, i = float(moved @ v) / float(v @ v), int((moved * v).argmin())
            angles, name = {"went": moved[i], "sent": v[i]}, hand.actuator_names[i]
            said += check("encoders against", -share, AGAINST, angles, share=share, name=name)
        return said

    def _speed(self, before: Observation, seen: Observation) -> list[Objection]:
        if not (seen.dated and before.dated):
            return []
        moved, most = (seen.a - before.a).numpy(), self.guards.speed
        seconds, i = seen.taken.encoders - before.taken.encoders, int(abs(moved).argmax())
        angles, name = {"went": moved[i], "most": most}, self.hand.actuator_names[i]
        return check("speed", abs(moved[i]), most * max(seconds, 0.0), angles, name=name, seconds=seconds)

    def _jumps(self, ds: Array, predicted: Array, seen: Observation, unseen: bool = False) -> list[Objection]:
        """What no motion does; of a pose that is not seen: nothing."""
        guards, off, n_q = self.guards, ds - predicted, self.hand.n_q
        i = int(abs(off[:n_q]).argmax())
        angles = {"turned": ds[i], "predicted": predicted[i], "most": guards.joint_jump}
        said = check("joint jump", abs(off[i]), guards.joint_jump, angles, name=self.hand.joint_names[i])
        if not unseen and hold(seen):
            way, turn = (math.sqrt(part @ part) for part in (off[-6:-3], off[-3:]))
            share = max(way / guards.translation_jump, turn / guards.rotation_jump)
            angles, most = {"turn": turn, "most": guards.rotation_jump}, 1e3 * guards.translation_jump
            said += check("pose jump", share, 1.0, angles, way=1e3 * way, most_way=most)
        return said

    def _gate(
        self, before: Observation, ds: Array, expected: Expectation, seen: Observation, blind: int
    ) -> list[Objection]:
        """The innovation against its covariance, see :class:`~torch_ekm.control.Guards`."""
        guards, n_q, predicted = self.guards, self.hand.n_q, expected.increment.numpy()
        # blind motions before this one left the pose as unsure as the model is
        share = guards.relative * (1 + blind)
        way, turn = (math.sqrt(part @ part) for part in (predicted[-6:-3], predicted[-3:]))
        along, about = way + _LEVER * turn, turn + way / _LEVER
        size = np.array([abs(predicted[:n_q]).max()] * n_q + [along] * 3 + [about] * 3)
        sigma = np.sqrt(self._noise(before, seen) + (share * size) ** 2 + expected.deviation.numpy() ** 2)
        z = abs(ds - predicted) / sigma
        i = int(z.argmax())
        names = [f"joint '{name}' turned" for name in self.hand.joint_names]
        names += [f"the object {went} {axis}" for went in ("went along", "turned about") for axis in "xyz"]
        unit, scale = ("mm", 1e-3) if n_q <= i < n_q + 3 else ("deg", DEGREE)
        words = {"came": ds[i] / scale, "predicted": predicted[i] / scale, "sigma": sigma[i] / scale}
        return check("gate", z[i], guards.gate, what=names[i], unit=unit, **words)

    def _noise(self, before: Observation, seen: Observation) -> Array:
        """Variances of a measured increment ``(n_s,)``; of poses as stated, and no less than the guards'."""
        least = np.array([self.guards.translation_noise**2] * 3 + [self.guards.rotation_noise**2] * 3)
        pose = 0 * least
        for cov in (_stated(before), _stated(seen)):
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
        cov = _stated(seen)
        if cov is None or not bool(torch.isfinite(cov).all()):
            std = [self.guards.translation_noise] * 3 + [self.guards.rotation_noise] * 3
            cov = torch.diag(torch.tensor(std).double().square())
        M = focus.matrix
        return float((focus.tolerance_scale * (M @ cov @ M.mT).diagonal().clamp(min=0.0).sqrt()).max())

    def follow(self, before: Observation | None, seen: Observation) -> None:
        """Remember a reading, and how far the encoders went since joints and pose changed."""
        same, moved = self._same(seen), 0.0 if before is None else float((seen.a - before.a).abs().max())
        self._path = {sensor: way + moved if same[sensor] else 0.0 for sensor, way in self._path.items()}
        if self._still is None or not torch.equal(seen.a, self._still.a):
            self._still = seen
        self._last = seen

    def _same(self, seen: Observation) -> dict[str, bool]:
        """Sensors that read what they read before, bit by bit."""
        last = self._last
        if last is None:
            return {"joints": False, "pose": False}
        stands = torch.equal(seen.position, last.position) and torch.equal(seen.rotation, last.rotation)
        return {"joints": torch.equal(seen.q, last.q), "pose": stands}


def hold(seen: Observation) -> bool:
    """Two fingertips at least measure a force: an object is between them."""
    return seen.fingertip_force is not None and int((seen.fingertip_force > NOISE.pressing).sum()) > 1


def agree(one: Observation, other: Observation, guards: Guards) -> bool:
    """Two readings of a hand at rest show the same."""
    ds = other.state.minus(one.state)
    noise = [guards.joint_noise] * len(one.q) + [guards.translation_noise] * 3 + [guards.rotation_noise] * 3
    return bool((ds.abs() <= math.sqrt(2) * guards.gate * ds.new_tensor(noise)).all())


def _stated(seen: Observation) -> Tensor | None:
    """Covariance of its pose, as the plant states it."""
    return seen.info.get("estimate", {}).get("pose_covariance")
