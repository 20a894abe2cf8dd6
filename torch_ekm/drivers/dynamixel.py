from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from .._extras import require
from ..description import HandDescription
from ..exceptions import BusError, DescriptionError, EKMError
from .driver import BusReading, HandDriver
from .wiring import Wiring

T = TypeVar("T")
_TICKS = 4096 / (2 * math.pi)  # per rad
_VELOCITY = 0.229 * 2 * math.pi / 60  # [rad/s] of a unit of Profile Velocity
_WATCHDOG_MS = 80
_TRIES = 2  # of a question
_PATIENCE_MS = 100.0  # for an answer, where the SDK's 34 ms are less: both ends may share a busy machine
_LOOK = 0.001  # [s] the port sleeps for an answer before the SDK asks again
# control table of the X series: (address, bytes)
_MODE, _TORQUE, _HARDWARE, _WATCHDOG = (11, 1), (64, 1), (70, 1), (98, 1)
_CURRENT, _PROFILE, _GOAL = (102, 2), (112, 4), (116, 4)
_STATE = (122, 14)  # moving 122, current 126 (int16), position 132 (int32)
_FAULTS = {0: "the voltage is wrong", 2: "overheated", 3: "the encoder is dead", 4: "electrical shock",
           5: "overload"}  # fmt: skip
_BUS = ("port", "baud", "mode", "current_ma")
_MODES = (3, 4, 5)  # that take positions
_UNIT_MA, _MOST_MA, _LAST_ID = 2.69, 5506, 252


def _patient(sdk: Any) -> type[Any]:
    """The SDK's port, which waits longer for an answer."""

    class PatientPort(sdk.PortHandler):
        def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802 (the SDK's name)
            super().setPacketTimeout(packet_length)
            self.packet_timeout = max(self.packet_timeout, _PATIENCE_MS)

    return PatientPort


class DynamixelPlant(HandDriver):
    """A hand on Dynamixel servos of the X series, protocol 2: Yale OpenHand, LEAP, most student hands.

    One tick is 2 pi/4096 rad. During a motion the servos' own Bus Watchdog is set to 80 ms: they stop if
    this process dies. A question without an answer is asked once more. ``info["load"]`` is the current
    [2.69 mA].

    Args:
        wiring: the TOML file; ``[bus]``: ``port``, ``baud`` (57600), ``mode`` (5: current-based position; 3,
            4: position), ``current_ma`` (mode 5: the most that a motor pulls with).
        hand: its description; None: the one that the file names.
        options: see :class:`HandDriver`.

    Raises:
        MissingExtraError: dynamixel-sdk is not installed (extra ``dynamixel``).
        DescriptionError: the file is wrong; the message names the line.
        BusError: no such port, or a servo does not answer.
    """

    def __init__(self, wiring: str | Path, hand: HandDescription | None = None, **options: Any) -> None:
        super().__init__(Wiring.read(wiring, "dynamixel", _TICKS, _BUS, hand=hand), **options)
        sdk, bus = require("dynamixel_sdk"), self.wiring.bus
        self._sdk, self._packets = sdk, sdk.PacketHandler(2.0)
        self._ids: list[int] = [int(one.id) for one in self.wiring.motors]
        self.port = bus.text("port")
        mode, current_ma = self._allowed()
        baud, self._handler = bus.whole("baud", 57600), _patient(sdk)(self.port)
        with self._told(), contextlib.redirect_stdout(None):
            if not self._handler.setBaudRate(baud):
                raise bus.error(f"'baud' {baud} is none of the SDK's, such as 57600, 1000000, 4000000")
            self._handler.ser.timeout = _LOOK  # the SDK has 0, and keeps a core busy with asking
        try:
            for one in self.wiring.motors:
                self._ping(int(one.id), f"motor '{one.name}', id {one.id} ({self.wiring.path}:{one.line})")
            if not self.dry_run:
                self._start(mode, current_ma)
        except BaseException:
            self._release()
            raise

    def _allowed(self) -> tuple[int, float]:
        """Mode and current; what servos do not have is refused."""
        wiring, bus = self.wiring, self.wiring.bus
        mode, current_ma = bus.whole("mode", 5), bus.number("current_ma", 0.0, minimum=0.0)
        if mode not in _MODES:
            raise bus.error(f"'mode' must be 3, 4 or 5 (positions), got {mode}")
        if current_ma > _MOST_MA:
            raise bus.error(f"'current_ma' must be at most {_MOST_MA}, got {current_ma:g}")
        for one in wiring.motors:
            if int(one.id) > _LAST_ID:
                place = f"{wiring.path}:{wiring.line('motors', one.name, 'id')}"
                problem = f"[[motors]] '{one.name}': 'id' must be at most {_LAST_ID}, got {one.id}"
                raise DescriptionError(place, problem)
        for kind, found in (("joints", wiring.joints), ("fingertips", wiring.fingertips)):
            if found:
                remedy = "remove it, or read them in a driver of your own"
                problem = f"[[{kind}]] '{found[0].name}': servos report no [[{kind}]]: {remedy}"
                raise DescriptionError(f"{wiring.path}:{found[0].line}", problem)
        return mode, current_ma

    def _start(self, mode: int, current_ma: float) -> None:
        """Mode, profile, torque; a servo that is in its mode keeps its torque, and what it holds."""
        for one, servo in zip(self.wiring.motors, self._ids, strict=True):
            self._set(servo, _WATCHDOG, 0)
            if self._get(servo, _MODE) != mode:
                self._set(servo, _TORQUE, 0)
                self._set(servo, _MODE, mode)
            speed = self.limits.rate * one.per_unit / _TICKS
            self._set(servo, _PROFILE, max(1, round(speed / _VELOCITY)))
            if current_ma:
                self._set(servo, _CURRENT, round(current_ma / _UNIT_MA))
        self._write(self._read().motors, 0.0)
        for servo in self._ids:
            self._set(servo, _TORQUE, 1)

    # -- what HandDriver asks for -------------------------------------------------------------------

    def _read(self) -> BusReading:
        taken, found = self._again(self._state)
        return BusReading(
            motors=[int.from_bytes(one[10:14], "little", signed=True) for one in found],
            taken=taken,
            moving=any(one[0] for one in found),
            load=[int.from_bytes(one[4:6], "little", signed=True) for one in found],
        )

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        self._sync_write(_GOAL, [round(ticks) for ticks in goal])

    @contextlib.contextmanager
    def _moving(self) -> Iterator[None]:
        self._sync_write(_WATCHDOG, [0] * len(self._ids))  # one that has run out takes no goal
        self._sync_write(_WATCHDOG, [_WATCHDOG_MS // 20] * len(self._ids))
        try:
            yield
        finally:
            with contextlib.suppress(BusError):
                self._sync_write(_WATCHDOG, [0] * len(self._ids))

    def _cut_short(self) -> bool:
        """The watchdog of a servo has run out: this process was asleep."""
        return any(one[0] == 255 for one in self._again(lambda: self._sync_read(*_WATCHDOG)))

    def _release(self) -> None:
        with contextlib.suppress(Exception):
            self._handler.closePort()

    # -- packets ------------------------------------------------------------------------------------

    def _state(self) -> tuple[float, list[bytes]]:
        return time.monotonic(), self._sync_read(*_STATE)

    def _sync_read(self, address: int, size: int) -> list[bytes]:
        """Of each servo, in the order of the wiring."""
        with self._told():
            ids = self._ids
            result = self._packets.syncReadTx(self._handler, address, size, list(ids), len(ids), False)
            self._check(result, self.port)
            return [self._answer(servo, size) for servo in ids]

    def _answer(self, servo: int, size: int) -> bytes:
        packet, result = self._packets.rxPacket(self._handler, False)
        self._check(result, f"servo {servo}")
        if packet[4] != servo:
            raise BusError(
                f"servo {servo}", f"servo {packet[4]} answers in its place: an old or wrong packet"
            )
        if packet[5] + (packet[6] << 8) != size + 4:
            raise BusError(f"servo {servo}", "answers with a packet that is too short or too long")
        self._healthy(servo, packet[8])
        return bytes(packet[9 : 9 + size])

    def _sync_write(self, place: tuple[int, int], values: Sequence[int]) -> None:
        address, size = place
        data: list[int] = []
        for servo, value in zip(self._ids, values, strict=True):
            data += [servo, *value.to_bytes(size, "little", signed=size == 4)]
        with self._told():
            result = self._packets.syncWriteTxOnly(self._handler, address, size, data, len(data))
            self._check(result, self.port)

    def _set(self, servo: int, place: tuple[int, int], value: int) -> None:
        def write() -> None:
            data = list(value.to_bytes(place[1], "little"))
            result, error = self._packets.writeTxRx(self._handler, servo, place[0], place[1], data)
            self._check(result, f"servo {servo}")
            self._healthy(servo, error)

        self._again(write)

    def _get(self, servo: int, place: tuple[int, int]) -> int:
        def read() -> int:
            data, result, _ = self._packets.readTxRx(self._handler, servo, *place)
            self._check(result, f"servo {servo}")
            return int.from_bytes(bytes(data), "little")

        return self._again(read)

    def _ping(self, servo: int, what: str) -> None:
        try:
            self._again(lambda: self._check(self._packets.ping(self._handler, servo)[1], what))
        except BusError as error:
            problem = f"{error.problem}; is it powered, is its baud rate that of [bus], has it this id?"
            raise BusError(what, problem) from error

    def _healthy(self, servo: int, error: int) -> None:
        if error & 0x80:
            data, result, _ = self._packets.readTxRx(self._handler, servo, *_HARDWARE)
            bits = data[0] if result == self._sdk.COMM_SUCCESS and data else 0
            found = [text for bit, text in _FAULTS.items() if bits >> bit & 1] or ["a hardware error"]
            raise BusError(
                f"servo {servo}", f"{', '.join(found)}: it has switched off; reboot it when it is well"
            )
        if error:
            raise BusError(f"servo {servo}", self._packets.getRxPacketError(error))

    def _check(self, result: int, what: str) -> None:
        sdk = self._sdk
        if result == sdk.COMM_RX_TIMEOUT:
            raise BusError(what, "no answer: check cable and power")
        if result == sdk.COMM_RX_CORRUPT:
            raise BusError(what, "a packet with a wrong checksum: noise, or two servos with one id")
        if result != sdk.COMM_SUCCESS:
            raise BusError(what, self._packets.getTxRxResult(result))

    def _again(self, ask: Callable[[], T]) -> T:
        """What a question brings; one without an answer, or with a spoilt one, is asked again."""
        for _ in range(_TRIES - 1):
            with contextlib.suppress(BusError), self._told():
                return ask()
        with self._told():
            return ask()

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """What the system says of the port is a BusError."""
        self._handler.is_using = False  # a call that was interrupted leaves it set
        try:
            yield
        except EKMError:
            raise
        except Exception as error:  # termios, serial, and what a spoilt packet does to the SDK
            raise BusError(self.port, f"{type(error).__name__}: {error}; check the cable") from error
