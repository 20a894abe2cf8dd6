from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Sequence

from motors import Motors

from torch_ekm.drivers.dynamixel_port import SERVOS

_HEADER = b"\xff\xff\xfd\x00"
_PING, _READ, _WRITE, _SYNC_READ, _SYNC_WRITE, _STATUS = 0x01, 0x02, 0x03, 0x82, 0x83, 0x55
_BROADCAST, _ALERT, _TURN = 0xFE, 0x80, 4096
_RANGE, _LENGTH, _LIMIT, _ACCESS = 4, 5, 6, 7  # errors of an answer
_SIZE = 148  # bytes of the control table that are kept
_OUT = 255  # a watchdog that has run out
# of the X series: name -> (address, bytes)
REGISTERS = {
    "model": (0, 2), "firmware": (6, 1), "id": (7, 1), "baud": (8, 1), "drive_mode": (10, 1), "mode": (11, 1),
    "secondary": (12, 1), "homing": (20, 4), "pwm_limit": (36, 2), "current_limit": (38, 2),
    "velocity_limit": (44, 4), "max_position": (48, 4), "min_position": (52, 4), "torque": (64, 1),
    "level": (68, 1), "hardware": (70, 1), "watchdog": (98, 1), "pwm": (100, 2), "current": (102, 2),
    "velocity": (104, 4), "acceleration": (108, 4), "profile": (112, 4), "goal": (116, 4), "tick": (120, 2),
    "moving": (122, 1), "load": (126, 2), "position": (132, 4),
}  # fmt: skip
_READ_ONLY = ("model", "firmware", "hardware", "tick", "moving", "load", "position")
_SIGNED = ("homing", "current", "velocity", "goal", "load", "position", "pwm")
# limits as the maker leaves them: current [units], velocity [0.229 rpm]; 1023 is the end of its range
_FACTORY = {1030: (1193, 1023), 1020: (1193, 350), 1240: (2352, 350), 1200: (1750, 445), 1060: (0, 265),
            1000: (648, 1023)}  # fmt: skip


class DynamixelBus:
    """Servos of the X series behind a pseudo terminal: what a driver talks to where there is no hardware.

    Speaks protocol 2: ping, read, write, sync read, sync write, byte stuffing, checksum, Bus Watchdog,
    Hardware Error. Refuses what a servo refuses: values beyond ranges and limits, read-only registers, EEPROM
    while torque is on, what its model has not; answers as its Status Return Level says. A client opens
    :attr:`port` as it would open a serial port::

        with DynamixelBus([1, 2]) as bus:
            plant = WithPose(DynamixelPlant(...), ...)  # with port = bus.port in its file

    Args:
        ids: of the servos.
        motors: what moves, in ticks, or anything with the same methods; None: motors that stand at 2048 and
            go 4096 ticks a second.
        model: of all servos.
    """

    def __init__(self, ids: Sequence[int], motors: Motors | None = None, model: int = 1030) -> None:
        self.ids, self.motors = tuple(ids), motors or Motors([2048.0] * len(ids), 4096.0)
        self.tables = {servo: bytearray(_SIZE) for servo in self.ids}
        self.spoil: Callable[[bytes], bytes] = lambda packet: packet
        """What becomes of each answer on its way: noise, for tests."""
        self.silent: set[int] = set()
        """Servos that do not answer."""
        self.currents: Callable[[Sequence[float]], Sequence[float]] | None = None
        """What each motor draws at its position [units of the model]."""
        self.goals: list[list[float]] = []
        """Every goal that was taken [ticks]."""
        self.turns = dict.fromkeys(self.ids, 0)
        """Whole turns that power cycles have taken from what each servo reads."""
        self._booted = dict.fromkeys(self.ids, time.monotonic())
        current, velocity = _FACTORY.get(model, (1193, 1023))
        for servo in self.ids:
            for name, value in (
                ("model", model), ("firmware", 46), ("id", servo), ("baud", 3), ("mode", 3),
                ("secondary", 255),
                ("pwm_limit", 885), ("current_limit", current), ("velocity_limit", velocity),
                ("max_position", _TURN - 1),
            ):  # fmt: skip
                self.set(servo, name, value)
            self._ram(servo)
        self._asked = time.monotonic()
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        """Name of the pseudo terminal."""
        self._open = True
        self._idle = 0  # rounds in which nothing was left to obey
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self) -> DynamixelBus:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def get(self, servo: int, name: str) -> int:
        """What a register holds."""
        address, size = REGISTERS[name]
        data = self.tables[servo][address : address + size]
        return int.from_bytes(data, "little", signed=name in _SIGNED)

    def set(self, servo: int, name: str, value: int) -> None:
        """Put a value into a register, whether a client could or not."""
        address, size = REGISTERS[name]
        self.tables[servo][address : address + size] = value.to_bytes(size, "little", signed=value < 0)

    def reboot(self, servo: int) -> None:
        """A power cycle: torque off, volatile registers as the maker leaves them, whole turns forgotten."""
        self._forget_turns(servo)
        self._ram(servo)
        self._booted[servo] = time.monotonic()

    def close(self) -> None:
        """Pull the cable: whoever has the port open gets errors from now on."""
        if not self._open:
            return
        self._open = False
        self._thread.join()
        for end in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(end)

    def catch_up(self) -> None:
        """Wait until all is obeyed that was sent: nobody answers a broadcast."""
        until = self._idle + 2
        while self._idle < until:
            time.sleep(0.002)

    def _serve(self) -> None:
        data = b""
        while self._open:
            self._watch()
            if not select.select([self._master], [], [], 0.002)[0]:
                self._idle += 1
                continue
            with contextlib.suppress(OSError):
                data += os.read(self._master, 4096)
            while (start := data.find(_HEADER)) >= 0:
                size = 7 + int.from_bytes(data[start + 5 : start + 7], "little")
                if len(data) < start + 7 or len(data) < start + size:
                    break
                packet, data = data[start : start + size], data[start + size :]
                if checksum(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                    self._obey(
                        packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                    )

    def _obey(self, servo: int, instruction: int, rest: bytes) -> None:
        self._asked = time.monotonic()
        address, size = (int.from_bytes(rest[k : k + 2], "little") for k in (0, 2))
        if instruction == _PING:
            for one in self.ids if servo == _BROADCAST else (servo,):
                if one in self.tables:
                    self._answer(one, bytes([*self.tables[one][0:2], self.get(one, "firmware")]))
        elif instruction in (_READ, _SYNC_READ):
            for one in (servo,) if instruction == _READ else rest[4:]:
                if one in self.tables and self.get(one, "level") >= 1:
                    self._answer(one, self._table(one, address, size))
        elif instruction == _WRITE and servo in self.tables:
            level = self.get(servo, "level")
            error = self._write(address, {servo: rest[2:]}).get(servo, 0)
            if level == 2:
                self._answer(servo, b"", error)
        elif instruction == _SYNC_WRITE:
            entries = [rest[k : k + size + 1] for k in range(4, len(rest), size + 1)]
            self._write(address, {one[0]: one[1:] for one in entries if one[0] in self.tables})

    def _table(self, servo: int, address: int, size: int) -> bytes:
        k, now = self.ids.index(servo), self.motors.now()
        self.set(servo, "moving", int(self.motors.moving))
        self.set(servo, "position", self._shown(servo, now))
        self.set(servo, "tick", int(1e3 * (time.monotonic() - self._booted[servo])) % 32768)
        if self.currents is not None:
            self.set(servo, "load", round(self.currents(now)[k]))
        return bytes(self.tables[servo][address : address + size])

    def _shown(self, servo: int, now: Sequence[float] | None = None) -> int:
        """Present Position of where the motor is."""
        at = round((now or self.motors.now())[self.ids.index(servo)])
        return self._way(servo) * at - self.turns[servo] + self.get(servo, "homing")

    def _way(self, servo: int) -> int:
        return -1 if self.get(servo, "drive_mode") & 1 else 1

    def _forget_turns(self, servo: int) -> None:
        self.turns[servo] += (self._shown(servo) - self.get(servo, "homing")) // _TURN * _TURN

    def _ram(self, servo: int) -> None:
        """Volatile registers as after switching on."""
        self.tables[servo][64:] = bytes(_SIZE - 64)
        self.set(servo, "level", 2)
        self._full_power(servo)

    def _full_power(self, servo: int) -> None:
        for name in ("pwm", "current"):
            self.set(servo, name, self.get(servo, f"{name}_limit"))

    def _powered(self, servo: int) -> bool:
        """With torque, voltage, and in mode 5 a current."""
        names = ["torque", "pwm", *(["current"] if self.get(servo, "mode") == 5 else [])]
        return all(self.get(servo, name) for name in names)

    def _write(self, address: int, values: dict[int, bytes]) -> dict[int, int]:
        """The errors of servos that do not take it, by their number."""
        errors: dict[int, int] = {}
        goal, taken = list(self.motors.now()), False
        for servo, data in values.items():
            names = [
                n for n, (a, size) in REGISTERS.items() if address <= a and a + size <= address + len(data)
            ]
            parts = {n: data[REGISTERS[n][0] - address :][: REGISTERS[n][1]] for n in names}
            given = {n: int.from_bytes(x, "little", signed=n in _SIGNED) for n, x in parts.items()}
            wrong = [self._refused(servo, name, value) for name, value in given.items()]
            if sum(map(len, parts.values())) != len(data):  # not a register of these, or a part of one
                wrong.append(_ACCESS if not parts else _LENGTH)
            if any(wrong):
                errors[servo] = next(filter(None, wrong))
                continue
            for name, value in given.items():
                self.set(servo, name, value)
            if "mode" in given:
                self.set(servo, "profile", 0)
                self._full_power(servo)
            if given.get("torque"):
                if self.get(servo, "mode") == 3:
                    self._forget_turns(servo)
                self.set(servo, "goal", self._shown(servo))
            if "goal" in given:
                at = self._way(servo) * (given["goal"] + self.turns[servo] - self.get(servo, "homing"))
                goal[self.ids.index(servo)], taken = float(at), True
        if taken:
            self.goals.append(goal)
            held = [self._powered(servo) for servo in self.ids]
            self.motors.send([g if on else x for g, x, on in zip(goal, self.motors.now(), held, strict=True)])
        return errors

    def _refused(self, servo: int, name: str, value: int) -> int:
        """The error with which a servo does not take a value; 0: it takes it."""
        model = SERVOS[self.get(servo, "model")] if self.get(servo, "model") in SERVOS else SERVOS[1030]
        if name in _READ_ONLY or (REGISTERS[name][0] < 64 and self.get(servo, "torque")):
            return _ACCESS
        if name in ("current", "current_limit") and not model.unit_ma:
            return _ACCESS
        pwm = self.get(servo, "pwm_limit")
        if name in ("goal", "current", "velocity", "pwm") and self.get(servo, "watchdog") == _OUT:
            return _RANGE
        limit, one_turn = self.get(servo, "current_limit"), self.get(servo, "mode") == 3
        turn = self.get(servo, "min_position"), self.get(servo, "max_position")
        allowed = {
            "mode": (0, 16), "drive_mode": (0, 13), "torque": (0, 1), "level": (0, 2), "watchdog": (0, 127),
            "profile": (0, 32767), "current": (-limit, limit), "pwm": (-pwm, pwm),
            "id": (0, 252), "baud": (0, 7), "goal": turn if one_turn else (-1048575, 1048575),
        }.get(name)  # fmt: skip
        if name == "mode" and value not in (1, 16, *model.modes, *((0,) if model.unit_ma else ())):
            return _RANGE
        if allowed is None or allowed[0] <= value <= allowed[1]:
            return 0
        return _LIMIT if name in ("goal", "current", "pwm") else _RANGE

    def _watch(self) -> None:
        """Bus Watchdogs run out where nobody has asked anything for too long."""
        silence = time.monotonic() - self._asked
        for servo in self.ids:
            watchdog = self.get(servo, "watchdog")
            if 0 < watchdog < _OUT and silence > 0.02 * watchdog:
                # when a servo would have: this thread may be late
                self.motors.stop(self._asked + 0.02 * watchdog)
                self.set(servo, "watchdog", _OUT)
                self.set(servo, "profile", 0)

    def _answer(self, servo: int, data: bytes, error: int = 0) -> None:
        if servo not in self.tables or servo in self.silent:
            return
        error |= _ALERT if self.tables[servo][70] else 0
        body = bytes([_STATUS, error]) + data
        body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = _HEADER + bytes([servo]) + (len(body) + 2).to_bytes(2, "little") + body
        with contextlib.suppress(OSError):
            os.write(self._master, self.spoil(packet + checksum(packet).to_bytes(2, "little")))


def _crc(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


_CRC = [_crc(byte) for byte in range(256)]


def checksum(data: bytes) -> int:
    """CRC-16 of protocol 2: polynomial 0x8005, nothing reflected, from 0."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC[crc >> 8 ^ byte]
    return crc
