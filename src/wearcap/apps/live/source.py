"""What a source of live packets is, and the UDP sockets that most of them read."""

import asyncio
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar
from urllib.parse import parse_qs, urlsplit

from wearcap.apps.live.packets import Inbox, Packet
from wearcap.apps.web.guard import LOOPBACK
from wearcap.errors import WearcapError, nearest

MAX_MESSAGES_PER_S, MAX_BYTES_PER_S, MAX_PARSE_S_PER_S = 5_000, 1 << 24, 0.5
"""Limits of one source in a second: messages, their bytes, and the time (s) that understanding them takes; what comes
beyond them is dropped and counted, so that no sender takes the time of the others. So many poses take some 0.4 s in a
burst; on a busy core 600 a second, of six devices, take 0.2 s."""
MAX_MESSAGE_S, MAX_BYTE_S = 0.005, 1e-6
"""The most that one message counts, and each of its bytes (s). The slowest to parse take less (0.6 µs a byte); what takes
longer is a pause of the program's own, such as a garbage collection (half a second where much is held), for which no
sender shall lose messages."""
MAX_SENDERS, FORGOTTEN_S = 64, 60
"""Senders of a source that are known at a time, and the time (s) of silence after which one is not."""
TOO_MANY = "too many messages"


class Fault(Exception):
    """Why a message, or a part of one, cannot be used."""


def require(fault: str | None) -> None:
    """Raise a fault, if there is one."""
    if fault is not None:
        raise Fault(fault)


@contextmanager
def counted(refuse: Callable[[str], None]) -> Iterator[None]:
    """A fault is counted, and ends what is in here."""
    try:
        yield
    except Fault as fault:
        refuse(str(fault))


class Budget:
    """What one source may take in within a second. Senders that have delivered keep a share that no others can take."""

    def __init__(
        self, messages: int = MAX_MESSAGES_PER_S, size: int = MAX_BYTES_PER_S, parse_s: float = MAX_PARSE_S_PER_S
    ):
        self.messages, self.size, self.parse_s = messages, size, parse_s
        self._second = 0
        self._all = _Spent()
        self._known: dict[Hashable, _Spent] = {}
        """Senders that have delivered, the first ones first."""

    def allows(self, size: int, sender: Hashable = None) -> bool:
        """Whether one more message, of so many bytes, is within the limits of all, or within a known sender's share."""
        now = int(time.monotonic())
        if now != self._second:
            self._known = {one: spent for one, spent in self._known.items() if now - spent.last_s < FORGOTTEN_S}
            for spent in (self._all, *self._known.values()):
                # What was spent beyond a second's limit is paid for in the next ones.
                spent.seconds = max(0.0, spent.seconds - (now - self._second) * self.parse_s)
                spent.messages = spent.bytes = 0
            self._second = now
        own = self._known.get(sender)
        for spent in (self._all, own):
            if spent is not None:
                spent.messages, spent.bytes, spent.last_s = spent.messages + 1, spent.bytes + size, now
        return self._within(self._all, 1) or (own is not None and self._within(own, 2 * len(self._known)))

    def _within(self, spent: "_Spent", part: int) -> bool:
        within = part * spent.messages <= self.messages and part * spent.bytes <= self.size
        return within and part * spent.seconds < self.parse_s

    @contextmanager
    def spending(self, size: int, sender: Hashable = None) -> Iterator[None]:
        """Time in here counts as spent, up to what a message of so many bytes can take."""
        begin_s = time.thread_time()
        try:
            yield
        finally:
            seconds = min(time.thread_time() - begin_s, MAX_MESSAGE_S + size * MAX_BYTE_S)
            for spent in (self._all, self._known.get(sender)):
                if spent is not None:
                    spent.seconds += seconds

    def know(self, sender: Hashable) -> None:
        """A sender has delivered what could be used."""
        if sender not in self._known and len(self._known) < MAX_SENDERS:
            self._known[sender] = _Spent(last_s=self._second)


@dataclass
class _Spent:
    """What has been taken in within this second: of all, or of one sender."""

    messages: int = 0
    bytes: int = 0
    seconds: float = 0.0
    last_s: int = 0
    """Second of the last message."""


class Addressed:
    """A source or a sink that an address names."""

    port: ClassVar[int]
    """Default port."""


Kind = TypeVar("Kind", bound=Addressed)


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

    def require_options(self, *allowed: str) -> None:
        """Raise WearcapError for an option that is neither `wearer` nor one of these."""
        for name in self.options:
            if name not in ("wearer", *allowed):
                raise WearcapError(f"no option {name!r}", f"{self.scheme}://", fix=nearest(name, ("wearer", *allowed)))


def addressed(
    text: str, kinds: Mapping[str, type[Kind]], what: str, setting: str, host: Callable[[type[Kind]], str]
) -> tuple[type[Kind], Address]:
    """The kind that an address names, and the address ("vmc" alone: the defaults); `what` it is and which `setting` it comes
    from, for errors; `host`: where a kind is unless the address says so.

    Raises WearcapError for an unknown scheme, and for anything that is no address.
    """
    scheme, separator, _ = text.partition("://")
    if scheme not in kinds:
        fault = f"no {what} is called {scheme[:40]!r}"
        raise WearcapError(fault, f"{setting}={text[:80]}", "SCHEME://HOST:PORT", nearest(scheme, kinds))
    kind = kinds[scheme]
    return kind, Address.of(text if separator else f"{scheme}://", kind.port, host(kind))


class Source(Addressed, ABC):
    """Something that delivers packets while it runs; it never raises for what comes from the network."""

    scheme: ClassVar[str]
    """Scheme of its addresses ("vmc")."""
    hz: ClassVar[float]
    """Nominal rate of each device's packets (Hz)."""
    convention: ClassVar[str]
    """Axes and units of what is received, as text for people."""
    lossless: ClassVar[bool] = False
    """Whether all that it delivers must be captured, however late the capture is."""
    own_options: ClassVar[tuple[str, ...]] = ()
    """Options of its addresses beside `wearer`."""
    patient: ClassVar[bool] = False
    """Whether its wearer stays while nothing comes."""

    def __init__(self, address: Address):
        """Listen at an address. Raises WearcapError for options that the source does not have."""
        address.require_options(*self.own_options)
        self.address = address
        self.wearer = address.options.get("wearer", "")
        self.listens = False
        """Whether the address has been in use: a source that fails later is started again."""
        self.budget = Budget()

    @property
    def name(self) -> str:
        """Name in messages and counters."""
        return f"{self.scheme}:{self.address.port}"

    @property
    def loopback(self) -> bool:
        """Whether only programs of this machine can reach the source."""
        return self.address.host in LOOPBACK

    @property
    def url(self) -> str:
        """Where a sender connects, with the token where one is needed."""
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        return f"{self.scheme}://{host}:{self.address.port}"

    def cannot_listen(self, error: OSError) -> WearcapError:
        """What to raise when the address cannot be used."""
        fix = "Is another program listening there? Choose another port, or end it."
        return WearcapError(f"cannot listen ({error.strerror or error})", self.url, fix=fix)

    @abstractmethod
    async def run(self, inbox: Inbox) -> None:
        """Deliver packets to the inbox until cancelled, or until there are no more (a replay).

        Raises WearcapError only at the beginning, when the address cannot be used.
        """


class DatagramSource(Source):
    """A source that reads one UDP socket; a subclass understands one datagram at a time."""

    @abstractmethod
    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterable[Packet | None]:
        """The packets of one datagram, None for parts that are none.

        Whatever the bytes are, it returns within milliseconds, raises nothing but Fault and allocates no more than a small
        multiple of their number; what cannot be used is counted by `refuse(reason)`, whose reasons are few and fixed.
        """

    def parse(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> list[Packet]:
        """The packets of one datagram; raises nothing."""
        with counted(refuse):
            return [packet for packet in self.packets(data, arrived_s, refuse) if packet is not None]
        return []

    def take(self, data: bytes, inbox: Inbox, sender: Hashable = None) -> bool:
        """Deliver what is in a message, within the limits; whether there was anything."""
        if self.budget.allows(len(data), sender):
            return self.understand(data, inbox, sender)
        inbox.refuse(self.name, TOO_MANY)
        return False

    def understand(self, data: bytes, inbox: Inbox, sender: Hashable) -> bool:
        """Deliver what is in a message; whether there was anything."""
        with self.budget.spending(len(data), sender):
            packets = self.parse(data, time.monotonic(), lambda why: inbox.refuse(self.name, why))
        inbox.deliver(packets)
        if packets:
            self.budget.know(sender)
        return bool(packets)

    async def run(self, inbox: Inbox) -> None:
        try:
            end = await self.listen(inbox)
        except OSError as error:
            raise self.cannot_listen(error) from error
        self.listens = True
        try:
            await asyncio.Event().wait()
        finally:
            await end()

    async def listen(self, inbox: Inbox) -> Callable[[], Awaitable[None]]:
        """Begin to deliver what comes; returns what ends it. Raises OSError when the address cannot be used."""
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(
            lambda: _Receiver(self, inbox), local_addr=(self.address.host, self.address.port)
        )
        endpoint: socket.socket = transport.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)

        async def end() -> None:
            transport.close()

        return end


class _Receiver(asyncio.DatagramProtocol):
    """Passes datagrams to a source."""

    def __init__(self, source: DatagramSource, inbox: Inbox):
        self.source, self.inbox = source, inbox

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.source.take(data, self.inbox, addr)

    def error_received(self, exc: Exception) -> None:
        self.inbox.refuse(self.source.name, "socket error")
