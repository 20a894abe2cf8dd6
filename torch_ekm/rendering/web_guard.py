from __future__ import annotations

import dataclasses
import hmac
import http
import http.client
import secrets
from collections.abc import Callable
from typing import Any
from unittest import mock

from .._extras import require
from ..exceptions import ParameterError

HOST = "127.0.0.1"


class WebGuard:
    """Asks of every request the secret first part of the path, and of every WebSocket its origin.

    Any page that a browser on this machine shows can send requests to 127.0.0.1, and WebSockets know no
    same-origin policy: without a secret such a page would see and move what the viewer shows. The secret is
    in the path, not in a cookie, which the browser would send to every other server on this machine, too.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)

    def address(self, port: int) -> str:
        """What is to be opened in a browser."""
        return f"http://{HOST}:{port}/{self.token}/"

    def start(self, make: Callable[[], Any]) -> Any:
        """The viser server that ``make`` starts, with this guard in front of it.

        ``serve`` of websockets is replaced while the server starts, since there is no plain way: viser hands
        none of its arguments on to it, and calls it in the middle of its own thread's function, which a
        subclass could only copy. A proxy in front would leave viser's own port open to every page of the
        browser; ``on_client_connect`` is called after the handshake and is not given the request. Then the
        server must refuse a request without the secret.

        Raises:
            ParameterError: it does not, since this version of viser is built otherwise.
        """
        module = require("websockets.asyncio.server")
        serve = module.serve

        def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
            return serve(*arguments, process_request=self._before(process_request), **options)

        with mock.patch.object(module, "serve", guarded):
            server = make()
        if _status(server.get_port(), "/") != http.HTTPStatus.FORBIDDEN:
            server.stop()
            version = getattr(require("viser"), "__version__", "unknown")
            raise ParameterError("viser", version, "a version whose server can be guarded, such as 1.1.1")
        return server

    def _before(self, process_request: Any) -> Callable[[Any, Any], Any]:
        """A ``process_request`` of websockets that hands on what may pass."""

        def check(connection: Any, request: Any) -> Any:
            inner = self.inner_path(request.path, request.headers, connection.local_address[1])
            if inner is None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, "open the address that was printed\n")
            asked = dataclasses.replace(request, path=inner)
            response = None if process_request is None else process_request(connection, asked)
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["Cache-Control"] = "no-store"
            return response

        return check

    def inner_path(self, path: str, headers: Any, port: int) -> str | None:
        """The path behind the secret; None if the request may not pass."""
        hosts = {f"{HOST}:{port}", f"localhost:{port}"}  # any other: a name that was made to lead here
        host, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(host) != 1 or host[0] not in hosts:
            return None
        if origins not in ([], [f"http://{host[0]}"]) or ("Upgrade" in headers and not origins):
            return None
        secret, slash, rest = path.removeprefix("/").partition("?")[0].partition("/")
        if not hmac.compare_digest(secret.encode(), self.token.encode()):
            return None
        return slash + rest or "/"


def _status(port: int, path: str) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=60)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    finally:
        connection.close()
