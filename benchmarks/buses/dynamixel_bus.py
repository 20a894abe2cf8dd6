from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Sequence

from motors import Motors

_HEADER = b"\xff\xff\xfd\x00"
_PING, _READ, _WRITE, _SYNC_READ, _SYNC_WRITE, _STATUS = 0x01, 0x02, 0x03, 0x82, 0x83, 0x55
_BROADCAST, _ACCESS, _ALERT = 0xFE, 7, 0x80
_GOAL, _POSITION, _LOAD, _MOVING, _HARDWARE, _WATCHDOG = 116, 132, 126, 122, 70, 98
_SIZE = 147  # bytes of the control table that are kept
_OUT = 255  # a watchdog that has run out


class DynamixelBus:
    """Servos of the X series behind a pseudo terminal: what a driver talks to where there is no hardware.

    Speaks protocol 2: ping, read, write, sync read, sync write, byte stuffing, checksum, Bus Watchdog,
    Hardware Error. A client opens :attr:`port` as it would open a serial port::

        with DynamixelBus([1, 2]) as bus:
            plant = WithPose(DynamixelPlant(...), ...)  # with port = bus.port in its file

    Args:
        ids: of the servos.
        motors: what moves, in ticks, or anything with the same methods; None: motors that stand at 2048 and
            go 4096 ticks a second.
    """

    def __init__(self, ids: Sequence[int], motors: Motors | None = None) -> None:
        self.ids, self.motors = tuple(ids), motors or Motors([2048.0] * len(ids), 4096.0)
        self.tables = {servo: bytearray(_SIZE) for servo in self.ids}
        self.spoil: Callable[[bytes], bytes] = lambda packet: packet
        """What becomes of each answer on its way: noise, for tests."""
        self.silent: set[int] = set()
        """Servos that do not answer."""
        self.currents: Callable[[Sequence[float]], Sequence[float]] | None = None
        """What each motor draws at its position [2.69 mA]."""
        self.goals: list[list[float]] = []
        """Every goal that was taken [ticks]."""
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
                self._answer(one, bytes([0x06, 0x04, 46]))
        elif instruction == _READ:
            self._answer(servo, self._table(servo, address, size))
        elif instruction == _SYNC_READ:
            for one in rest[4:]:
                self._answer(one, self._table(one, address, size))
        elif instruction == _WRITE and servo in self.tables:
            self._answer(servo, b"", 0 if self._write(address, {servo: rest[2:]}) else _ACCESS)
        elif instruction == _SYNC_WRITE:
            entries = [rest[k : k + size + 1] for k in range(4, len(rest), size + 1)]
            self._write(address, {one[0]: one[1:] for one in entries if one[0] in self.tables})

    def _table(self, servo: int, address: int, size: int) -> bytes:
        if servo not in self.tables:
            return b""
        table, k = self.tables[servo], self.ids.index(servo)
        table[_MOVING] = self.motors.moving
        now = self.motors.now()
        table[_POSITION : _POSITION + 4] = round(now[k]).to_bytes(4, "little", signed=True)
        if self.currents is not None:
            table[_LOAD : _LOAD + 2] = round(self.currents(now)[k]).to_bytes(2, "little", signed=True)
        return bytes(table[address : address + size])

    def _write(self, address: int, values: dict[int, bytes]) -> bool:
        """False: a servo does not take it."""
        if address == _GOAL and any(self.tables[servo][_WATCHDOG] == _OUT for servo in values):
            return False
        for servo, value in values.items():
            self.tables[servo][address : address + len(value)] = value
        if address == _GOAL:
            goal = list(self.motors.now())
            for servo, value in values.items():
                goal[self.ids.index(servo)] = float(int.from_bytes(value[:4], "little", signed=True))
            self.goals.append(goal)
            self.motors.send(goal)
        return True

    def _watch(self) -> None:
        """Bus Watchdogs run out where nobody has asked anything for too long."""
        silence = time.monotonic() - self._asked
        for table in self.tables.values():
            if 0 < table[_WATCHDOG] < _OUT and silence > 0.02 * table[_WATCHDOG]:
                # when a servo would have: this thread may be late
                self.motors.stop(self._asked + 0.02 * table[_WATCHDOG])
                table[_WATCHDOG] = _OUT

    def _answer(self, servo: int, data: bytes, error: int = 0) -> None:
        if servo not in self.tables or servo in self.silent:
            return
        error |= _ALERT if self.tables[servo][_HARDWARE] else 0
        body = bytes([_STATUS, error]) + data
        body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = _HEADER + bytes([servo]) + (len(body) + 2).to_bytes(2, "little") + body
        with contextlib.suppress(OSError):
            os.write(self._master, self.spoil(packet + checksum(packet).to_bytes(2, "little")))


def checksum(data: bytes) -> int:
    """CRC-16 of protocol 2: polynomial 0x8005, nothing reflected, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc
