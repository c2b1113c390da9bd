"""One limit for all connections of this process's servers: pages, sources and sinks.

Whoever connects gets in: where there are too many, the connection that has done least goes, the oldest first. The limit
leaves most of the files that the process may open to everything else, so that a recording never lacks one.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None

MAX_CONNECTIONS, SHARE = 256, 4
"""Most connections, and the part of the files that the process may open which they may take: one in so many."""
BACKLOG = 16
"""Connections of one server that may wait to be accepted: so many more than the limit may be open for a moment."""
SILENT, SPOKEN, DELIVERING = range(3)
"""What a connection has done: nothing, a whole admitted request or handshake, or delivered what could be used."""


class Connection:
    """An open connection among all; `close` ends it, from any thread."""

    def __init__(self, among: "Connections", close: Callable[[], Any]):
        self.among, self.close = among, close
        self.rank, self.since_s = SILENT, time.monotonic()

    def rise(self, rank: int) -> None:
        """It has done something that keeps it longer than others."""
        self.rank = max(self.rank, rank)

    def leave(self) -> None:
        """It has ended."""
        self.among.remove(self)


class Connections:
    """The connections that count together."""

    def __init__(self, most: int | None = None):
        """`most`: connections at a time; None: as the process's limit on files allows."""
        files = 1024 if resource is None else resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self.most = most or max(8, min(MAX_CONNECTIONS, files // SHARE))
        self._open: dict[Connection, None] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._open)

    def enter(self, close: Callable[[], Any]) -> Connection | None:
        """Count a new connection; None where there are too many that all deliver: it must be closed."""
        new = Connection(self, close)
        with self._lock:
            full = len(self._open) >= self.most
            least = min(self._open, key=lambda one: (one.rank, one.since_s)) if full else None
            if least is not None and least.rank == DELIVERING:
                return None
            self._open[new] = None
            self._open.pop(least, None)
        if least is not None:
            with suppress(OSError, RuntimeError):  # it has just ended by itself
                least.close()
        return new

    def remove(self, connection: Connection) -> None:
        with self._lock:
            self._open.pop(connection, None)


CONNECTIONS = Connections()
"""Those of this process."""
