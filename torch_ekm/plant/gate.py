"""What stands before the motors: the last gate, the only way to them, and the inverse of the servos."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

import torch

from .._arrays import as_tensors
from .._checks import check_finite, check_kind, check_shape
from ..description import HandDescription
from ..exceptions import CommandRefusedError, ParameterError, PlantInUseError
from ..kinematics import ServoModel
from ..kinematics.servo_model import IdealServos
from ..typing import Float, Tensor
from .plant import Observation, Path, Plant, PlantWrapper, can_follow, readable

_DEG = math.pi / 180
_ROUNDED = 1e-9  # [rad] of a limit: sums of floats
_ASTRAY = 2 * _DEG  # [rad] that a motor may end farther from its goal than it was
_OWNERS: dict[int, Gate] = {}  # of plants, by the identity of the innermost one
_OWNING = threading.Lock()


class Gate(PlantWrapper):
    """A plant that is sent nothing but::

        v finite,  |v_i| <= increment,  min(lower_i, a_i) <= a_i + v_i <= max(upper_i, a_i),
        sum |v|_max over any time t <= increment + speed t

    a is an encoder reading that was accepted: one outside the range leaves the way back into it. t is the
    plant's own clock; an undated one has no rate. ``v = 0``, to hold, passes always. Of a movement through
    waypoints each piece is such a v, and goes at the mean speed that is stated, of at most ``speed``.

    Kind, shape, type, finite numbers, status and clock of each reading are looked at, so a plant of eighteen
    lines is as safe as one of ours. A :class:`~torch_ekm.control.ClosedLoop` puts a gate before its plant,
    behind the inverse of the servos and the play; put one before a plant that you command yourself::

        plant = Gate(MyHand(), hand)
        plant.command(delta_a)      # CommandRefusedError instead of a motion that is too large

    Args:
        plant: a driver.
        hand: gives names, ranges and lengths.
        increment: largest command to an actuator [rad].
        speed: of commands, mean over a stretch of time [rad/s].
    """

    def __init__(
        self, plant: Plant, hand: HandDescription, *, increment: float = 20 * _DEG, speed: float = 3.0
    ) -> None:
        super().__init__(plant)
        self._hand, self.increment, self.speed = hand, increment, speed
        self._range = [torch.from_numpy(edge) for edge in (hand.actuator_lower, hand.actuator_upper)]
        self._left, self._since = increment, math.inf  # way that may be commanded at once, and when it was so
        self._one_at_a_time = threading.RLock()
        self.last: Observation | None = None
        """The newest reading that could be read."""
        self.failure: Exception | None = None
        """What the plant raised last, or this gate."""

    @contextlib.contextmanager
    def owned(self) -> Iterator[None]:
        """No other one commands the plant meanwhile, by whatever wrappers.

        Raises:
            PlantInUseError: another one does so already.
        """
        plant = _innermost(self.plant)
        with _OWNING:
            if id(plant) in _OWNERS:
                raise PlantInUseError(type(plant).__name__)
            _OWNERS[id(plant)] = self
        try:
            yield
        finally:
            with _OWNING:
                del _OWNERS[id(plant)]

    def reset(self, seed: int) -> Observation:
        """Grasp again; the clock may begin anew."""
        self._left, self._since = self.increment, math.inf
        return self._read(lambda: self.plant.reset(seed))

    def observe(self) -> Observation:
        """Read the sensors.

        Raises:
            EKMError: the reading is none.
        """
        return self._read(self.plant.observe)

    def command(
        self, delta_a: Float[Tensor, " n_a"], start: Observation | None = None, by: str = "user"
    ) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors.

        Args:
            start: the accepted reading from which it goes; None: the newest one.
            by: who asks, for the message.

        Raises:
            CommandRefusedError: nothing was sent; the error says what was asked, by whom, and what
                is allowed.
            PlantInUseError: another one commands this plant.
        """
        with self._mine():
            v = self._check(delta_a, start, by)
            return self._read(lambda: self.plant.command(v))

    def follow(  # type: ignore[override]
        self,
        path: Path,
        watch: Callable[[Observation], bool],
        start: Observation | None = None,
        by: str = "user",
    ) -> Observation:
        """Move the actuators through the waypoints, wait, read the sensors; see
        :class:`~torch_ekm.plant.FollowingPlant`.

        A plant that cannot follow is given single commands, each through as many waypoints as ``increment``
        and the direction of its motors allow, and is watched between them.

        Args:
            watch, start, by: as for :class:`~torch_ekm.plant.FollowingPlant` and :meth:`command`.

        Raises:
            CommandRefusedError: nothing was sent.
            PlantInUseError: another one commands this plant.
            EKMError: a reading on the way is none; the hand holds.
        """
        failed: list[Exception] = []

        def look(seen: Observation) -> bool:
            try:
                self.last = readable(seen, self._hand)
                return watch(self.last)
            except Exception as error:
                failed.append(error)
                return False

        with self._mine():
            begin = self._check_path(path, start, by)
            plant = self.plant
            if can_follow(plant):
                after = self._read(lambda: plant.follow(path, look))
            else:
                after = self._read(lambda: self._by_commands(path, look, begin.a))
            if failed:
                self.failure = failed[0]
                raise failed[0]
            return after

    @contextlib.contextmanager
    def _mine(self) -> Iterator[None]:
        owner = _OWNERS.get(id(_innermost(self.plant)))
        with contextlib.nullcontext() if owner is self else self.owned():
            yield

    def _by_commands(self, path: Path, look: Callable[[Observation], bool], at: Tensor) -> Observation:
        """A path in single commands, from encoders ``at`` on."""
        goals, pieces, k = at + path.waypoints, path.pieces, 0
        while True:
            last = k
            while last + 1 < len(goals) and self._in_one(goals[last + 1] - at, pieces[k : last + 2]):
                last += 1
            v = goals[last] - at
            seen = self.plant.command(v * min(1.0, self.increment / max(float(v.abs().max()), 1e-12)))
            k = last + 1
            if k == len(goals) or not look(seen):
                return seen
            assert self.last is not None
            at = self.last.a
            if float((goals[last] - at).abs().max()) > float(v.abs().max()) + _ASTRAY:
                return seen  # it goes another way, and each command would take it farther

    def _in_one(self, v: Tensor, pieces: Tensor) -> bool:
        turns = (pieces.amin(0) < 0) & (pieces.amax(0) > 0)
        return float(v.abs().max()) <= self.increment and not bool(turns.any())

    def _check(self, delta_a: object, start: Observation | None, by: str) -> Tensor:
        """v in float64, or a refusal."""
        names, kind = self._hand.actuator_names, f"a {type(delta_a).__name__}"
        try:
            v = as_tensors(delta_a=delta_a)[0].detach().to("cpu", torch.float64)
            kind = f"{tuple(v.shape)} numbers"
        except ParameterError:
            v = torch.empty(0)
        if v.shape != (len(names),):
            self._refuse("the hand", by, kind, f"{len(names)} numbers [rad]: {', '.join(names)}")
        if not bool(v.any()):  # NaN is not 0
            return v
        start = start or self.last or self.observe()
        left = self._budget(start)
        rate = f"{left / _DEG:.3g} deg now, at {self.speed / _DEG:.4g} deg/s: wait for the end of a motion"
        self._check_limits(start.a, v[None], v[None], v.new_tensor([[left]]), rate, by)
        self._left = left - float(v.abs().max())
        return v

    def _check_path(self, path: Path, start: Observation | None, by: str) -> Observation:
        """The reading from which it goes, or a refusal."""
        names, w = self._hand.actuator_names, check_kind("path", path, Path).waypoints
        if w.shape[1] != len(names):
            kind = f"waypoints of {w.shape[1]} numbers"
            self._refuse("the hand", by, kind, f"{len(names)} numbers [rad]: {', '.join(names)}")
        start = start or self.last or self.observe()
        left, pieces = self._budget(start), path.pieces
        rate = f"{self.speed / _DEG:.4g} deg/s, mean of a piece"
        self._check_limits(start.a, w, pieces, self.speed * path.durations[:, None], rate, by)
        self._left = left - float(pieces.abs().amax(1).sum())  # a plant that does not wait is slowed down
        return start

    def _check_limits(self, a: Tensor, w: Tensor, pieces: Tensor, most: Tensor, rate: str, by: str) -> None:
        """Refuse what is beyond the limits of set-points ``a + w`` and pieces between them, ``(n, n_a)``."""
        lower, upper = torch.minimum(self._range[0], a), torch.maximum(self._range[1], a)
        size, goal = pieces.abs(), a + w
        largest = f"up to {self.increment / _DEG:.3g} deg (Guards.increment)"
        for wrong, what, value, allowed in (
            (~pieces.isfinite(), "an increment", pieces, "finite ones"),
            (size > self.increment + _ROUNDED, "an increment", pieces, largest),
            (torch.maximum(lower - goal, goal - upper) > _ROUNDED, "a set-point", goal, "{} to {} deg"),
            (size > most + _ROUNDED, "an increment", pieces, rate),
        ):
            if bool(wrong.any()):
                k, i = divmod(int(wrong.flatten().int().argmax()), len(a))
                ends = [f"{float(edge[i]) / _DEG:.4g}" for edge in self._range]
                asked = f"{what} of {float(value[k, i]) / _DEG:.4g} deg"
                name = self._hand.actuator_names[i]
                self._refuse(f"actuator '{name}'", by, asked, allowed.format(*ends))

    def _budget(self, start: Observation) -> float:
        """How far a command may go by the rate [rad]; a clock that goes back was set anew."""
        if not start.dated or start.time < self._since:
            self._left = self.increment
        else:
            self._left = min(self.increment, self._left + self.speed * (start.time - self._since))
        self._since = start.time
        return self._left

    def _refuse(self, what: str, by: str, asked: str, allowed: str) -> NoReturn:
        self.failure = CommandRefusedError.by_gate(what, by, asked, allowed)
        raise self.failure

    def _read(self, ask: Callable[[], Observation]) -> Observation:
        with self._one_at_a_time:
            try:
                self.last = readable(ask(), self._hand)
            except Exception as error:
                self.failure = error
                raise
        return self.last


def _innermost(plant: Plant) -> Plant:
    while isinstance(plant, PlantWrapper):
        plant = plant.plant
    return plant


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
