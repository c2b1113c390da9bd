"""A small HTTP server for sensor apps: it takes POSTs of bounded size, answers each, and does nothing else."""

import asyncio
import http.client
import io
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Any

from wearcap.apps.live.packets import Inbox
from wearcap.apps.live.source import DatagramSource
from wearcap.apps.web.connections import BACKLOG, CONNECTIONS, DELIVERING, SPOKEN, Connection
from wearcap.apps.web.guard import Guard, Refused

MAX_HEADER, MAX_BODY = 1 << 14, 1 << 20
REQUEST_S, IDLE_S = 5.0, 60.0
"""Time for a request, from the connection or its first byte on, and until the next one of a connection (s)."""


def admitting(host: str, token: str | None) -> Callable[[str, Any], None]:
    """What raises Refused for a request of a foreign page or name, and for one without the token, where there is one."""
    guard = Guard(host) if token is None else Guard(host, token)

    def admit(target: str, headers: Any) -> None:
        # The guard always checks a token: where none is needed, it is put in.
        guard.admit(target if token is not None else f"?token={guard.token}", headers)

    return admit


class _Answer(Exception):
    """Ends a request with a status."""

    def __init__(self, status: HTTPStatus, why: str = ""):
        super().__init__(why)
        self.status, self.why = status, why


class _Connections:
    """The connections of one server."""

    def __init__(self, source: DatagramSource, token: str | None, inbox: Inbox):
        self.source, self.inbox = source, inbox
        self.admit = admitting(source.address.host, token)
        self.tasks: set[asyncio.Task] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of one connection."""
        place = CONNECTIONS.enter(partial(asyncio.get_running_loop().call_soon_threadsafe, writer.transport.abort))
        if task := asyncio.current_task():
            self.tasks.add(task)
            task.add_done_callback(self.tasks.discard)
        try:
            again = True
            while again:
                try:
                    if place is None:
                        raise _Answer(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections")
                    again = await self._next(reader, writer, place)
                except _Answer as answer:
                    self._refuse(answer.status.phrase.lower())
                    await asyncio.wait_for(_write(writer, answer.status, answer.why, close=True), REQUEST_S)
                    again = False
        except (TimeoutError, asyncio.IncompleteReadError, OSError):
            self._refuse("broken connection")
        except asyncio.CancelledError:  # the server ends; asyncio's streams would log it
            pass
        finally:
            if place is not None:
                place.leave()
            writer.close()

    async def _next(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, place: Connection) -> bool:
        """Wait for a request and answer it; whether the connection stays open."""
        try:
            try:
                begin = await asyncio.wait_for(reader.readuntil(b"\r\n"), IDLE_S if place.rank else REQUEST_S)
            except (TimeoutError, asyncio.IncompleteReadError) as nothing:
                if getattr(nothing, "partial", b""):
                    raise
                return False
            return await asyncio.wait_for(self._request(begin, reader, writer, place), REQUEST_S)
        except asyncio.LimitOverrunError as error:
            raise _Answer(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE) from error
        except TimeoutError as error:
            raise _Answer(HTTPStatus.REQUEST_TIMEOUT) from error

    async def _request(
        self, begin: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, place: Connection
    ) -> bool:
        """Answer one request; whether the connection stays open."""
        method, target, headers = await self._head(begin, reader)
        try:
            self.admit(target, headers)
        except Refused as refused:
            raise _Answer(HTTPStatus.FORBIDDEN, str(refused)) from refused
        if method != "POST":
            raise _Answer(HTTPStatus.METHOD_NOT_ALLOWED, "a sensor app's messages are POSTed here")
        length = headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal() and len(length) < 12) or "Transfer-Encoding" in headers:
            raise _Answer(HTTPStatus.LENGTH_REQUIRED)
        if int(length) > MAX_BODY:
            raise _Answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        if not self.source.budget.allows(int(length), place):
            raise _Answer(HTTPStatus.TOO_MANY_REQUESTS)
        if headers.get("Expect", "").lower() == "100-continue":
            writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
        body = await reader.readexactly(int(length))
        place.rise(SPOKEN)
        if self.source.understand(body, self.inbox, place):
            place.rise(DELIVERING)
        close = headers.get("Connection", "").lower() == "close"
        await _write(writer, HTTPStatus.OK, "", close)
        return not close

    async def _head(self, begin: bytes, reader: asyncio.StreamReader) -> tuple[str, str, http.client.HTTPMessage]:
        """Method, target and headers of a request."""
        try:
            method, target, version = begin.decode("ascii").split()
            lines = b""
            while not lines.endswith(b"\r\n\r\n") and lines != b"\r\n":
                lines += await reader.readuntil(b"\r\n")
                if len(begin) + len(lines) > MAX_HEADER:
                    raise _Answer(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
            headers = http.client.parse_headers(io.BytesIO(lines))
        except (ValueError, http.client.HTTPException) as error:
            raise _Answer(HTTPStatus.BAD_REQUEST) from error
        if version not in ("HTTP/1.1", "HTTP/1.0"):
            raise _Answer(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED)
        return method, target, headers

    def _refuse(self, why: str) -> None:
        self.inbox.refuse(self.source.name, why)


async def _write(writer: asyncio.StreamWriter, status: HTTPStatus, text: str, close: bool) -> None:
    """Send an answer."""
    body = f"{text}\n".encode() if text else b""
    head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: text/plain; charset=utf-8\r\n"
    head += f"Content-Length: {len(body)}\r\nConnection: {'close' if close else 'keep-alive'}\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()


async def serve_posts(source: DatagramSource, token: str | None, inbox: Inbox) -> None:
    """Deliver what the source's `parse` finds in the POSTs at its address. Raises WearcapError where it cannot listen."""
    connections = _Connections(source, token, inbox)
    where = source.address
    try:
        server = await asyncio.start_server(
            connections.serve, where.host, where.port, limit=MAX_HEADER, backlog=BACKLOG
        )
    except OSError as error:
        raise source.cannot_listen(error) from error
    source.listens = True
    try:
        await asyncio.Event().wait()
    finally:
        server.close()
        for task in connections.tasks:
            task.cancel()
        await asyncio.gather(*connections.tasks, return_exceptions=True)
