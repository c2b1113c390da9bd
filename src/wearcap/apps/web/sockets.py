"""WebSocket servers of sources and sinks: guarded, counted among all connections, each on a loop in a thread of its own."""

import asyncio
import logging
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.http11 import Request, Response

from wearcap.apps.web.connections import BACKLOG, CONNECTIONS, Connection
from wearcap.apps.web.guard import Guard, Refused

_QUIET = logging.Logger("wearcap.apps.web", logging.CRITICAL + 1)
"""What goes wrong with a connection is counted, not printed."""


class CountedConnection(ServerConnection):
    """A connection of websockets' server that counts from the moment it is accepted."""

    place: Connection | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.place = CONNECTIONS.enter(lambda: self.loop.call_soon_threadsafe(transport.abort))
        if self.place is None:
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if self.place is not None:
            self.place.leave()
        super().connection_lost(exc)


async def serve_sockets(
    listen: Callable[[Any], Coroutine[Any, Any, None]],
    host: str,
    port: int,
    guard: Guard,
    refuse: Callable[[str], None],
    max_size: int,
) -> Server:
    """A server that runs `listen` for each connection that the guard admits; messages have at most `max_size` bytes.

    Raises OSError, or UnicodeError for a host's name, where the address cannot be used.
    """

    def admitted(connection: ServerConnection, request: Request) -> Response | None:
        """An answer that ends a handshake, or None to go on."""
        try:
            guard.admit(request.path, request.headers)
        except Refused as refused:
            refuse("forbidden")
            return connection.respond(HTTPStatus.FORBIDDEN, f"{refused}\n")
        return None

    return await serve(
        listen,
        host,
        port,
        process_request=admitted,
        create_connection=CountedConnection,
        backlog=BACKLOG,
        compression=None,  # a small message could unpack to a large one
        max_size=max_size,
        open_timeout=5,
        close_timeout=1,
        server_header=None,
        logger=_QUIET,
    )


class LoopThread:
    """A loop of asyncio in a thread of its own."""

    def __init__(self, name: str):
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def start(self, work: Coroutine[Any, Any, Any]) -> Future[Any]:
        """Run a coroutine; what it returns or raises is the future's."""
        return asyncio.run_coroutine_threadsafe(work, self.loop)

    def stop(self) -> None:
        """End the thread; what still runs on the loop is cancelled."""

        async def cancel() -> None:
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        self.start(cancel()).result()
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()
