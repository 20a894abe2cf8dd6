from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..description import HandDescription
from ..exceptions import BusError
from .driver import HandDriver
from .dynamixel_port import SERVOS, DynamixelPort, Servo
from .gathered import BusReading

_TURN = 4096
_TICKS = _TURN / (2 * math.pi)  # per rad
_VELOCITY = 0.229 * 2 * math.pi / 60  # [rad/s] of a unit of Profile Velocity
_PWM = 0.113  # [%] of a unit of Goal PWM
_WATCHDOG_MS = 80
_LAST_ID = 252
# control table of the X series: (address, bytes)
_MODE, _TORQUE, _LEVEL, _WATCHDOG, _CURRENT = (11, 1), (64, 1), (68, 1), (98, 1), (102, 2)
_GOAL = 112  # Profile Velocity, Goal Position (int32): 8 bytes
_STATE = (120, 16)  # Realtime Tick, moving at 2, current (int16) at 6, position (int32) at 12
_REGISTERS = {
    "Model Number": (0, 2), "Firmware Version": (6, 1), "Drive Mode": (10, 1), "Operating Mode": _MODE,
    "Secondary ID": (12, 1), "Homing Offset": (20, 4), "PWM Limit": (36, 2), "Current Limit": (38, 2),
    "Velocity Limit": (44, 4), "Max Position Limit": (48, 4), "Min Position Limit": (52, 4),
    "Torque Enable": _TORQUE, "Bus Watchdog": _WATCHDOG, "Goal PWM": (100, 2), "Goal Current": _CURRENT,
    "Goal Position": (116, 4), "Present Position": (132, 4),
}  # fmt: skip
_ALL = (0, 136)
_MAY_CHANGE = ("Bus Watchdog", "Goal Position", "Present Position")
_REVERSE, _TIMED = 1, 4  # bits of Drive Mode
_OUT = 255  # a watchdog that has run out
_UPTIME_MS, _SLOW, _JITTER_MS = 32768, 0.03, 60  # that Realtime Tick counts; how wrong it may go

Registers = dict[str, int]


def registers(port: DynamixelPort, servos: Sequence[int]) -> list[Registers]:
    """Of each servo, by their names in the maker's table."""
    return [
        {
            name: int.from_bytes(data[at : at + size], "little", signed=size == 4)
            for name, (at, size) in _REGISTERS.items()
        }
        for data in port.sync_read(servos, *_ALL)[0]
    ]


class DynamixelPlant(HandDriver):
    """A hand on Dynamixel servos, X series or MX(2.0), protocol 2: Yale OpenHand, LEAP, most student hands.

    One tick is 2 pi/4096 rad; models, their units and modes are those of
    :data:`~torch_ekm.drivers.SERVOS`. Registers are read when the driver opens, compared with the
    wiring, and read again with each motion: a servo that has rebooted, has no torque, or whose mode or
    limits were changed is an error. Whole turns that a power cycle has taken are given back where a motor's
    range is less than one. During a motion the servos' own Bus Watchdog is set to 80 ms: they stop if this
    process dies. ``info["load"]`` is the current in the model's unit, or the load in 0.1 %.

    Args:
        wiring: the TOML file; ``[bus]``: ``port``, ``baud`` (57600), ``mode`` (5: current-based position, or
            4 where a servo has no currents; 3, 4: position), ``current_ma`` (mode 5: the most that a motor
            pulls with).
        hand: its description; None: the one that the file names.
        options: see :class:`HandDriver`.

    Raises:
        MissingExtraError: dynamixel-sdk is not installed (extra ``dynamixel``).
        DescriptionError: the file is wrong, or asks for what a servo has not; the message names the line.
        BusError: no such port, another driver has it, a servo does not answer or is of an unknown model.
    """

    driver, unit, per_rad = "dynamixel", "ticks", _TICKS
    keys = ("port", "baud", "mode", "current_ma")

    def __init__(self, wiring: str | Path, hand: HandDescription | None = None, **options: Any) -> None:
        super().__init__(self.wired(wiring, hand), **options)
        bus, motors = self.wiring.bus, self.wiring.motors
        self._refuse_what_no_servo_has()
        self._ids: list[int] = [int(one.id) for one in motors]
        what = {int(one.id): f"motor '{one.name}', id {one.id} ({bus.path}:{one.line()})" for one in motors}
        try:
            self._port = DynamixelPort(bus.text("port"), bus.whole("baud", 57600), what.__getitem__)
        except ValueError as error:
            raise bus.error(f"'baud' {error}") from None
        try:
            for servo in self._ids:
                self._port.ping(servo)
            if not self.dry_run:
                self._all(_LEVEL[0], bytes([2]))  # else some do not answer
            self._found = self._registers()
            pairs = zip(self._found, what.values(), strict=True)
            self._models = [self._model(found["Model Number"], name) for found, name in pairs]
            self._speeds = [
                max(1, round(self.limits.rate * one.per_unit / _TICKS / _VELOCITY)) for one in motors
            ]
            mode, current_ma = self._allowed()
            self._sent: list[int] = []
            self._changed: tuple[str, str] | None = None  # servo and problem: only opening again cures it
            self._seen: list[tuple[int, float, float]] = []  # Realtime Ticks, and between which times
            if not self.dry_run:
                self._prepare(mode, current_ma)
            self._found = self._registers()
            self._able_to_move(current_ma)
            self._give_turns_back(self._read().motors)
            if mode == 3:
                self._within_limits()
            if not self.dry_run:
                self._write(self._read().motors, 1.0)
                for servo in self._ids:
                    self._port.write(servo, _TORQUE, 1, "Torque Enable")
                self._found = self._registers()
        except BaseException:
            self._release()
            raise

    # -- the wiring, and what the servos are --------------------------------------------------------

    def _refuse_what_no_servo_has(self) -> None:
        wiring = self.wiring
        for one in wiring.motors:
            if int(one.id) > _LAST_ID:
                raise wiring.error("motors", one, f"'id' must be at most {_LAST_ID}, got {one.id}", "id")
        for kind, found in (("joints", wiring.joints), ("fingertips", wiring.fingertips)):
            if found:
                remedy = "remove it, or read them in a driver of your own"
                raise wiring.error(kind, found[0], f"servos report no [[{kind}]]: {remedy}")

    def _model(self, number: int, what: str) -> Servo:
        if number not in SERVOS:
            known = ", ".join(sorted(one.name for one in SERVOS.values()))
            remedy = "if it has their control table, add it to torch_ekm.drivers.SERVOS"
            raise BusError(what, f"its model number {number} is none of {known}: {remedy}")
        return SERVOS[number]

    def _allowed(self) -> tuple[int, float]:
        """Mode and current; what these servos do not have, or do not allow, is refused."""
        bus = self.wiring.bus
        mode = bus.whole("mode", min(max(one.modes) for one in self._models))
        current_ma = bus.number("current_ma", 0.0, positive=True)
        for one, model, found in zip(self.wiring.motors, self._models, self._found, strict=True):
            name = f"motor '{one.name}' is a servo {model.name}"
            if mode not in model.modes:
                modes = ", ".join(map(str, model.modes[:-1])) + f" or {model.modes[-1]}"
                raise bus.error(f"'mode' must be {modes} (positions), got {mode}: {name}")
            most = found["Current Limit"] * model.unit_ma
            if current_ma and mode != 5:
                raise bus.error(f"'current_ma' limits nothing in mode {mode}: remove it; {name}")
            if (other := found["Secondary ID"]) in {*self._ids} - {int(one.id)}:
                problem = f"its Secondary ID is {other}: it obeys that motor's commands, too; set it to 255"
                raise self.wiring.error("motors", one, problem, "id")
            if current_ma > most:
                problem = f"'current_ma' must be at most {most:.6g}, got {current_ma:g}"
                raise bus.error(f"{problem}: {name}, and this is its Current Limit")
        for one, speed, found in zip(self.wiring.motors, self._speeds, self._found, strict=True):
            if speed > found["Velocity Limit"]:
                most = math.degrees(found["Velocity Limit"] * _VELOCITY * _TICKS / one.per_unit)
                problem = f"[limits] rate is above its Velocity Limit: write rate_deg = {math.floor(most)}"
                raise self.wiring.error("motors", one, problem)
        return mode, current_ma

    def _within_limits(self) -> None:
        """In mode 3 a servo takes no goal beyond its limits, without an error."""
        for one, found in zip(self.wiring.motors, self._found, strict=True):
            low, high = found["Min Position Limit"], found["Max Position Limit"]
            least, most = sorted(round(one.bus(x)) for x in (one.lower, one.upper))
            if least < low or most > high:
                ends = [math.degrees(min(max(one.value(x), one.lower), one.upper)) for x in (low, high)]
                problem = f"its range is {least} to {most} ticks, its Position Limits are {low} and {high}"
                remedy = f"write range_deg = [{min(ends):.4g}, {max(ends):.4g}], or mode = 4"
                if ends[0] == ends[1]:  # they have nothing in common
                    remedy = "write mode = 4, or correct 'zero'"
                raise self.wiring.error("motors", one, f"{problem}: {remedy}", "range_deg")

    def _able_to_move(self, current_ma: float) -> None:
        """Another program may have left a servo without voltage or current; less than all is said."""
        for one, model, found in zip(self.wiring.motors, self._models, self._found, strict=True):
            powers = [("PWM", _PWM, "%"), ("Current", model.unit_ma, "mA")]
            for power, unit, name in powers if found["Operating Mode"] == 5 else powers[:1]:
                goal, limit = found[f"Goal {power}"], found[f"{power} Limit"]
                if not min(goal, limit):
                    remedy = "restore it with the maker's tool, or switch the servo off and on"
                    problem = f"its Goal {power} or {power} Limit is 0, it cannot move: {remedy}"
                    raise self.wiring.error("motors", one, problem)
                if goal < limit and not (current_ma and power == "Current"):
                    shown = f"Goal {power} is {goal * unit:.4g} {name} of {limit * unit:.4g} {name}"
                    self.notes.append(f"motor '{one.name}': {shown}, as another program left it")

    def _prepare(self, mode: int, current_ma: float) -> None:
        """Mode and current; a servo that is in its mode keeps its torque, and what it holds."""
        bus = self.wiring.bus
        for servo, model, found in zip(self._ids, self._models, self._found, strict=True):
            self._port.write(servo, _WATCHDOG, 0, "Bus Watchdog")
            if found["Operating Mode"] != mode:
                self._port.write(servo, _TORQUE, 0, "Torque Enable")
                self._port.write(servo, _MODE, mode, bus.where("mode"))
            if current_ma:
                most = max(1, min(round(current_ma / model.unit_ma), found["Current Limit"]))
                self._port.write(servo, _CURRENT, most, bus.where("current_ma"))

    def _give_turns_back(self, ticks: Sequence[float]) -> None:
        """Zeros as if no power cycle had taken whole turns: known where a motor's range is less than one."""
        motors = []
        for one, model, found, at in zip(self.wiring.motors, self._models, self._found, ticks, strict=True):
            turn, middle = _TURN / one.per_unit, (one.lower + one.upper) / 2  # [rad]
            turns = round((middle - one.value(at)) / turn) if one.upper - one.lower < turn else 0
            motors.append(replace(one, zero=one.zero - one.sign * turns * _TURN))
            said = [f"{model.name}, firmware {found['Firmware Version']}, it reads {at:.0f} ticks"]
            if turns:
                said.append(f"a power cycle has taken whole turns: 'zero' is now {motors[-1].zero:.6g}")
            if offset := found["Homing Offset"]:
                said.append(f"'zero' holds with its Homing Offset of {offset}")
            if found["Drive Mode"] & _REVERSE:
                said.append("reverse Drive Mode: 'sign' holds with it")
            self.notes.append(f"motor '{one.name}': {'; '.join(said)}")
        self.wiring = replace(self.wiring, motors=tuple(motors))

    # -- what HandDriver asks for -------------------------------------------------------------------

    def _read(self) -> BusReading:
        found, began, ended = self._port.sync_read(self._ids, *_STATE)
        if self._jumped(found, began, ended):  # an old packet, or else:
            found, began, ended = self._port.sync_read(self._ids, *_STATE)
        jumped = self._jumped(found, began, ended)
        self._seen = [(int.from_bytes(one[:2], "little"), began, ended) for one in found]
        if jumped:
            name = self.wiring.motors[jumped[0]].name
            problem = "its clock (Realtime Tick) has jumped: it has rebooted; is its supply too weak?"
            raise BusError(f"motor '{name}'", problem)
        return BusReading(
            motors=[int.from_bytes(one[12:16], "little", signed=True) for one in found],
            taken=began,
            moving=any(one[2] for one in found),
            load=[int.from_bytes(one[6:8], "little", signed=True) for one in found],
        )

    def _jumped(self, found: list[bytes], began: float, ended: float) -> list[int]:
        """Motors whose count of milliseconds does not go with our clock; one that never counts is left."""
        jumped = []
        for k, (data, (old, first, last)) in enumerate(zip(found, self._seen)):  # noqa: B905 (none at first)
            least, most = 1e3 * (began - last), 1e3 * (ended - first)
            wrong = _JITTER_MS + _SLOW * most
            tick = int.from_bytes(data[:2], "little")
            if tick != old and (tick - old - least + wrong) % _UPTIME_MS > most - least + 2 * wrong:
                jumped.append(k)
        return jumped

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        self._sent = [round(ticks) for ticks in goal]
        by_time, packed = max(1, round(1e3 * seconds)), []
        for found, speed, at in zip(self._found, self._speeds, self._sent, strict=True):
            profile = by_time if found["Drive Mode"] & _TIMED else speed
            packed.append(profile.to_bytes(4, "little") + at.to_bytes(4, "little", signed=True))
        self._port.sync_write(self._ids, _GOAL, packed)

    @contextlib.contextmanager
    def _moving(self) -> Iterator[None]:
        torque, _, _ = self._port.sync_read(self._ids, *_TORQUE)
        self._compare([{"Torque Enable": one[0]} for one in torque])
        self._all(_WATCHDOG[0], bytes(1))  # one that has run out takes no goal
        self._all(_WATCHDOG[0], bytes([_WATCHDOG_MS // 20]))
        try:
            yield
        finally:
            with contextlib.suppress(BusError):
                self._all(_WATCHDOG[0], bytes(1))

    def _while_standing(self) -> None:
        self._compare(self._registers())

    def _cut_short(self) -> bool:
        """A watchdog has run out, since this process was asleep, or a goal was not taken."""
        found = self._registers()
        self._compare(found)
        goals = [one["Goal Position"] for one in found]
        return goals != self._sent or any(one["Bus Watchdog"] == _OUT for one in found)

    def _release(self) -> None:
        self._port.close()

    # -- registers ----------------------------------------------------------------------------------

    def _all(self, address: int, value: bytes) -> None:
        self._port.sync_write(self._ids, address, [value] * len(self._ids))

    def _registers(self) -> list[Registers]:
        return registers(self._port, self._ids)

    def _compare(self, now: list[Registers]) -> None:
        """With what was found at opening: no servo has rebooted, and nobody else has changed it."""
        if self._change(now) and not self._changed:
            self._changed = self._change(self._registers())  # once more: it may have been an old packet
        if self._changed:
            raise BusError(*self._changed)

    def _change(self, now: list[Registers]) -> tuple[str, str] | None:
        for one, old, new in zip(self.wiring.motors, self._found, now, strict=True):
            if other := [name for name in new if new[name] != old[name] and name not in _MAY_CHANGE]:
                said = ", ".join(f"{name} {new[name]}, was {old[name]}" for name in other)
                off = "torque is off" if "Torque Enable" in other else "its settings have changed"
                remedy = "it has rebooted, or another program was here; open the driver again"
                return f"motor '{one.name}', id {one.id}", f"{off} ({said}): {remedy}"
        return None
