"""WebSocket servers of sources and sinks: guarded, counted among all connections."""

import logging
from collections.abc import Callable, Coroutine
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
