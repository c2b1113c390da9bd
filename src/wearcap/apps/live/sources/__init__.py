"""Sources: what devices and their applications send, one protocol a module."""

from collections.abc import Sequence

from wearcap.apps.live.setup import Setup
from wearcap.apps.live.source import Source, addressed
from wearcap.apps.live.sources.json_lines import JsonSource, WebSocketSource
from wearcap.apps.live.sources.mvn import MvnSource
from wearcap.apps.live.sources.osc import OscTrackerSource, VmcSource
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.apps.live.sources.watches import WatchHttpSource, WatchSource
from wearcap.errors import WearcapError
from wearcap.runtime.system import CaptureInput, System

SOURCES: dict[str, type[Source]] = {
    source.scheme: source
    for source in (VmcSource, OscTrackerSource, MvnSource, WatchSource, WatchHttpSource, JsonSource, WebSocketSource)
}
"""Sources by the scheme of their addresses."""


def sources_of(
    texts: Sequence[str], host: str, system: System, place: CaptureInput | None, speed: float
) -> tuple[list[Source], Setup | None]:
    """Sources by their addresses, and what a replay knows of its wearer; "replay" sends the place's recording at a speed.

    Raises WearcapError without a source, for a replay without a recording, and as `source_of` does.
    """
    sources, setup = [], None
    for text in texts:
        if text != "replay":
            sources.append(source_of(text, host))
            continue
        if place is None:
            expected = "recording=DATASET/NAME, or any file with one"
            raise WearcapError("source=replay without a recording", expected=expected)
        kind = system.session_class()
        replay = ReplaySource(place.recording, kind, speed, objects=kind.of_objects(system, place))
        sources.append(replay)
        setup = replay.setup
    if not sources:
        raise WearcapError("no source", expected="source=replay, or source=vmc://:39540 …")
    return sources, setup


def source_of(text: str, host: str = "127.0.0.1") -> Source:
    """The source that an address names ("vmc://127.0.0.1:39540?wearer=anna"; "vmc" alone: the defaults), on `host` unless it
    names another.

    Raises WearcapError for an unknown scheme, another text, and options that the source does not have.
    """
    source, address = addressed(text, SOURCES, "source", "source", lambda _: host)
    return source(address)
