"""What a source of live packets is, and the UDP sockets that most of them read."""

import asyncio
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

from wearcap.errors import WearcapError
from wearcap.live.packets import Inbox, Packet

MAX_DATAGRAM = 65_536
MAX_DATAGRAMS_PER_S = 5_000
"""Rate limit of a socket; what comes beyond it within a second is dropped and counted."""


@dataclass(frozen=True)
class Address:
    """Where a source listens or a sink sends: "vmc://127.0.0.1:39540?wearer=anna"."""

    scheme: str
    host: str
    port: int
    options: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, text: str, default_port: int, host: str = "127.0.0.1") -> "Address":
        """The address of a URL; without a host, `host`. Raises WearcapError for anything else."""
        try:
            parts = urlsplit(text)
            port = parts.port
        except ValueError as error:
            raise WearcapError(f"no address {text!r} ({error})", expected="SCHEME://HOST:PORT") from error
        options = {key: values[-1] for key, values in parse_qs(parts.query).items()}
        if not parts.scheme or parts.path not in ("", "/"):
            raise WearcapError(f"no address {text!r}", expected="SCHEME://HOST:PORT")
        return cls(parts.scheme, parts.hostname or host, default_port if port is None else port, options)


class Source(ABC):
    """Something that delivers packets while it runs; it never raises for what comes from the network."""

    scheme: ClassVar[str]
    """Scheme of its addresses ("vmc")."""
    port: ClassVar[int]
    """Default port."""
    hz: ClassVar[float]
    """Nominal rate of each device's packets (Hz)."""
    convention: ClassVar[str]
    """Axes and units of what is received, as text for people."""

    def __init__(self, address: Address):
        """Listen at an address. Raises WearcapError for options that the source does not have."""
        self.address = address
        self.wearer = address.options.get("wearer", "")

    @property
    def name(self) -> str:
        """Name in messages and counters."""
        return f"{self.scheme}:{self.address.port}"

    @property
    def loopback(self) -> bool:
        """Whether only programs of this machine can reach the source."""
        return self.address.host in ("127.0.0.1", "::1", "localhost")

    @abstractmethod
    async def run(self, inbox: Inbox) -> None:
        """Deliver packets to the inbox until cancelled, or until there are no more (a replay).

        Raises WearcapError only at the beginning, when the address cannot be used.
        """


class DatagramSource(Source):
    """A source that reads one UDP socket; a subclass understands one datagram at a time."""

    @abstractmethod
    def parse(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> list[Packet]:
        """The packets of one datagram.

        Whatever the bytes are, it returns within milliseconds, raises nothing and allocates no more than a small multiple
        of their number; what cannot be used is counted by `refuse(reason)`, whose reasons are few and fixed.
        """

    async def run(self, inbox: Inbox) -> None:
        loop = asyncio.get_running_loop()
        try:
            transport, _ = await loop.create_datagram_endpoint(
                lambda: _Receiver(self, inbox), local_addr=(self.address.host, self.address.port)
            )
        except OSError as error:
            where = f"{self.address.host}:{self.address.port}"
            fix = "Is another program listening there? Choose another port, or end it."
            raise WearcapError(f"cannot listen ({error.strerror or error})", where, fix=fix) from error
        endpoint: socket.socket = transport.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        try:
            await asyncio.Event().wait()
        finally:
            transport.close()


class _Receiver(asyncio.DatagramProtocol):
    """Passes datagrams to a source's `parse`, within the rate limit."""

    def __init__(self, source: DatagramSource, inbox: Inbox):
        self.source, self.inbox = source, inbox
        self._second, self._count = 0, 0

    def datagram_received(self, data: bytes, addr: Any) -> None:
        now = time.monotonic()
        if int(now) != self._second:
            self._second, self._count = int(now), 0
        self._count += 1
        if self._count > MAX_DATAGRAMS_PER_S:
            self.inbox.refuse(self.source.name, "too many datagrams")
            return
        self.inbox.deliver(self.source.parse(data, now, lambda why: self.inbox.refuse(self.source.name, why)))

    def error_received(self, exc: Exception) -> None:
        self.inbox.refuse(self.source.name, "socket error")
