from __future__ import annotations

import torch

from .._checks import check_finite, check_shape
from ..description import HandDescription
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..kinematics.tensors import as_tensors
from ..typing import Float, Tensor
from .gate import Gate
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

    ``|v - w| <= servo.largest``, and v goes beyond the gate's increment only where w does: no estimate makes
    a command large. A loop that judges readings itself uses :meth:`send` and :meth:`learn`, so that nothing
    is learned from one that it refuses.

    Args:
        plant: with encoders (``Observation.a``); one that is no :class:`Gate` gets one.
        hand: gives names and ranges of the actuators.
        servo: what is known of the servos; None: nothing yet. It belongs to the hand, not to an object: keep
            it from trial to trial (:class:`~torch_ekm.control.HandKnowledge`). With ideal servos commands
            are passed on as they are.
    """

    def __init__(
        self, plant: Plant, hand: HandDescription, servo: ServoModel | IdealServos | None = None
    ) -> None:
        self.gate = plant if isinstance(plant, Gate) else Gate(plant, hand)
        super().__init__(self.gate)
        self.servo = ServoModel(hand.actuator_names) if servo is None else servo
        self._range = [torch.from_numpy(edge) for edge in (hand.actuator_lower, hand.actuator_upper)]
        self._start = self.sent = torch.zeros(len(self.servo.names), dtype=torch.float64)
        """v of the last motion [rad]."""

    @property
    def stuck(self) -> tuple[str, ...]:
        """Actuators that do not move however they are commanded."""
        return tuple(n for n, s in zip(self.servo.names, self.servo.stuck.tolist(), strict=True) if s)

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the encoders by ``delta_a`` [rad], wait, read the sensors, learn of the servos.

        Set-points stay in the actuators' range.

        Raises:
            ShapeError, NonFiniteError: the increment is not ``n_a`` finite numbers; nothing moves.
            EKMError: see :meth:`Gate.command`.
        """
        after = self.send(delta_a, self.gate.last or self.observe(), "user")
        self.learn(after)
        return after

    def send(self, delta_a: Float[Tensor, " n_a"], start: Observation, by: str) -> Observation:
        """The same from an accepted reading, and nothing is learned; see :meth:`Gate.command`."""
        (delta_a,), names = as_tensors(delta_a=delta_a), self.servo.names
        check_shape("delta_a", delta_a, (len(names),), f"in order: {', '.join(names)}")
        check_finite("delta_a", delta_a)
        added = (self.servo.command(delta_a) - delta_a).clamp(-self.servo.largest, self.servo.largest)
        most = delta_a.abs().clamp(min=self.gate.increment)
        v = self._within_range(start.a, (delta_a + added).clamp(-most, most))
        self._start, self.sent = start.a, v
        return self.gate.command(v, start, by)

    def learn(self, after: Observation) -> None:
        """An accepted reading after the last motion."""
        start, v = self._start, self.sent
        self.servo.update(v, after.a - start, self._free(start, v, after.a))

    def _within_range(self, a: Tensor, v: Tensor) -> Tensor:
        """v, cut where ``a + v`` would lie outside; it is never turned round."""
        lower, upper = self._range
        up, down = (upper - a).clamp(min=0.0), (lower - a).clamp(max=0.0)
        return v.clamp(down, up)

    def _free(self, start: Tensor, v: Tensor, end: Tensor) -> Tensor:
        """Motions that no end of the range cut short, nor brought back into it: an end is not a dead zone."""
        lower, upper = self._range
        low, high = lower + self.servo.moved_from, upper - self.servo.moved_from
        free = (start > lower - self.servo.moved_from) & (start < upper + self.servo.moved_from)
        for a in (start + v, end):
            free &= ((a > low) | (v > 0)) & ((a < high) | (v < 0))
        return free
