"""Packets of live devices, and the box in which they wait for the capture."""

import threading
from collections import Counter, deque
from typing import NamedTuple

from wearcap.sensors.samples import (
    ActiveObject,
    HandSample,
    HeadSample,
    LocalizationSample,
    ObjectSample,
    SuitPiece,
    WatchSample,
    WristSample,
)

MAX_PACKETS = 20_000
"""Capacity of an `Inbox`: some 20 s of five devices at 200 Hz. The oldest packets are dropped."""
MAX_POINTS_WAITING = 1_000_000
"""Points of the surroundings that may wait with them: 12 MB. The oldest packets are dropped."""
HEAD, SUIT, CAMERA = "head", "suit", "camera"
"""Names of devices that say by themselves what they are; wrists are named by their joint, others by their serial."""
OBJECT = "object"
"""Device of samples of objects, with the object's name behind it where there is one."""
HANDS = {"left_hand": "left", "right_hand": "right"}
"""Devices of samples of hands, and their sides."""
Sample = (
    HeadSample | HandSample | WatchSample | WristSample | SuitPiece | LocalizationSample | ActiveObject | ObjectSample
)


class Packet(NamedTuple):
    """What one device measured at one time."""

    wearer: str
    """Name of who wears it; "" where the source serves one person."""
    device: str
    """`HEAD`, a joint of `body.skeleton.WRISTS`, `SUIT`, `CAMERA`, `OBJECT`, or the serial of a tracker of unknown place."""
    clock: str
    """Name of the clock that `sent_s` counts on; devices of one clock share it."""
    sent_s: float | None
    """The device's own time (s); None where the protocol has none: the time of arrival stands for it."""
    arrived_s: float
    """Our time (s, `time.monotonic`) at which the packet arrived."""
    sample: Sample
    """In wearcap's axes. Its timestamp is `sent_s`, or `arrived_s`. A tracker of unknown place is a `WristSample` whose
    joint is its serial; a watch of unknown place is a `WatchSample` whose joint is its serial."""


class Inbox:
    """Packets that wait for the capture, bounded: whoever delivers never blocks and never fails."""

    def __init__(self, capacity: int = MAX_PACKETS):
        self.overflowed = 0
        """Number of packets dropped because the capture was slow."""
        self.refused: Counter[str] = Counter()
        """Number of datagrams, or parts of them, that no source understood, by source and reason."""
        self.capacity = capacity
        self._packets: deque[Packet] = deque()
        self._points = 0
        """Points that wait."""
        self._ready = threading.Condition()

    def deliver(self, packets: list[Packet]) -> None:
        """Take packets in, from any thread."""
        if not packets:
            return
        with self._ready:
            self._packets.extend(packets)
            self._points += sum(map(_points_of, packets))
            while len(self._packets) > self.capacity or self._points > MAX_POINTS_WAITING:
                self._points -= _points_of(self._packets.popleft())
                self.overflowed += 1
            self._ready.notify()

    def refuse(self, source: str, reason: str) -> None:
        """Count something that a source could not use; an endless variety of reasons is kept out by the sources."""
        self.refused[f"{source}: {reason}"] += 1

    def wait(self, seconds: float) -> list[Packet]:
        """All packets that are there, after at most so many seconds of waiting for the first."""
        with self._ready:
            if not self._packets:
                self._ready.wait(seconds)
            found = list(self._packets)
            self._packets.clear()
            self._points = 0
            return found

    @property
    def waiting(self) -> int:
        """Number of packets that wait."""
        return len(self._packets)

    def wake(self) -> None:
        """End a `wait`."""
        with self._ready:
            self._ready.notify()


def _points_of(packet: Packet) -> int:
    """Number of a packet's points of the surroundings."""
    points = getattr(packet.sample, "points_world", None)
    return 0 if points is None else len(points)
