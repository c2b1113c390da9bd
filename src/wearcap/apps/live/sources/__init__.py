"""Sources: what devices and their applications send, one protocol a module."""

from wearcap.apps.live.source import Address, Source
from wearcap.apps.live.sources.json_lines import JsonSource, WebSocketSource
from wearcap.apps.live.sources.mvn import MvnSource
from wearcap.apps.live.sources.osc import OscTrackerSource, VmcSource
from wearcap.apps.live.sources.watches import WatchHttpSource, WatchSource
from wearcap.errors import WearcapError, nearest

SOURCES: dict[str, type[Source]] = {
    source.scheme: source
    for source in (VmcSource, OscTrackerSource, MvnSource, WatchSource, WatchHttpSource, JsonSource, WebSocketSource)
}
"""Sources by the scheme of their addresses."""


def source_of(text: str, host: str = "127.0.0.1") -> Source:
    """The source that an address names ("vmc://127.0.0.1:39540?wearer=anna"; "vmc" alone: the defaults), on `host` unless it
    names another.

    Raises WearcapError for an unknown scheme, another text, and options that the source does not have.
    """
    scheme, separator, _ = text.partition("://")
    if scheme not in SOURCES:
        what = f"no source is called {scheme[:40]!r}"
        raise WearcapError(what, f"source={text[:80]}", "SCHEME://HOST:PORT", nearest(scheme, SOURCES))
    source = SOURCES[scheme]
    return source(Address.of(text if separator else f"{scheme}://", source.port, host))
