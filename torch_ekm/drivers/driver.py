from __future__ import annotations

import contextlib
import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from .._arrays import as_tensors
from .._checks import check_finite, check_kind, check_shape
from ..description import HandDescription
from ..exceptions import BusError, CommandRefusedError, NeverAtRestError, StaleReadingError
from ..plant import Observation, PlantStatus, Stamps
from ..plant import Path as Waypoints
from ..typing import Array, Float, Tensor
from .gathered import BusReading
from .pose import Posture
from .wiring import Channel, Wiring

_REACH = 0.08  # [s] a motion goes out in pieces of so much: a hand whose computer dies goes no farther
_LEAD = 0.005  # [s] a piece is sent before the end of the one under way: the motors do not stop in between
_BLIND = 0.3  # [s] without a new reading of the motors a motion goes no farther
_POLL = 0.00025  # [s] where something new is awaited
_LOOK = 0.001  # [s] between two looks at what goes on
_TRIES = 5  # of a motion that a watchdog stops, of readings that disagree
_BEYOND = math.radians(15)  # a motor that reads farther outside its range is not sent anywhere
_SLACK = 1e-6  # [rad] of a limit: sums of floats


@dataclass
class _Shown:
    """Of a motion: who watches it, when the newest reading was taken, and the last that was shown."""

    watch: Callable[[Observation], bool] | None
    taken: float
    at: float = -math.inf


class HandDriver(ABC):
    """Base of the drivers: units, order, clock, limits, rest; implements :class:`~torch_ekm.plant.Plant`.

    A subclass says how the bus is read and written. All else is the same for every bus:

    * ``bus = zero + sign per_unit value`` for each motor, joint and fingertip of the wiring;
    * a command is a position, encoders + ``delta_a``, within the motors' ranges; one above
      ``limits.increment`` is refused;
    * a motion goes out in pieces of 0.08 s at ``limits.rate``: if this process dies, the hand stands after
      the piece under way;
    * ``command`` returns when the hand rests; each reading is dated by ``time.monotonic()``, and newer than
      the motion before it.

    The object is ``NOT_SEEN``, at the origin: :class:`WithPose` adds its pose. Joints without a sensor are
    estimated from encoders, couplings and springs: as of a hand that touches nothing.

    Args:
        wiring: channels and limits.
        dry_run: commands are printed, and nothing is sent.
        joints: (readings of the joints' sensors ``(n,)`` [bus units], a ``(n_a,)`` [rad]) -> q ``(n_q,)``
            [rad], such as one with a :class:`~torch_ekm.sensing.JointEstimator`; None: the wiring's straight
            lines.
        say: prints the commands of a dry run.

    Raises:
        BusError: a device does not answer.
    """

    driver, unit, per_rad, named = "", "units of the bus", 1.0, False
    keys: tuple[str, ...] = ()
    """What a wiring file for it has: its name, the unit of positions and how many are a rad, whether ids are
    names, keys of ``[bus]``."""

    @classmethod
    def wired(cls, path: str | Path, hand: HandDescription | None = None) -> Wiring:
        """A wiring file for this driver.

        Raises:
            DescriptionError: the file is wrong; the message names the line.
        """
        return Wiring.read(path, cls.driver, cls.per_rad, cls.keys, named=cls.named, hand=hand)

    def __init__(
        self,
        wiring: Wiring,
        *,
        dry_run: bool = False,
        joints: Callable[[Float[Tensor, " n"], Float[Tensor, " n_a"]], Float[Tensor, " n_q"]] | None = None,
        say: Callable[[str], object] = print,
    ) -> None:
        self.wiring, self.hand, self.limits = wiring, wiring.hand, wiring.limits
        self.dry_run, self._say = dry_run, say
        self._posture = Posture(wiring.hand, [one.name for one in wiring.joints])
        self._joints = self._by_lines if joints is None else joints
        self._after = -math.inf  # a reading must be newer: of the last motion's end
        self._last: BusReading | None = None  # that was observed
        self.notes: list[str] = []
        """What was found when the bus was opened, and a person should know."""

    # -- what a bus does ----------------------------------------------------------------------------

    @abstractmethod
    def _read(self) -> BusReading:
        """The newest reading.

        Raises:
            BusError: no answer, or none that can be right.
        """

    @abstractmethod
    def _write(self, goal: Sequence[float], seconds: float) -> None:
        """Send the motors to positions [bus units], to be reached in about ``seconds``.

        Raises:
            BusError: the bus does not take them.
        """

    @contextlib.contextmanager
    def _moving(self) -> Iterator[None]:
        """Around a motion: a bus with a watchdog of its own sets it here."""
        yield

    def _cut_short(self) -> bool:
        """A watchdog has stopped the motion; it is begun again."""
        return False

    def _while_standing(self) -> None:
        """Once in each motion, while the motors are waited for: time for further questions to the bus."""
        return

    @abstractmethod
    def _release(self) -> None:
        """Give the port or connection back; the motors hold."""

    # -- the plant contract -------------------------------------------------------------------------

    def reset(self, seed: int) -> Observation:
        """Read the sensors: a person puts the object between the fingers."""
        return self.observe()

    def observe(self) -> Observation:
        """Read the sensors.

        Raises:
            BusError: a device does not answer.
            StaleReadingError: a sensor sends nothing new.
        """
        self._last = self._newer()
        return self._observation(self._last)

    def _observation(self, reading: BusReading) -> Observation:
        now, a = time.monotonic(), self._a(reading)
        read = torch.tensor(list(reading.joints), dtype=torch.float64)
        force = self._values(self.wiring.fingertips, reading.fingertips)
        joints_taken = min(reading.joints_taken, reading.taken)
        forces_taken = min(reading.fingertips_taken, now)
        return Observation(
            q=self._joints(read, a),
            a=a,
            position=torch.zeros(3, dtype=torch.float64),
            rotation=torch.eye(3, dtype=torch.float64),
            fingertip_force=force.clamp(min=0.0) if len(force) else None,
            time=now,
            status=PlantStatus.NOT_SEEN,
            info={
                "load": tuple(reading.load),
                "sensed": tuple(one.name for one in self.wiring.joints),
                "joints": self._values(self.wiring.joints, reading.joints).tolist(),
            },
            stamps=Stamps(reading.taken, joints_taken, now, forces_taken),
        )

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the motors by ``delta_a`` [rad] relative to their encoders, wait until they rest, read.

        Raises:
            ParameterError, ShapeError, NonFiniteError: it is not ``n_a`` finite numbers; nothing moves.
            CommandRefusedError: beyond ``limits.increment``, or a motor reads more than 15 deg outside its
                range; nothing moves.
            StaleReadingError: a sensor sends nothing new.
            BusError: a device does not answer.
            NeverAtRestError: the motion does not end; the motors are commanded to hold.
        """
        delta = as_tensors(delta_a=delta_a)[0].detach().to("cpu", torch.float64)
        check_shape("delta_a", delta, (self.hand.n_a,), f"in order: {', '.join(self.hand.actuator_names)}")
        check_finite("delta_a", delta)
        return self._go(Waypoints.through(delta[None], self.limits.rate), None)

    def follow(self, path: Waypoints, watch: Callable[[Observation], bool]) -> Observation:
        """Move through the waypoints, wait until the motors rest, read; see
        :class:`~torch_ekm.plant.FollowingPlant`.

        ``watch`` is given a reading each ``limits.period`` at most; what it does may take no longer, and
        where the servos have a watchdog of their own (80 ms) it stops them.

        Raises:
            EKMError: see :meth:`command`; ``limits.increment`` holds for each piece. After a failure that
                is not of the bus the motors are commanded to hold.
        """
        waypoints = check_kind("path", path, Waypoints).waypoints
        check_shape("waypoints", waypoints[0], (self.hand.n_a,), "for each waypoint")
        return self._go(path, watch)

    def _go(self, path: Waypoints, watch: Callable[[Observation], bool] | None) -> Observation:
        pieces = path.pieces.flatten()
        worst = int(pieces.abs().argmax())
        if float(pieces[worst].abs()) > self.limits.increment + _SLACK:
            motor, most = self.wiring.motors[worst % self.hand.n_a], math.degrees(self.limits.increment)
            raise CommandRefusedError(
                f"motor '{motor.name}'",
                f"a command of {math.degrees(float(pieces[worst])):.3g} deg, [limits] increment in "
                f"{self.wiring.path} is {most:.3g} deg: make smaller motions, or allow more",
            )
        start = self._stands()
        goals = [self._within(start, start + w) for w in path.waypoints.numpy()]
        if self.dry_run:
            for goal in goals:
                shown = [
                    f"{one.name} (id {one.id}) to {one.bus(a):.6g} {self.unit} = {math.degrees(a):.4g} deg"
                    for one, a in zip(self.wiring.motors, goal.tolist(), strict=True)
                ]
                self._say(f"dry run: {', '.join(shown)}")
        elif np.any(np.array(goals) != start):
            try:
                self._move(start, goals, path.durations.tolist(), watch)
            except BusError:  # nothing more goes out: the hand stands after the piece under way
                raise
            except BaseException:
                with contextlib.suppress(Exception):
                    self.hold()
                raise
        else:
            self.hold()
            self._rest(time.monotonic())  # a motor under load yields where its goal becomes where it stands
        self._last = self._newer(reading=self._last)
        return self._observation(self._last)

    def hold(self) -> None:
        """Command the motors to stay where they are: at the median of three readings, one may be wrong.

        Raises:
            BusError: the bus does not take it.
            StaleReadingError: the motors send nothing new.
        """
        if not self.dry_run:
            readings = [self._newer(all_sensors=False)]
            while len(readings) < 3:
                readings.append(self._newer(readings[-1].taken, all_sensors=False))
            self._write(np.median([one.motors for one in readings], axis=0).tolist(), _REACH)

    def close(self) -> None:
        """Hold, and give the bus back; errors of the bus are ignored."""
        with contextlib.suppress(Exception):
            self.hold()
        self._release()

    def __enter__(self) -> HandDriver:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- inside -------------------------------------------------------------------------------------

    def _stands(self) -> Array:
        """Where the motors are, by two readings that agree: one alone may be wrong, or an old packet."""
        # what was seen before the last motion confirms nothing: an old message would agree with it
        last, self._last = self._last or self._read(), None
        for _ in range(_TRIES):
            reading = self._newer(last.taken)
            a = self._a(reading).numpy()
            if np.abs(a - self._a(last).numpy()).max() <= self.limits.still:
                return a
            last = reading
        problem = (
            f"the motors' readings disagree in {_TRIES} looks: something moves them, or the bus is noisy"
        )
        raise BusError(self.wiring.path.name, problem)

    def _newer(
        self, than: float = -math.inf, reading: BusReading | None = None, all_sensors: bool = True
    ) -> BusReading:
        """A reading whose motors were taken later than that, and whose sensors are all newer than the last
        motion, and no older than two periods."""
        began = time.monotonic()
        while True:
            reading = reading or self._read()
            taken = {"motors": reading.taken}
            if all_sensors:
                taken |= {"joints": reading.joints_taken, "fingertips": reading.fingertips_taken}
            # two periods before this call, not before now: a reading does not grow stale by being waited for
            since = max(began - 2 * self.limits.period, self._after)
            late = {k: at for k, at in taken.items() if at < since or (k == "motors" and at <= than)}
            if not late:
                return reading
            if time.monotonic() - began > max(1.0, 4 * self.limits.period):
                name, at = min(late.items(), key=lambda one: one[1])
                raise self._stale(name, at, reading.oldest if name == "motors" else "")
            time.sleep(_POLL)
            reading = None

    def _move(
        self,
        start: Array,
        goals: list[Array],
        seconds: list[float],
        watch: Callable[[Observation], bool] | None,
    ) -> None:
        """Send a motion piece by piece, and wait for its end."""
        shown = _Shown(watch, time.monotonic())
        for _ in range(_TRIES):
            with self._moving():
                end, stopped = self._send_along(start, goals, seconds, shown)
                arrived = np.abs(self._rest(end) - goals[-1]) <= self.limits.still
                if stopped or arrived.all() or not self._cut_short():
                    return
            here = self._stands()
            k = _nearest([start, *goals], here)
            start, goals, seconds = here, goals[k:], seconds[k:]
        remedy = "this process is too slow for it, or goals get lost"
        problem = f"the watchdog has stopped a motion {_TRIES} times: {remedy}"
        raise BusError(self.wiring.path.name, problem)

    def _send_along(
        self, start: Array, goals: list[Array], seconds: list[float], shown: _Shown
    ) -> tuple[float, bool]:
        """Positions along the way; when the last is reached, and whether the watcher has ended it."""
        end = -math.inf
        for k, (goal, least) in enumerate(zip(goals, seconds, strict=True)):
            way = max(least, float(np.abs(goal - start).max()) / self.limits.rate)  # [s]
            pieces = max(1, math.ceil(way / _REACH - 1e-9))
            for i in range(1, pieces + 1):
                now = time.monotonic()
                end = max(end, now) + way / pieces
                self._write(self._bus(start + i / pieces * (goal - start)), end - now)
                last = k == len(goals) - 1 and i == pieces
                if (not last or shown.watch) and not self._wait(end - _LEAD, shown):
                    part = (i - max(0.0, end - time.monotonic()) / (way / pieces)) / pieces
                    self._write(self._bus(start + part * (goal - start)), 0.01)  # at once
                    self.hold()
                    return time.monotonic(), True
            start = goal
        return end, False

    def _wait(self, end: float, shown: _Shown) -> bool:
        """Read until that time: a bus with a watchdog is kept awake. False: the motion is to end."""
        while (left := end - time.monotonic()) > 0:
            if left > 5 * _LOOK:  # else a slow bus would answer after the end
                reading = self._read()
                if reading.taken > shown.taken:
                    shown.taken = reading.taken
                elif time.monotonic() - shown.taken > max(_BLIND, 4 * self.limits.period):
                    raise self._stale("motors", reading.taken, reading.oldest)
                if shown.watch and reading.taken >= shown.at + self.limits.period:
                    shown.at = reading.taken
                    if not shown.watch(self._observation(reading)):
                        return False
            time.sleep(min(_LOOK, max(0.0, end - time.monotonic())))
        return True

    def _rest(self, end: float) -> Array:
        """Read until the motors have stood for ``still_for``; they arrive by ``end``. Where they stand."""
        began, since, seen, asked = time.monotonic(), math.inf, [], False
        while (now := time.monotonic()) - end <= self.limits.timeout:
            reading = self._read()
            if reading.taken > (seen[-1][0] if seen else began):
                seen.append((reading.taken, self._a(reading).numpy()))
                since = math.inf if reading.moving else min(since, reading.taken)
            while len(seen) > 1 and seen[1][0] <= seen[-1][0] - self.limits.still_for:
                seen.pop(0)
            if seen and seen[-1][0] - since >= self.limits.still_for and not any(self._spread(seen)):
                self._after, self._last = seen[0][0], reading
                return seen[-1][1]
            if not asked and math.isfinite(since):
                asked = True
                self._while_standing()
            left = since + self.limits.still_for - time.monotonic()
            time.sleep(left if 0 < left < 3 * _LOOK else _POLL if math.isinf(left) else _LOOK)
        names = [m.name for m, way in zip(self.wiring.motors, self._spread(seen), strict=True) if way]
        what = f"motor '{', '.join(names)}'" if names else str(self.wiring.path)
        raise NeverAtRestError(
            what,
            f"does not come to rest within {now - began:.3g} s of a command: it swings "
            "([limits] still, timeout), or sends nothing new",
        )

    def _spread(self, seen: list[tuple[float, Array]]) -> list[bool]:
        """Which motors moved within the last readings."""
        way = np.ptp([a for _, a in seen] or [np.zeros(self.hand.n_a)], axis=0)
        return (~(way <= self.limits.still)).tolist()

    def _stale(self, name: str, at: float, oldest: str) -> StaleReadingError:
        return StaleReadingError(
            f"{name}{f' ({oldest})' if oldest else ''} of {self.wiring.path.name}",
            f"the newest reading is {time.monotonic() - at:.3g} s old, [limits] period allows "
            f"{2 * self.limits.period:.3g} s: check the sensor's cable, node or clock",
        )

    def _within(self, start: Array, goal: Array) -> Array:
        """The goal, cut at the motors' ranges; one that stands outside is never sent farther out."""
        lower = np.array([one.lower for one in self.wiring.motors])
        upper = np.array([one.upper for one in self.wiring.motors])
        beyond = np.maximum(lower - start, start - upper)
        k = int(beyond.argmax())
        if not beyond[k] <= _BEYOND:
            at, low, high = (f"{math.degrees(x):.4g}" for x in (start[k], lower[k], upper[k]))
            motor, place = self.wiring.motors[k], f"{self.wiring.path}:{self.wiring.motors[k].line()}"
            problem = (
                f"it reads {at} deg, its range is {low} to {high} deg: correct 'zero' or 'range' ({place})"
            )
            raise CommandRefusedError(f"motor '{motor.name}'", problem)
        return np.clip(goal, np.minimum(lower, start), np.maximum(upper, start))

    def _bus(self, a: Array) -> list[float]:
        return [one.bus(float(x)) for one, x in zip(self.wiring.motors, a, strict=True)]

    def _a(self, reading: BusReading) -> Tensor:
        return self._values(self.wiring.motors, reading.motors)

    @staticmethod
    def _values(channels: Sequence[Channel], bus: Sequence[float]) -> Tensor:
        values = [one.value(float(x)) for one, x in zip(channels, bus, strict=True)]
        return torch.tensor(values, dtype=torch.float64)

    def _by_lines(self, readings: Tensor, a: Tensor) -> Tensor:
        return self._posture(self._values(self.wiring.joints, readings.tolist()), a)


def _nearest(knots: list[Array], at: Array) -> int:
    """Which piece between knots passes nearest."""
    away = []
    for a, b in itertools.pairwise(knots):
        part = np.clip((at - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0, 1)
        away.append(float(np.linalg.norm(at - a - part * (b - a))))
    return int(np.argmin(away))
