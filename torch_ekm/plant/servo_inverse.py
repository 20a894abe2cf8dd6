from __future__ import annotations

from typing import Any

import torch

from .._checks import check_finite, check_shape
from ..description import HandDescription
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..typing import Float, Tensor
from .observation import Observation
from .plant import Plant
from .wrapper import PlantWrapper


class ServoInverse(PlantWrapper):
    """A plant whose increments are what its encoders shall do: commands go through the inverse of the servos.

    Dead zone and bias of each servo are learned from every motion
    (:class:`~torch_ekm.kinematics.ServoModel`). What is learned of the hand is then free of them::

        plant = ServoInverse(SimulatedHand(hand, obj), hand)
        plant.command(delta_a)      # the encoders move by delta_a, as nearly as the servos can
        print(plant.servo)          # dead zones and biases with standard errors

    Args:
        plant: with encoders (``Observation.a``).
        hand: gives names and ranges of the actuators.
        servo: what is known of the servos; None: nothing yet. It belongs to the hand, not to an object: keep
            it from trial to trial (:class:`~torch_ekm.control.HandKnowledge`). With ideal servos commands
            are passed on as they are.
    """

    def __init__(
        self, plant: Plant, hand: HandDescription, servo: ServoModel | IdealServos | None = None
    ) -> None:
        super().__init__(plant)
        self.servo = ServoModel(hand.actuator_names) if servo is None else servo
        self._range = [torch.from_numpy(edge) for edge in (hand.actuator_lower, hand.actuator_upper)]
        self._seen: Observation | None = None
        self._motion: tuple[Tensor, Tensor, dict[str, Any]] | None = None

    @property
    def stuck(self) -> tuple[str, ...]:
        """Actuators that do not move however they are commanded."""
        return tuple(n for n, s in zip(self.servo.names, self.servo.stuck.tolist(), strict=True) if s)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the encoders by ``delta_a`` [rad], wait, read the sensors, learn of the servos.

        Set-points stay in the actuators' range.

        Raises:
            ShapeError, NonFiniteError: the increment is not ``n_a`` finite numbers; nothing moves.
        """
        delta_a, names = torch.as_tensor(delta_a), self.servo.names
        check_shape("delta_a", delta_a, (len(names),), f"in order: {', '.join(names)}")
        check_finite("delta_a", delta_a)
        seen = self.observe() if self._seen is None else self._seen
        v = self._within_range(seen.a, self.servo.command(delta_a))
        after = super().command(v)
        before = {name: value.clone() for name, value in self.servo.named_buffers()}
        self._motion = seen.a, v, before
        self._learn(after)
        return after

    def _within_range(self, a: Tensor, v: Tensor) -> Tensor:
        """v, cut where ``a + v`` would lie outside; it is never turned round."""
        lower, upper = self._range
        up, down = (upper - a).clamp(min=0.0), (lower - a).clamp(max=0.0)
        return v.clamp(down, up)

    def correct(self, after: Observation | None) -> None:
        """What was learned of the last motion is taken back; it is learned again from ``after``, if any.

        Of a motion without any encoder reading that can be believed nothing is learned.
        """
        if self._motion is None:
            return
        for name, value in self.servo.named_buffers():
            value.copy_(self._motion[2][name])
        if after is not None:
            self._learn(after)

    def _learn(self, after: Observation) -> None:
        assert self._motion is not None
        start, v, _ = self._motion
        self.servo.update(v, after.a - start, self._free(start, v, after.a))

    def _free(self, start: Tensor, v: Tensor, end: Tensor) -> Tensor:
        """Motions that no end of the range cut short, nor brought back into it: an end is not a dead zone."""
        lower, upper = self._range
        low, high = lower + self.servo.moved_from, upper - self.servo.moved_from
        free = (start > lower - self.servo.moved_from) & (start < upper + self.servo.moved_from)
        for a in (start + v, end):
            free &= ((a > low) | (v > 0)) & ((a < high) | (v < 0))
        return free

    def observation(self, seen: Observation) -> Observation:
        """Remembered as the start of the next motion."""
        self._seen = seen
        return seen
