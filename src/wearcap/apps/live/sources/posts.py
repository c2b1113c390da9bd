"""Messages of sensor apps by HTTP: POSTs of bounded size are taken and answered, and nothing else is."""

import asyncio
import threading
from http import HTTPStatus
from typing import Any

from wearcap.apps.live.packets import Inbox
from wearcap.apps.live.source import DatagramSource
from wearcap.apps.web.connections import DELIVERING, SPOKEN
from wearcap.apps.web.guard import Guard
from wearcap.apps.web.http_server import Answer, Handler, HttpServer

MAX_BODY = 1 << 20


class _Posts(HttpServer):
    """Gives a source what is posted, one message at a time."""

    def __init__(self, source: DatagramSource, guard: Guard, inbox: Inbox):
        self.source, self.inbox, self.lock = source, inbox, threading.Lock()
        super().__init__(source.address.host, source.address.port, _Post, guard)

    def refuse(self, why: str) -> None:
        self.inbox.refuse(self.source.name, why)

    def handle_error(self, request: Any, client_address: Any) -> None:
        self.refuse("broken connection")


class _Post(Handler):
    server: _Posts  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_POST(self) -> None:
        self.answer(self._take)

    def do_GET(self) -> None:
        self.answer(self._refuse)

    do_HEAD = do_PUT = do_DELETE = do_OPTIONS = do_GET

    def _refuse(self) -> None:
        raise Answer(HTTPStatus.METHOD_NOT_ALLOWED, "a sensor app's messages are POSTed here")

    def _take(self) -> None:
        source, body = self.server.source, self.body(MAX_BODY)
        self.place.rise(SPOKEN)
        with self.server.lock:
            if not source.budget.allows(len(body), self.place):
                raise Answer(HTTPStatus.TOO_MANY_REQUESTS)
            if source.understand(body, self.server.inbox, self.place):
                self.place.rise(DELIVERING)
        self.send(b"")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        self.server.refuse(HTTPStatus(code).phrase.lower())
        super().send_error(code, message, explain)

    def log_error(self, format: str, *args: Any) -> None:
        self.server.refuse("broken connection")


async def serve_posts(source: DatagramSource, token: str | None, inbox: Inbox) -> None:
    """Deliver what the source's `parse` finds in the POSTs at its address. Raises WearcapError where it cannot listen."""
    host = source.address.host
    try:
        server = _Posts(source, Guard(host, open=True) if token is None else Guard(host, token), inbox)
    except OSError as error:
        raise source.cannot_listen(error) from error
    source.listens = True
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.to_thread(server.stop)
