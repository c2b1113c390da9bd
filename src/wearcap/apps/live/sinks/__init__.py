"""Sinks: where live motion goes, one protocol or kind of file a module."""

from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sinks.vmc import VmcSink
from wearcap.apps.live.sinks.websocket import WebSocketSink
from wearcap.apps.live.source import Address
from wearcap.errors import WearcapError, nearest

SINKS: dict[str, tuple[type[VmcSink | WebSocketSink], int]] = {"vmc": (VmcSink, 39539), "ws": (WebSocketSink, 9102)}
"""Sinks by the scheme of their addresses, with their default ports."""


def sink_of(text: str, host: str, pace: bool) -> Sink:
    """The sink of an address ("vmc://127.0.0.1:39539"); `pace`: whether frames are sent at their own rate; `host`: where one
    that serves does so, unless its address says it.

    Raises WearcapError for an unknown scheme, anything that is no address, and options that the sink does not have.
    """
    scheme, separator, _ = text.partition("://")
    if scheme not in SINKS:
        raise WearcapError(
            f"no sink is called {scheme[:40]!r}", f"to={text[:80]}", "SCHEME://HOST:PORT", nearest(scheme, SINKS)
        )
    kind, port = SINKS[scheme]
    host = host if kind.serves else "127.0.0.1"
    return kind(Address.of(text if separator else f"{scheme}://", port, host), pace)
