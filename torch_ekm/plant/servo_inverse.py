from __future__ import annotations

from collections.abc import Callable

import torch

from .._arrays import as_tensors
from .._checks import check_finite, check_kind, check_shape
from ..description import HandDescription
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..typing import Float, Tensor
from .gate import Gate
from .observation import Observation
from .plant import Path, Plant, PlantWrapper


class ServoInverse(PlantWrapper):
    """A plant whose increments are what its encoders shall do: commands go through the inverse of the servos.

    Dead zone and bias of each servo are learned from every motion
    (:class:`~torch_ekm.kinematics.ServoModel`). What is learned of the hand is then free of them::

        plant = ServoInverse(SimulatedHand(hand, obj), hand)
        plant.command(delta_a)      # the encoders move by delta_a, as nearly as the servos can
        print(plant.servo)          # dead zones and biases with standard errors

    ``|v - w| <= servo.largest``, and v goes beyond the gate's increment only where w does: no estimate makes
    a command large. Along a path each motor is compensated in the direction in which it goes, and a piece
    that becomes longer takes longer. A loop that judges readings itself uses :meth:`send_path` and
    :meth:`learn`, so that nothing is learned from one that it refuses.

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
        self._start = torch.zeros(len(self.servo.names), dtype=torch.float64)
        self.sent = self._start[None]
        """v of the last motion [rad]; of a path, its last waypoint."""
        self._known = torch.ones(len(self.servo.names), dtype=torch.bool)  # motors that it has figures of

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the encoders by ``delta_a`` [rad], wait, read the sensors, learn of the servos.

        Set-points stay in the actuators' range.

        Raises:
            ShapeError, NonFiniteError: the increment is not ``n_a`` finite numbers; nothing moves.
            EKMError: see :meth:`Gate.command`.
        """
        (delta_a,), names = as_tensors(delta_a=delta_a), self.servo.names
        check_shape("delta_a", delta_a, (len(names),), f"in order: {', '.join(names)}")
        check_finite("delta_a", delta_a)
        start = self.gate.last or self.observe()
        v, _ = self._inverse(delta_a[None], start)
        self._start, self.sent, self._known = start.a, v, torch.ones_like(self._known)
        after = self.gate.command(v[0], start)
        self.learn(after)
        return after

    def follow(  # type: ignore[override]
        self, path: Path, watch: Callable[[Observation], bool]
    ) -> Observation:
        """Move the encoders through the waypoints, wait, read the sensors, learn of the servos.

        Raises:
            EKMError: see :meth:`Gate.follow`.
        """
        after = self.send_path(path, watch, self.gate.last or self.observe(), "user")
        self.learn(after)
        return after

    def send_path(
        self, path: Path, watch: Callable[[Observation], bool], start: Observation, by: str
    ) -> Observation:
        """The same from an accepted reading, and nothing is learned.

        Of a motor that turns round on the way, and of a path that ``watch`` ends, :meth:`learn` learns
        nothing: what a dead zone took of them is not seen at the end.
        """
        waypoints = check_kind("path", path, Path).waypoints
        check_shape("waypoints", waypoints[0], (len(self.servo.names),), "for each waypoint")
        v, last = self._inverse(waypoints, start)
        if not bool(v.isfinite().all()):
            self.gate.command(v[~v.isfinite().all(1)][0], start, by)  # refuses, and says why
        seconds = v.diff(dim=0, prepend=torch.zeros_like(v[:1])).abs().amax(1) / self.gate.speed
        sent = Path(v, torch.maximum(path.durations, seconds).cumsum(0))
        onward = last * waypoints[-1] > self.servo.resolution  # else it ends on its way back
        self._start, self.sent, self._known = start.a, v, onward | (last == 0)

        def look(seen: Observation) -> bool:
            goes_on = watch(seen)
            self._known = self._known & goes_on
            return goes_on

        return self.gate.follow(sent, look, start, by)

    def _inverse(self, waypoints: Tensor, start: Observation) -> tuple[Tensor, Tensor]:
        """Set-points for the waypoints ``(n, n_a)``, cut where they lie out of range and never turned round,
        and the sign of each motor's last motion, 0: none."""
        sent, sign, moved = [torch.zeros_like(waypoints[0])], torch.zeros_like(waypoints[0]), waypoints[0] * 0
        for w, piece in zip(waypoints, waypoints.diff(dim=0, prepend=waypoints[:1] * 0), strict=True):
            moves = (w - moved).abs() > self.servo.resolution
            sign, moved = torch.where(moves, (w - moved).sign(), sign), torch.where(moves, w, moved)
            added = (self.servo.command(sign) - sign).clamp(-self.servo.largest, self.servo.largest)
            most = piece.abs().clamp(min=self.gate.increment)
            sent.append(sent[-1] + (torch.where(sign != 0, w + added, 0.0) - sent[-1]).clamp(-most, most))
        lower, upper = (edge - start.a for edge in self._range)
        return torch.stack(sent[1:]).clamp(lower.clamp(max=0.0), upper.clamp(min=0.0)), sign

    def learn(self, after: Observation) -> None:
        """An accepted reading after the last motion."""
        start, v = self._start, self.sent[-1]
        self.servo.update(v, after.a - start, self._known & self._free(start, v, after.a))

    def _free(self, start: Tensor, v: Tensor, end: Tensor) -> Tensor:
        """Motions that no end of the range cut short, nor brought back into it: an end is not a dead zone."""
        lower, upper = self._range
        low, high = lower + self.servo.moved_from, upper - self.servo.moved_from
        free = (start > lower - self.servo.moved_from) & (start < upper + self.servo.moved_from)
        for a in (start + v, end):
            free &= ((a > low) | (v > 0)) & ((a < high) | (v < 0))
        return free
