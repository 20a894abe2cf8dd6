from __future__ import annotations

import contextlib
import math
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..description import HandDescription
from ..exceptions import BusError
from .driver import HandDriver
from .gathered import BusReading
from .one_master import OneMaster

_TIMEOUT = 1.0  # [s]
_AGAIN = 0.2  # [s] after it broke, a stream is opened again
_LONGEST = 1 << 16  # characters of a message
_REGISTRATION = re.compile(r"registration name (\S+) ip (\S+) port (\d+) type (\S+)")
_END = "*** end of message"
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class YarpPlant(HandDriver):
    """A hand behind YARP, such as the iCub's: text over sockets, nothing of YARP is needed here.

    Motors are axes of ``part`` in degrees, through its rpc port: ``[get] [encs]``, ``[get] [dons]``,
    ``[set] [pos]`` with position control and a reference speed; an axis that has left position control is an
    error, and axes that the file does not name are left alone. Joint sensors are numbers of the stream
    ``analog`` (15 Hall counts of an iCub's hand), fingertips are taxels of the stream ``skin``. Nothing is
    sent to a hand that stands, and a motion goes out in pieces: if this process dies, the hand stands.

    Args:
        wiring: the TOML file; ``[bus]``: ``name_server`` ("host:port"), ``part`` ("/icub/right_arm"),
            ``analog``, ``skin`` (names of ports).
        hand: its description; None: the one that the file names.
        options: see :class:`HandDriver`.

    Raises:
        DescriptionError: the file is wrong; the message names the line.
        BusError: no name server, no such port, or a part that refuses a command.
    """

    driver, unit, per_rad = "yarp", "deg", 180 / math.pi
    keys = ("name_server", "part", "analog", "skin")

    def __init__(self, wiring: str | Path, hand: HandDescription | None = None, **options: Any) -> None:
        super().__init__(self.wired(wiring, hand), **options)
        bus = self.wiring.bus
        server, _, port = bus.text("name_server", "localhost:10000").rpartition(":")
        if not port.isdigit() or not server:
            raise bus.error("'name_server' must be host:port, such as localhost:10000")
        self._server, self.part = (server, int(port)), bus.text("part")
        self._axes = [int(one.id) for one in self.wiring.motors]
        self._streams: dict[str, _Stream] = {}
        self._master: OneMaster | None = None
        self._rpc = _Connection(self.part + "/rpc:i", self._find)
        try:
            if not self.dry_run:
                self._master = OneMaster(f"{self.part} of {server}:{port}")
            for kind, key in (("joints", "analog"), ("fingertips", "skin")):
                if getattr(self.wiring, kind):
                    self._streams[kind] = _Stream(_Connection(bus.text(key), self._find))
            if not self.dry_run:
                speed = math.degrees(self.limits.rate)  # of the position controllers
                for axis in self._axes:
                    self._set(f"[icmd] [cmod] {axis} [pos]")
                    self._set(f"[vel] {axis} {speed:.6g}")
        except BaseException:
            self._release()
            raise

    def _read(self) -> BusReading:
        taken = time.monotonic()
        encoders, done = self._get("encs"), self._get("dons")
        try:
            motors, moving = [encoders[k] for k in self._axes], not all(done[k] for k in self._axes)
        except IndexError:
            raise BusError(
                self.part, f"has {len(encoders)} axes, [[motors]] needs {max(self._axes) + 1}"
            ) from None
        read = {kind: self._stream(kind) for kind in self._streams}
        joints, joints_taken = read.get("joints", ((), math.inf))
        force, force_taken = read.get("fingertips", ((), math.inf))
        return BusReading(motors, taken, moving, joints, joints_taken, force, force_taken)

    def _stream(self, kind: str) -> tuple[list[float], float]:
        """What each sensor says, and when it came."""
        stream = self._streams[kind]
        numbers, taken = stream.newest()
        channels = getattr(self.wiring, kind)
        last = max(int(one.id) + one.count for one in channels)
        if len(numbers) < last:
            raise BusError(stream.name, f"sends {len(numbers)} numbers, [[{kind}]] needs {last}")
        return [sum(numbers[int(one.id) : int(one.id) + one.count]) for one in channels], taken

    def _write(self, goal: Sequence[float], seconds: float) -> None:
        for axis, degrees in zip(self._axes, goal, strict=True):
            self._set(f"[pos] {axis} {degrees:.9g}")

    @contextlib.contextmanager
    def _moving(self) -> Iterator[None]:
        self._cut_short()
        yield

    def _cut_short(self) -> bool:
        """An axis that has left position control is an error; it would not move, or has stopped."""
        modes = self._ask("[icmd] [cmds]", "cmds", optional=True)
        for one, axis in zip(self.wiring.motors, self._axes, strict=True):
            if len(modes) > axis and (mode := modes[axis].strip("[]")) != "pos":
                problem = f"its control mode is {mode}, not pos: a fault, a stop button or another program"
                raise BusError(f"motor '{one.name}', axis {axis} of {self.part}", problem)
        return False

    def _release(self) -> None:
        for one in (self._rpc, *self._streams.values()):
            one.close()
        if self._master is not None:
            self._master.release()

    def _get(self, what: str) -> list[float]:
        words = self._ask(f"[{what}]", what)
        if not words or not all(_NUMBER.fullmatch(one) for one in words):
            self._rpc.close()  # answers may be out of step
            raise BusError(self._rpc.name, f"answers '{' '.join(words)[:80]}' to [get] [{what}]: no numbers")
        return [float(one) for one in words]

    def _ask(self, command: str, what: str, optional: bool = False) -> list[str]:
        """``[is] encs (1.0 2.0 ...) ... [ok]``; what is optional may be unknown to the board."""
        answer = self._rpc.ask(f"[get] {command}")
        found = re.search(rf"\[?is\]? \[?{what}\]? \(([^()]*)\)", answer)
        if found is None or not re.search(r"\[?ok\]?\s*$", answer):
            if optional:
                return []
            self._rpc.close()
            raise BusError(self._rpc.name, f"answers '{answer[:80]}' to [get] {command}")
        return found[1].split()

    def _set(self, what: str) -> None:
        answer = self._rpc.ask(f"[set] {what}")
        if not re.search(r"\[?ok\]?\s*$", answer):
            self._rpc.close()
            raise BusError(self._rpc.name, f"refuses [set] {what}: '{answer[:80]}'")

    def _find(self, name: str) -> tuple[str, int]:
        """Where a port is, by the name server."""
        server = _Connection("name server", lambda _: self._server)
        try:
            found = _REGISTRATION.search(server.ask(f"query {name}", all_lines=True))
        finally:
            server.close()
        if found is None or found[1] != name or found[4] == "none":
            raise BusError(name, "the name server has no such port: is the robot's interface running?")
        return found[2], int(found[3])


class _Connection:
    """A socket to a YARP port by the text carrier. After a failure it connects again, where the port is then:
    an answer that comes late must not be taken for the next one.

    Args:
        name: of the port.
        find: says where it is.
    """

    def __init__(self, name: str, find: Callable[[str], tuple[str, int]]) -> None:
        self.name, self._find, self._where, self._socket = name, find, ("?", 0), None
        self._lock, self._data = threading.Lock(), b""
        self.send("")

    def send(self, text: str) -> None:
        """Connect, if it is not connected, and send."""
        if self._socket is None:
            self._where = self._find(self.name)
        with self._told():
            if self._socket is None:
                self._data, self._socket = b"", socket.create_connection(self._where, _TIMEOUT)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                text = f"CONNECT torch_ekm\r\n{text}"
            self._socket.sendall(text.encode())

    def ask(self, command: str, all_lines: bool = False) -> str:
        """The answer to a command: one line, or all up to the end of the message."""
        with self._lock:
            self._data = b""  # a second answer to the last command
            self.send(f"d\r\n{command}\r\n")
            if not all_lines:
                return self.line()
            lines = [self.line()]
            while not lines[-1].startswith(_END):
                lines.append(self.line())
            return "\n".join(lines)

    def line(self) -> str:
        """The next line that is a message."""
        with self._told():
            while True:
                while b"\n" not in self._data:
                    more = b"" if self._socket is None else self._socket.recv(4096)
                    if not more:
                        raise ConnectionError("it has closed the connection")
                    self._data += more
                    if len(self._data) > _LONGEST:
                        raise ConnectionError("a message without end")
                raw, _, self._data = self._data.partition(b"\n")
                text = raw.decode(errors="replace").strip()
                if text and text not in ("<ACK>", "D") and not text.startswith("Welcome "):
                    return text

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket = None

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except (OSError, UnicodeError) as error:  # also of a host's name that cannot be one
            self.close()
            where = "{} at {}:{}".format(self.name, *self._where)
            raise BusError(f"YARP port {where}", f"{type(error).__name__}: {error}") from error


class _Stream:
    """The newest message of a port that sends; one that broke is opened again."""

    def __init__(self, connection: _Connection) -> None:
        self.name, self._connection = connection.name, connection
        self._newest: tuple[list[float], float] | None = None
        self._failure: BusError | None = None
        self._came, self._closed = threading.Event(), threading.Event()
        connection.send("r\r\n")
        threading.Thread(target=self._listen, daemon=True).start()

    def newest(self) -> tuple[list[float], float]:
        """Its numbers, and when they came [s]; of the first message it waits for a second."""
        self._came.wait(_TIMEOUT)
        if (failure := self._failure) is not None:
            raise BusError(failure.where, failure.problem)
        if self._newest is None:
            raise BusError(f"YARP port {self.name}", "it sends nothing")
        return self._newest

    def close(self) -> None:
        """Listen no more."""
        self._closed.set()
        self._connection.close()

    def _listen(self) -> None:
        while not self._closed.is_set():
            try:
                if self._failure is not None:
                    self._connection.send("r\r\n")
                words = self._connection.line().strip("()").split()
                if words and all(_NUMBER.fullmatch(word) for word in words):  # else it is cut or garbled
                    self._newest, self._failure = ([float(word) for word in words], time.monotonic()), None
            except BusError as error:
                self._failure = error
                self._closed.wait(_AGAIN)
            self._came.set()
        self._connection.close()
