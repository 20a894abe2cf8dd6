from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

from .._extras import require
from ..exceptions import BusError, EKMError


class Servo(NamedTuple):
    """A model with the control table of the X series."""

    name: str
    unit_ma: float = 0.0
    """Of Present Current, Goal Current and Current Limit [mA]; 0: it has Present Load [0.1 %] instead."""

    @property
    def modes(self) -> tuple[int, ...]:
        """Operating modes that take positions: 3 within one turn, 4 of many turns, 5 with a current, too."""
        return (3, 4, 5) if self.unit_ma else (3, 4)


_UNITS = {
    1.0: {
        1190: "XL330-M077", 1200: "XL330-M288",
        1210: "XC330-T181", 1220: "XC330-T288", 1230: "XC330-M181", 1240: "XC330-M288",
    },
    1.34: {1040: "XH430-V350", 1050: "XH430-V210"},
    2.69: {
        1000: "XH430-W350", 1001: "XD430-T350", 1010: "XH430-W210", 1011: "XD430-T210",
        1020: "XM430-W350", 1030: "XM430-W210",
        1100: "XH540-W270", 1101: "XD540-T270", 1110: "XH540-W150", 1111: "XD540-T150",
        1120: "XM540-W270", 1130: "XM540-W150", 1140: "XH540-V270", 1150: "XH540-V150",
        1170: "XW540-T260", 1180: "XW540-T140", 1270: "XW430-T333", 1280: "XW430-T200",
    },
    3.36: {311: "MX-64(2.0)", 321: "MX-106(2.0)"},
    0.0: {
        30: "MX-28(2.0)", 1060: "XL430-W250", 1070: "XC430-W150", 1080: "XC430-W240",
        1090: "2XL430-W250", 1160: "2XC430-W250",
    },
}  # fmt: skip
SERVOS = {number: Servo(name, unit) for unit, models in _UNITS.items() for number, name in models.items()}
"""Model number -> servo; one that is missing may be added."""


T = TypeVar("T")
_PATIENCE_MS = 200.0  # for an answer, where the SDK's 34 ms are less: both ends may share a busy machine
_LOOK = 0.001  # [s] the port sleeps for an answer before the SDK asks again
_HARDWARE = (70, 1)
_FAULTS = {0: "the voltage is wrong", 2: "overheated", 3: "the encoder is dead", 4: "electrical shock",
           5: "overload"}  # fmt: skip


def _patient(sdk: Any) -> type[Any]:
    """The SDK's port, which waits longer for an answer."""

    class PatientPort(sdk.PortHandler):
        def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802 (the SDK's name)
            super().setPacketTimeout(packet_length)
            self.packet_timeout = max(self.packet_timeout, _PATIENCE_MS)

    return PatientPort


class DynamixelPort:
    """Packets of protocol 2 by the SDK: a question without an answer is asked once more, and whatever goes
    wrong is a BusError that says by ``name`` whose answer it was.

    Args:
        port: such as /dev/ttyUSB0.
        baud: bits per second.
        name: servo's id -> what it is called in errors.

    Raises:
        MissingExtraError: dynamixel-sdk is not installed (extra ``dynamixel``).
        BusError: no such port, or another program or driver has it.
        ValueError: the SDK does not have this baud rate.
    """

    def __init__(
        self, port: str, baud: int, name: Callable[[int], str] = lambda servo: f"servo {servo}"
    ) -> None:
        sdk = require("dynamixel_sdk")
        self.port, self._name = port, name
        self._sdk, self._packets, self._handler = sdk, sdk.PacketHandler(2.0), _patient(sdk)(port)
        with self._told(), contextlib.redirect_stdout(None):
            known = self._handler.setBaudRate(baud)
        if not known:
            raise ValueError(f"{baud} is none of the SDK's, such as 57600, 1000000, 4000000")
        try:
            self._handler.ser.exclusive = True  # where the system does not do so itself
        except OSError as error:
            self.close()
            problem = "another program or driver has it open: one hand has one master"
            raise BusError(port, problem) from error
        self._handler.ser.timeout = _LOOK  # the SDK has 0, and keeps a core busy with asking

    def close(self) -> None:
        """Give the port back."""
        with contextlib.suppress(Exception):
            self._handler.closePort()

    def scan(self) -> list[int]:
        """Ids of the servos that answer."""
        with self._told():
            return sorted(self._packets.broadcastPing(self._handler)[0])

    def ping(self, servo: int) -> None:
        """Whether a servo is there.

        Raises:
            BusError: it does not answer.
        """
        what = self._name(servo)
        try:
            self._again(lambda: self._check(self._packets.ping(self._handler, servo)[1], what))
        except BusError as error:
            problem = f"{error.problem}; is it powered, is its baud rate that of [bus], has it this id?"
            raise BusError(what, problem) from error

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> tuple[list[bytes], float, float]:
        """Of each servo, and between which times it was read [s of ``time.monotonic()``]."""

        def read() -> tuple[list[bytes], float, float]:
            began, n = time.monotonic(), len(servos)
            result = self._packets.syncReadTx(self._handler, address, size, list(servos), n, False)
            self._check(result, self.port)
            return [self._answer(servo, size) for servo in servos], began, time.monotonic()

        return self._again(read)

    def sync_write(self, servos: Sequence[int], address: int, values: Sequence[bytes]) -> None:
        """To each servo; none of them answers."""
        data = [byte for servo, value in zip(servos, values, strict=True) for byte in (servo, *value)]
        with self._told():
            size = len(values[0])
            result = self._packets.syncWriteTxOnly(self._handler, address, size, data, len(data))
            self._check(result, self.port)

    def write(self, servo: int, place: tuple[int, int], value: int, what: str) -> None:
        """To one servo, which answers; ``what`` says in errors where the value comes from."""
        address, size = place

        def write() -> None:
            data = list(value.to_bytes(size, "little"))
            result, error = self._packets.writeTxRx(self._handler, servo, address, size, data)
            self._check(result, self._name(servo))
            self._healthy(servo, error, f"it refuses {value} for {what}: ")

        self._again(write)

    # -- inside -------------------------------------------------------------------------------------

    def _answer(self, servo: int, size: int) -> bytes:
        what, others = self._name(servo), set()
        packet, result = self._packets.rxPacket(self._handler, False)
        while result == self._sdk.COMM_SUCCESS and packet[4] != servo:  # it may answer an earlier question
            others.add(packet[4])
            packet, result = self._packets.rxPacket(self._handler, False)
        if others and result != self._sdk.COMM_SUCCESS:
            instead = ", ".join(map(str, sorted(others)))
            raise BusError(what, f"servo {instead} answers in its place: old or wrong packets")
        self._check(result, what)
        if packet[5] + (packet[6] << 8) != size + 4:
            raise BusError(what, "answers with a packet that is too short or too long")
        self._healthy(servo, packet[8])
        return bytes(packet[9 : 9 + size])

    def _healthy(self, servo: int, error: int, of: str = "") -> None:
        if error & 0x80:
            data, result, _ = self._packets.readTxRx(self._handler, servo, *_HARDWARE)
            bits = data[0] if result == self._sdk.COMM_SUCCESS and data else 0
            found = [text for bit, text in _FAULTS.items() if bits >> bit & 1] or ["a hardware error"]
            problem = f"{', '.join(found)}: it has switched off; reboot it when it is well"
            raise BusError(self._name(servo), problem)
        if error:
            text = self._packets.getRxPacketError(error).removeprefix("[RxPacketError] ")
            raise BusError(self._name(servo), f"{of}{text}")

    def _check(self, result: int, what: str) -> None:
        sdk = self._sdk
        if result == sdk.COMM_RX_TIMEOUT:
            raise BusError(what, "no answer: check cable, power, and that its Status Return Level is 2")
        if result == sdk.COMM_RX_CORRUPT:
            raise BusError(what, "a packet with a wrong checksum: noise, or two servos with one id")
        if result != sdk.COMM_SUCCESS:
            raise BusError(what, self._packets.getTxRxResult(result))

    def _again(self, ask: Callable[[], T]) -> T:
        """What a question brings; one without an answer, or with a spoilt one, is asked once again."""
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
