"""Sinks: where live motion goes, one protocol or kind of file a module."""

from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sinks.osc_trackers import OscTrackerSink
from wearcap.apps.live.sinks.vmc import VmcSink
from wearcap.apps.live.sinks.websocket import WebSocketSink
from wearcap.apps.live.source import addressed

SINKS: dict[str, type[VmcSink | OscTrackerSink | WebSocketSink]] = {
    "vmc": VmcSink,
    "osctrackers": OscTrackerSink,
    "ws": WebSocketSink,
}
"""Sinks by the scheme of their addresses."""


def sink_of(text: str, host: str, pace: bool) -> Sink:
    """The sink of an address ("vmc://127.0.0.1:39539"); `pace`: whether frames are sent at their own rate; `host`: where one
    that serves does so, unless its address says it.

    Raises WearcapError for an unknown scheme, anything that is no address, and options that the sink does not have.
    """
    kind, address = addressed(text, SINKS, "sink", "to", lambda kind: host if kind.serves else "127.0.0.1")
    return kind(address, pace)
