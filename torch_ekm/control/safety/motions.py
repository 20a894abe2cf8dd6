"""What a motion shows of the sensors: each reading may be true alone, and together they cannot be."""

from __future__ import annotations

import contextlib
import math

import torch

from ..._noise import DEGREE, NOISE
from ...exceptions import GraspError
from ...model import KinematicModel
from ...plant import Observation
from ...typing import Array, Tensor
from ..decision import Expectation, StopReason
from .guards import Effect, Objection, against, deg
from .readings import CHECK_PLANT, ReadingTests

_NOWHERE = 0.5 * DEGREE  # an encoder moves less in a motion in which its motor is sent nowhere
_AGAINST = 0.3  # share of a motion that is made the other way; healthy hands make .4 of it and more
_OFFSETS = torch.arange(-8.0, 8.1, 0.5, dtype=torch.float64) * DEGREE  # of all joints, that are tried
_GAP = 2e-3  # [m] of a pad from the object, from which it is suspicious
_MAGNET = "it drifts, or slips; check its magnet and cable"


class MotionTests:
    """Encoders against commands and joints, joints and object against encoders, joints against the object's
    surface; of one manipulation."""

    def __init__(self, readings: ReadingTests, model: KinematicModel) -> None:
        self.guards, self.readings, self.hand, self.model = readings.guards, readings, model.hand, model
        self._begun: Observation | None = None
        self._moves = torch.from_numpy(self.hand.joint_upper > self.hand.joint_lower)

    def begin(self, seen: Observation) -> None:
        """The reading before the first motion."""
        self._begun = seen

    def after(
        self, before: Observation, sent: Tensor, seen: Observation, expected: Expectation | None
    ) -> list[Objection]:
        """Encoders that drift, and joints and object that go another way than the encoders."""
        names, moved = self.hand.actuator_names, (seen.a - before.a).where((sent == 0).all(0), 0.0)
        i = int(moved.abs().argmax())
        drifts = f"encoder '{names[i]}' went {deg(moved[i])} though its motor was sent nowhere (limit "
        drifts += f"{deg(_NOWHERE)}): {_MAGNET}"
        reason, wrong = StopReason.ENCODER_DRIFT, float(moved[i].abs()) > _NOWHERE
        said = against(wrong, reason, drifts, Effect.LIES, running=3)
        if expected is None:
            return said
        share, sharp = self.readings.share(before, seen, expected.nominal)
        back = f"joints and object made {share:.1f} of the motion that the encoders' motion predicts (limit "
        back += f"-{_AGAINST:g}): a sign of motors, encoders or joints is wrong, or the pose's frame; "
        back += CHECK_PLANT
        wrong = -share > _AGAINST and sharp >= self.guards.gate
        return said + against(wrong, StopReason.WRONG_WAY, back, Effect.UNLEARNED, running=2)

    @property
    def agreed(self) -> bool:
        """Joints, pads and object did, before the first motion."""
        return self._begun is not None and self.on_surface(self._begun)

    def suspects(self, seen: Observation) -> str:
        """Which sensors contradict each other where the model refuses a state."""
        away = ", ".join(name for name, gap in self._gaps(seen).items() if gap > _GAP)
        off = f"fingertips press ({away}) where pose and joints have them off its surface (limit "
        found = "; ".join(filter(None, (self._differs(seen), away and f"{off}{1e3 * _GAP:g} mm)")))
        return found and f"{found}: check these sensors, the joints' zero, and the pose"

    def _differs(self, seen: Observation) -> str:
        """Which encoder and its joints have come apart since the beginning, farther than tendons stretch and
        moment arms that are not as described explain; empty: none."""
        hand = self.hand
        off, way = self._stretch(seen), seen.a.numpy() - hand.actuator_offset
        if self._begun is not None and not torch.equal(self._begun.a, seen.a):
            off, way = off - self._stretch(self._begun), (seen.a - self._begun.a).numpy()
        most = NOISE.outlier * NOISE.encoder + NOISE.arm * abs(way)
        i = int((abs(off) - most).argmax())
        if abs(off[i]) <= most[i]:
            return ""
        joints = zip(hand.joint_names, hand.actuation_jacobian[i], strict=True)
        names = ", ".join(name for name, arm in joints if arm)
        apart = f"encoder '{hand.actuator_names[i]}' and its joints ({names}) differ by {deg(off[i])}"
        return f"{apart} (limit {deg(most[i])})"

    def _stretch(self, seen: Observation) -> Array:
        """``a - a_0 - l(q)`` [rad]."""
        return seen.a.numpy() - self.hand.unloaded(seen.q.numpy())

    def closest(self, seen: Observation) -> float:
        """How far the pads that press are from the surface, rms, if all joints are off by what brings them
        closest [m]; infinite: fewer than two press."""
        tried = [list(self._gaps(seen, float(c)).values()) for c in _OFFSETS]
        return min(math.hypot(*gaps) / math.sqrt(len(gaps)) if len(gaps) > 1 else math.inf for gaps in tried)

    def on_surface(self, seen: Observation) -> bool:
        """The pads that press lie on the object, as joints and pose have them."""
        gaps = self._gaps(seen)
        return len(gaps) > 1 and max(gaps.values()) <= _GAP

    def _gaps(self, seen: Observation, offset: float = 0.0) -> dict[str, float]:
        """Distance of each pad that presses, or else is near, from the object [m], if all joints were off by
        an angle [rad]; infinite: far."""
        gaps: dict[str, float] = {}
        with contextlib.suppress(GraspError):
            near = self.model.detector(seen.q + offset * self._moves, seen.position, seen.rotation)
            gaps = dict(zip(near.finger, near.gap.abs().tolist(), strict=True))
        if seen.fingertip_force is None:
            return gaps
        return {name: gaps.get(name, math.inf) for name in self.model.pressing(seen.fingertip_force)}
