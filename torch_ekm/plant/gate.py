"""The last gate: the only way to a motor."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

import torch

from .._arrays import as_tensors
from .._checks import check_kind
from ..description import HandDescription
from ..exceptions import CommandRefusedError, ParameterError, PlantInUseError
from ..typing import Float, Tensor
from .observation import Observation, readable
from .plant import Path, Plant, PlantWrapper, can_follow

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
