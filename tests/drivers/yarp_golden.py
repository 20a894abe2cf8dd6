"""A YARP network of text alone, as the genuine one was heard: name server, rpc port, a port that sends."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable

from motors import Motors
from yarp_text import answer

WELCOME = b"Welcome torch_ekm\r\n"
AXES = 9


class GoldenYarp:
    """The bytes are those of yarpserver and two ports of YARP 3.5.1 for the same lines.

    ``spoil`` changes what is sent after the welcome.
    """

    def __init__(self) -> None:
        self.motors = Motors([45.0] * AXES, 200.0)
        self.commands: list[str] = []
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        self.hall = 128.0
        self.modes: dict[int, str] = {}
        self.open = True
        self.sockets: list[socket.socket] = []
        self.listening: list[socket.socket] = []
        self.rpc, self.analog = self._serve(self._ask), self._serve(self._stream)
        self.server = self._serve(self._names)

    def close(self) -> None:
        """Pull the cable."""
        self.open = False
        for one in self.sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def hang_up(self) -> None:
        """Drop the connections; who calls again is served."""
        for one in [x for x in self.sockets if x not in self.listening]:
            self.sockets.remove(one)
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def _serve(self, talk: Callable[[socket.socket], None]) -> int:
        listening = socket.create_server(("127.0.0.1", 0))
        self.sockets.append(listening)
        self.listening.append(listening)

        def accept() -> None:
            while self.open:
                try:
                    one, _ = listening.accept()
                except OSError:
                    return
                self.sockets.append(one)
                threading.Thread(target=self._run, args=(talk, one), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        return listening.getsockname()[1]

    def _run(self, talk, one: socket.socket) -> None:
        with contextlib.suppress(OSError):
            talk(one)
        with contextlib.suppress(OSError):
            one.close()

    def _lines(self, one: socket.socket):
        for line in one.makefile("rb"):
            text = line.decode(errors="replace").strip()
            if text.startswith("CONNECT "):
                one.sendall(WELCOME)
            else:
                yield text

    def _names(self, one: socket.socket) -> None:
        ports = {"/icub/right_arm/rpc:i": self.rpc, "/icub/right_hand/analog:o": self.analog}
        for text in self._lines(one):
            if text.startswith("query "):
                port = ports.get(text.removeprefix("query "))
                found = f"registration name {text[6:]} ip 127.0.0.1 port {port} type tcp\r\n" if port else ""
                one.sendall(found.encode() + b"*** end of message\r\n")

    def _ask(self, one: socket.socket) -> None:
        for text in self._lines(one):
            if text != "d":
                one.sendall(self.spoil(self._answer(text).encode() + b"\r\n"))

    def _answer(self, text: str) -> str:
        if not text.startswith("[get]"):
            self.commands.append(text)
        return answer(text, self.motors, first=7, modes=self.modes)

    def _stream(self, one: socket.socket) -> None:
        for text in self._lines(one):
            while text == "r" and self.open:
                counts = " ".join([str(self.hall + k) for k in range(15)])
                one.sendall(self.spoil(f"D\r\n{counts}\r\n".encode()))
                time.sleep(0.01)
