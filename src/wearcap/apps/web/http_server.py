"""The HTTP server of the annotator and of sensor apps: a thread for each connection, bounded in size and time, behind a guard."""

import contextlib
import http.client
import io
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer, ThreadingMixIn
from typing import Any

from wearcap.apps.web.connections import CONNECTIONS, Connection, Connections
from wearcap.apps.web.guard import Guard, Refused

MAX_HEADER = 1 << 14
"""Bytes of a request before its body."""
DRAIN, DRAIN_S = 1 << 20, 0.2
"""Bytes, and time (s), that are read of a request that was refused."""
_PHRASES = {status.value: status.phrase for status in HTTPStatus}


class Answer(Exception):
    """Ends a request with a status and a reason."""

    def __init__(self, status: HTTPStatus, why: str = ""):
        super().__init__(why)
        self.status, self.why = status, why


class _Arriving(socket.SocketIO):
    """What a connection sends: until a time, and at most so many bytes."""

    until_s, left = 0.0, 0.0

    def readinto(self, buffer: Any) -> int | None:
        if self.left <= 0:
            raise http.client.LineTooLong("request")
        self._sock.settimeout(max(self.until_s - time.monotonic(), 1e-3))  # pyright: ignore[reportAttributeAccessIssue]
        count = super().readinto(buffer)
        self.left -= count or 0
        return count


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection; a subclass defines `do_POST` and others by `answer`."""

    protocol_version = "HTTP/1.1"
    server: "HttpServer"  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout: float = 30.0  # pyright: ignore[reportIncompatibleVariableOverride]
    """Time (s) until the first byte of a request has come, then until all of it has, then for each part of the answer."""

    def setup(self) -> None:
        super().setup()
        self.place, self._granted = self.server.places[self.request], dict[str, str]()
        self._arriving = _Arriving(self.connection, "rb")
        self.rfile = self._buffered = io.BufferedReader(self._arriving)

    def handle_one_request(self) -> None:
        self.requestline = self.request_version = self.command = ""
        self._granted, self.close_connection = {}, True
        self._arriving.until_s, self._arriving.left = time.monotonic() + self.timeout, MAX_HEADER
        try:
            if not self._buffered.peek(1):
                return
        except TimeoutError:
            return
        self._arriving.until_s = time.monotonic() + self.timeout
        try:
            super().handle_one_request()
        except http.client.LineTooLong as error:
            self.send_error(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, str(error))

    def answer(self, action: Callable[[], None]) -> None:
        """Run what answers the request, if the guard admits it."""
        try:
            self._granted = self.server.guard.admit(self.path, self.headers)
            action()
        except Refused as refused:
            self.send_error(HTTPStatus.FORBIDDEN, str(refused))
        except Answer as answer:
            self.send_error(answer.status, answer.why)

    def body(self, most: int) -> bytes:
        """The request's body. Raises Answer where it has none, or a longer one, and ConnectionError where less comes."""
        text = self.headers.get("Content-Length", "")
        if not (text.isascii() and text.isdecimal() and len(text) < 12) or "Transfer-Encoding" in self.headers:
            raise Answer(HTTPStatus.LENGTH_REQUIRED)
        if int(text) > most:
            raise Answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body of {text} bytes")
        self._arriving.left = int(text)
        data = self.rfile.read(int(text))
        if len(data) < int(text):
            raise ConnectionError("the connection ended within a request")
        return data

    def send(
        self, data: bytes, kind: str = "text/plain; charset=utf-8", status: HTTPStatus = HTTPStatus.OK, **headers: str
    ) -> None:
        """Send an answer; `headers` by their names with `_` for `-`."""
        self.begin(
            status, {"Content-Type": kind, "Content-Length": str(len(data)), "Cache-Control": "no-store"} | headers
        )
        if self.command != "HEAD":
            self.wfile.write(data)

    def begin(self, status: HTTPStatus, headers: dict[str, str]) -> None:
        """Send what stands before the body of an answer."""
        self.connection.settimeout(self.timeout)
        self.send_response(status)
        close = {"Connection": "close"} if self.close_connection else {}
        for name, value in (headers | self._granted | close).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with an error, and close the connection."""
        self.close_connection = True
        data, kind = self.error(message or _PHRASES[code])
        self.send(data, kind, HTTPStatus(code))
        self.connection.shutdown(socket.SHUT_WR)
        self._arriving.until_s, self._arriving.left = time.monotonic() + DRAIN_S, DRAIN
        with contextlib.suppress(http.client.LineTooLong, TimeoutError):
            while self._buffered.read1():  # what is left unread would reset the connection before the answer came
                pass

    def error(self, message: str) -> tuple[bytes, str]:
        """Body of an answer that says what is wrong, and its type."""
        return f"{message}\n".encode(), "text/plain; charset=utf-8"

    def version_string(self) -> str:
        return "wearcap"

    def log_message(self, format: str, *args: Any) -> None:
        """Log no requests."""


class HttpServer(ThreadingMixIn, TCPServer):
    """Serves until stopped. Its connections count among others; where there are too many, who has done least goes."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128  # queued requests of a burst are served in turn, instead of being retried after a second
    allow_reuse_address = os.name == "posix"

    def __init__(
        self, host: str, port: int, handler: type[Handler], guard: Guard, connections: Connections = CONNECTIONS
    ):
        """Raises OSError when the address cannot be used."""
        self.guard, self._connections, self.places = guard, connections, dict[Any, Connection]()
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        self.address_family, *_, address = min(found, key=lambda one: one[0] != socket.AF_INET)
        super().__init__(address, handler)  # pyright: ignore[reportArgumentType]
        self.thread = threading.Thread(target=self.serve_forever, args=(0.1,), name=f"http {port}", daemon=True)
        self.thread.start()

    @property
    def server_port(self) -> int:
        return self.server_address[1]  # pyright: ignore[reportReturnType]

    def stop(self) -> None:
        """Stop serving, on open connections too."""
        self.shutdown()
        self.server_close()
        for place in list(self.places.values()):
            with contextlib.suppress(OSError):
                place.close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in its own thread."""
        place = self._connections.enter(partial(request.shutdown, socket.SHUT_RDWR))
        if place is None:
            with contextlib.suppress(OSError):
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return self.shutdown_request(request)
        self.places[request] = place
        try:
            return super().process_request(request, client_address)
        except BaseException:  # no thread was available
            self.places.pop(request).leave()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.places.pop(request).leave()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore dropped and idle connections, which are normal when browsers seek in a video."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)
