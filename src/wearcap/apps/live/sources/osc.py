"""OSC over UDP: devices of the VMC protocol, and the trackers that SlimeVR sends to VRChat."""

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from pythonosc.osc_message import OscMessage, ParseError

from wearcap.apps.live.packets import HEAD, Packet
from wearcap.apps.live.source import Address, DatagramSource, Fault, counted, require
from wearcap.apps.live.sources.parts import UNTRACKED, Names, checked_pose, device_of, pose_of, untracked
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis
from wearcap.sensors.packets import NOT_FINITE, OUT_OF_RANGE, time_fault
from wearcap.sensors.samples import HeadSample, WristSample

MAX_DEPTH = 4
"""Depth of bundles in bundles."""
MAX_ELEMENTS = 1024
"""Messages and bundles of a datagram."""
MAX_MESSAGE = 512
"""Bytes of a message that is decoded."""
_BUNDLE = b"#bundle\0"
_NUMBERS = frozenset("ifdh")

NO_OSC = "no OSC"
TOO_NESTED = "bundles nested too deeply"
TOO_MANY = "too many messages"
WRONG_ARGUMENTS = "wrong arguments"


class Message(NamedTuple):
    """An OSC message that a source knows."""

    address: str
    arguments: list[Any]


def osc_messages(data: bytes, known: frozenset[bytes], refuse: Callable[[str], None]) -> Iterator[Message]:
    """The messages of known addresses in a datagram, those in bundles too; the others are passed over.

    Bundles are taken apart here, so that neither their depth nor their sizes can do harm; python-osc decodes messages.
    """
    parts, elements = [(0, len(data), 0)], 0
    while parts:
        start, stop, depth = parts.pop()
        if data[start : start + 1] == b"/":
            if found := _message(data, start, stop, known, refuse):
                yield found
            continue
        if data[start : start + 8] != _BUNDLE or stop - start < 16:
            return refuse(NO_OSC)
        if depth >= MAX_DEPTH:
            return refuse(TOO_NESTED)
        inner, at = [], start + 16
        while at < stop:
            size = struct.unpack_from(">i", data, at)[0] if stop - at >= 4 else -1
            elements += 1
            if not 0 < size <= stop - at - 4:
                refuse(NO_OSC)
                break
            if elements > MAX_ELEMENTS:
                return refuse(TOO_MANY)
            inner.append((at + 4, at + 4 + size, depth + 1))
            at += 4 + size
        parts += reversed(inner)
    return None


def _message(
    data: bytes, start: int, stop: int, known: frozenset[bytes], refuse: Callable[[str], None]
) -> Message | None:
    end = data.find(b"\0", start, min(stop, start + 128))
    if end < 0:
        return refuse(NO_OSC)
    if data[start:end] not in known:
        return None
    if stop - start > MAX_MESSAGE:
        return refuse(WRONG_ARGUMENTS)
    try:
        tags = data[start + ((end - start) // 4 + 1) * 4 : stop].partition(b"\0")[0]
        if not tags.startswith(b",") or not set(tags[1:].decode("ascii")) <= _NUMBERS | {"s"}:
            return refuse(WRONG_ARGUMENTS)
        message = OscMessage(data[start:stop])
    except (ParseError, ValueError):  # of broken UTF-8 too
        return refuse(NO_OSC)
    return Message(message.address, message.params)


def _floats(arguments: list[Any], count: int) -> list[float]:
    """The first numbers of the arguments; more of them are for later versions of a protocol. Raises Fault for others."""
    values = arguments[:count]
    if len(values) < count or not all(isinstance(value, float | int) for value in values):
        raise Fault(WRONG_ARGUMENTS)
    return [float(value) for value in values]


_VMC_HEAD, _VMC_TIME = "/VMC/Ext/Hmd/Pos", "/VMC/Ext/T"
_VMC_DEVICES = (_VMC_HEAD, "/VMC/Ext/Con/Pos", "/VMC/Ext/Tra/Pos")
_LOCAL = "/Local"
_WITHOUT_GLOBAL_S = 0.5
"""Poses in the tracking space stand for missing ones in the world after so long."""


@dataclass
class _Tracker:
    """State of one device of the protocol."""

    global_s: float | None = None
    """When its pose in the world was last seen, or its first in the tracking space."""
    sent_s: float | None = None
    """The sender's time (s) of its newest packet that has one."""

    def wanted(self, local: bool, now_s: float) -> bool:
        """Whether to use a pose: one in the tracking space only where the device has none in the world."""
        if not local or self.global_s is None:
            self.global_s = now_s
            return not local
        return now_s - self.global_s > _WITHOUT_GLOBAL_S


class VmcSource(DatagramSource):
    """Head, controllers and trackers of VirtualMotionCapture and other senders of the VMC protocol."""

    scheme, port, hz = "vmc", 39540, 60.0
    convention = (
        "OSC /VMC/Ext/{Hmd,Con,Tra}/Pos: metres, quaternion x y z w; Unity's axes (left-handed, y up, z forward)"
    )
    known = frozenset(
        name.encode() for name in (_VMC_TIME, *_VMC_DEVICES, *(device + _LOCAL for device in _VMC_DEVICES))
    )

    def __init__(self, address: Address):
        super().__init__(address)
        self._head, self._trackers = _Tracker(), Names(lambda _: _Tracker())
        self._time_s: float | None = None

    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[Packet]:
        here_s: float | None = None
        poses: dict[str, tuple[_Tracker, Rigid | None, float | None]] = {}
        for address, arguments in osc_messages(data, self.known, refuse):
            with counted(refuse):
                if address == _VMC_TIME:
                    here_s = self._time(arguments)
                elif found := self._pose(address, arguments, arrived_s, refuse):
                    device, tracker, pose = found
                    poses[device] = (tracker, pose, self._time_s)
        for device, (tracker, pose, time_s) in poses.items():
            # A time in the datagram counts for all of it; an earlier one stands for one pose of each device.
            sent_s = here_s if here_s is not None else None if time_s == tracker.sent_s else time_s
            tracker.sent_s = tracker.sent_s if sent_s is None else sent_s
            yield _packet(self, device, sent_s, arrived_s, pose)

    def _time(self, arguments: list[Any]) -> float:
        (time_s,) = _floats(arguments, 1)
        require(time_fault(time_s))
        self._time_s = time_s
        return time_s

    def _pose(
        self, address: str, arguments: list[Any], arrived_s: float, refuse: Callable[[str], None]
    ) -> tuple[str, _Tracker, Rigid | None] | None:
        values = _floats(arguments[1:], 7)
        if address.startswith(_VMC_HEAD):
            tracker, device = self._head, HEAD
        else:
            tracker, device = self._trackers.entry(arguments[0], arrived_s), device_of(arguments[0])
        if not tracker.wanted(address.endswith(_LOCAL), arrived_s):
            return None
        quat_wxyz = [values[6], *values[3:6]]
        if untracked(values[:3], quat_wxyz):
            refuse(UNTRACKED)
            return (HEAD, tracker, None) if device == HEAD else None
        return device, tracker, pose_of(values[:3], quat_wxyz, "unity")


def _packet(source: DatagramSource, device: str, sent_s: float | None, arrived_s: float, pose: Rigid | None) -> Packet:
    """A packet of the head, or of a tracker that has a pose."""
    timestamp = arrived_s if sent_s is None else sent_s
    seen = HeadSample(timestamp, pose) if device == HEAD or pose is None else WristSample(device, timestamp, pose)
    return Packet(source.wearer, device, source.name, sent_s, arrived_s, seen)


_TRACKERS = (HEAD, *(str(number) for number in range(1, 9)))
PAIR_S = 0.008
"""A position and a rotation that arrive within so long belong together."""
NEWEST_S, UNPAIRED_S = 0.5, 0.1
"""Without a pair for the shorter time, the newest position and rotation are paired, none older than the longer one."""
MAX_ANGLE_DEG = 3600.0


@dataclass
class _Halves:
    """Position (m) and rotation (degrees) of a tracker, each with the time of its arrival until it is used."""

    position: list[float] | None = None
    rotation: list[float] | None = None
    position_s: float = -math.inf
    rotation_s: float = -math.inf
    fresh: frozenset[str] = frozenset()
    """The halves that are in no pair yet."""
    paired_s: float | None = None
    """When it last had a pair, or was first heard of."""


class OscTrackerSource(DatagramSource):
    """Trackers of SlimeVR and other senders of VRChat's OSC trackers."""

    scheme, port, hz = "osctrackers", 9000, 60.0
    convention = "OSC /tracking/trackers/{1…8,head}/{position,rotation}: metres, Euler degrees (z, x, y); Unity's axes"
    known = frozenset(
        f"/tracking/trackers/{tracker}/{half}".encode() for tracker in _TRACKERS for half in ("position", "rotation")
    )

    def __init__(self, address: Address):
        super().__init__(address)
        self._halves = {tracker: _Halves() for tracker in _TRACKERS}

    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[Packet | None]:
        touched: dict[str, None] = {}
        for address, arguments in osc_messages(data, self.known, refuse):
            with counted(refuse):
                values = _floats(arguments, 3)
                require(None if all(map(math.isfinite, values)) else NOT_FINITE)
                tracker, half = address.split("/")[3:]
                halves = self._halves[tracker]
                setattr(halves, half, values)
                setattr(halves, f"{half}_s", arrived_s)
                halves.fresh |= {half}
                halves.paired_s = arrived_s if halves.paired_s is None else halves.paired_s
                touched[tracker] = None
        for tracker in touched:
            with counted(refuse):
                yield self._paired(tracker, arrived_s)

    def _paired(self, tracker: str, arrived_s: float) -> Packet | None:
        halves = self._halves[tracker]
        if halves.position is None or halves.rotation is None or halves.paired_s is None:
            return None
        apart_s = abs(halves.position_s - halves.rotation_s)
        together = len(halves.fresh) == 2 and apart_s <= PAIR_S
        if not together and not (arrived_s - halves.paired_s > UNPAIRED_S and apart_s <= NEWEST_S):
            return None
        halves.fresh, halves.paired_s = frozenset(), arrived_s
        require(OUT_OF_RANGE if max(map(abs, halves.rotation)) > MAX_ANGLE_DEG else None)
        x, y, z = torch.tensor(halves.rotation).deg2rad()
        # Unity turns about z, then x, then y, each about the world's axis.
        R = about_axis("y", y) @ about_axis("x", x) @ about_axis("z", z)
        pose = checked_pose(halves.position, R, "unity")
        return _packet(self, HEAD if tracker == HEAD else f"tracker{tracker}", None, arrived_s, pose)
