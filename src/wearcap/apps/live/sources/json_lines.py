"""wearcap's own JSON for adapters, one object a message or a line, over UDP and WebSocket; docs/live_adapters.md shows it.

{"device": "head" | "left_wrist" | "right_wrist" | "camera" | any serial, "wearer", "time" (s), "clock",
 "position": [x, y, z], "rotation_wxyz": [w, x, y, z] or "matrix": [[…], […], […]], "axes": "wearcap" | "unity" | …,
 "lost": true, "points": [[x, y, z], …], "floor" (the head's), "acceleration": [x, y, z] (a watch's, which has no
 position), "confidence" (a camera's)}
{"device": "left_hand" | "right_hand", "wearer", "time", "clock", "axes", "joints": [[x, y, z], …], "confidence", "lost"}: the
 fingers of a tracked hand, 26 joints of OpenXR, 25 of WebXR (without the palm) or 21 of MediaPipe, in their order
{"object": NAME, "wearer", "time", "clock", "position", "rotation_wxyz" or "matrix", "axes"}: an observed pose of an object
{"active_object": NAME or null, "wearer", "time", "clock"}: which object is the active one from that time on
"""

import asyncio
import contextlib
import secrets
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import torch
from websockets.exceptions import ConnectionClosed

from wearcap.apps.live.packets import CAMERA, HANDS, HEAD, OBJECT, SUIT, Inbox, Packet, Sample
from wearcap.apps.live.source import Address, Budget, DatagramSource, Fault, counted, require
from wearcap.apps.live.sources.parts import AXES, BAD_NAME, Names, checked_pose, matrix_of
from wearcap.apps.web.connections import DELIVERING, SPOKEN
from wearcap.apps.web.guard import Guard
from wearcap.apps.web.sockets import serve_sockets
from wearcap.body.hands import HAND_JOINTS, MEDIAPIPE, OPENXR, in_layout
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.recording.recording import FingerStream
from wearcap.sensors.packets import MAX_ACC_M_S2, MAX_POSITION_M, WRONG_TYPE, number_fault, time_fault, values_fault
from wearcap.sensors.samples import (
    ActiveObject,
    HandSample,
    HeadSample,
    LocalizationSample,
    ObjectSample,
    WatchSample,
    WristSample,
)

MAX_LINES = 64
"""Objects of a message."""
MAX_MESSAGE, MAX_POINTS_MESSAGE = 1 << 16, 1 << 20
"""Bytes of a message over WebSocket; the larger one for messages with points."""
MAX_POINTS = 20_000
MAX_BYTES_PER_S = 1 << 22

NO_JSON = "no JSON object"
UNKNOWN_KEY = "unknown key"
UNKNOWN_AXES = "unknown axes"
NO_POSE = "no pose"
TOO_LARGE = "too large"
NO_DEVICE = "no device"
SEVERAL = "more than one of device, object and active_object"


_Vector = tuple[float, float, float]


class _Message(msgspec.Struct):
    """Layout of a message; its numbers may be too large or not finite."""

    device: str | None = None
    wearer: str | None = None
    clock: str | None = None
    object: str | None = None
    active_object: str | msgspec.UnsetType | None = msgspec.UNSET
    time: float | None = None
    position: _Vector | None = None
    rotation_wxyz: tuple[float, float, float, float] | None = None
    matrix: tuple[_Vector, _Vector, _Vector] | None = None
    axes: str = "wearcap"
    lost: bool | None = None
    points: list[_Vector] | None = None
    floor: float | None = None
    acceleration: _Vector | None = None
    confidence: float = 1.0
    joints: list[_Vector] | None = None


_LAYOUTS = {len(names): names for names in (OPENXR, HAND_JOINTS, MEDIAPIPE)}
_NAMES = ("device", "wearer", "clock", "object", "active_object")


class JsonSource(DatagramSource):
    """Whatever an adapter sends as JSON datagrams."""

    scheme, port, hz = "json", 9100, 60.0
    convention = "JSON: metres, m/s², seconds; quaternion w x y z; x forward, y left, z up unless it says other axes"

    def __init__(self, address: Address):
        super().__init__(address)
        self._names = {kind: Names() for kind in ("device", "object", "wearer", "clock")}

    def packets(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Iterator[Packet]:
        lines = [line for line in data.split(b"\n", MAX_LINES) if line.strip()]
        if len(lines) > MAX_LINES:
            refuse(TOO_LARGE)
        for line in lines[:MAX_LINES]:
            with counted(refuse):
                yield self._packet(line, arrived_s, refuse)

    def _packet(self, line: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Packet:
        try:
            content = parse_json(line, "message", "message")
        except WearcapError as error:
            raise Fault(NO_JSON) from error
        require(None if isinstance(content, dict) else NO_JSON)
        if not content.keys() <= set(_Message.__struct_fields__):
            refuse(UNKNOWN_KEY)  # and used without it
        try:
            message = msgspec.convert(content, _Message)
        except msgspec.ValidationError as error:
            key = str(error).rpartition("`$.")[2].rstrip("`")
            raise Fault(BAD_NAME if key in _NAMES else UNKNOWN_AXES if key == "axes" else WRONG_TYPE) from error
        if message.time is not None:
            require(time_fault(message.time))
        timestamp = arrived_s if message.time is None else message.time
        device, sample = self._about(message, timestamp, arrived_s)
        wearer = self._name("wearer", message.wearer, arrived_s) or self.wearer
        clock = self._name("clock", message.clock, arrived_s)
        own_clock = f"{self.name}/{clock}" if clock else self.name
        return Packet(wearer, device, own_clock, message.time, arrived_s, sample)

    def _about(self, message: _Message, timestamp: float, arrived_s: float) -> tuple[str, Sample]:
        """Device and sample of a message."""
        chosen = message.active_object
        device = self._name("device", message.device, arrived_s)
        name = self._name("object", message.object, arrived_s)
        if (chosen is not msgspec.UNSET) + (device is not None) + (name is not None) > 1:
            raise Fault(SEVERAL)
        if chosen is not msgspec.UNSET:
            return OBJECT, ActiveObject(self._name("object", chosen, arrived_s), timestamp)
        if message.axes not in AXES:
            raise Fault(UNKNOWN_AXES)
        if name is not None:
            return f"{OBJECT} {name}", ObjectSample(name, timestamp, _pose(message))
        if device == SUIT or device is None:
            raise Fault(NO_DEVICE)
        return device, _sample(device, timestamp, message)

    def _name(self, kind: str, name: str | None, arrived_s: float) -> str | None:
        """A name of a kind; None where there is none."""
        if not name:
            return None
        self._names[kind].entry(name, arrived_s)
        return name


def _sample(device: str, timestamp: float, message: _Message) -> Sample:
    if device == HEAD:
        pose, floor = None if message.lost else _pose(message), message.floor
        if floor is not None:
            require(number_fault(floor, MAX_POSITION_M))
        points = None if message.points is None else _points(message.points, message.axes)
        return HeadSample(timestamp, pose, points, floor_height=floor)
    if device in HANDS and (message.joints is not None or message.lost):
        return HandSample(HANDS[device], timestamp, _joints(message, timestamp))
    if message.lost:
        raise Fault(NO_POSE)
    if device == CAMERA:
        return LocalizationSample(timestamp, _pose(message), _confidence(message))
    if message.acceleration is None:
        return WristSample(device, timestamp, _pose(message))
    R = checked_pose((0.0, 0.0, 0.0), _rotation(message), message.axes).R
    acc = torch.tensor(message.acceleration)
    require(values_fault(acc, (3,), MAX_ACC_M_S2))
    return WatchSample(timestamp, R, AXES[message.axes] @ acc, device)


def _confidence(message: _Message) -> float:
    require(number_fault(message.confidence, 1.0))
    return max(0.0, message.confidence)


def _joints(message: _Message, timestamp: float) -> FingerStream:
    """A hand at one time."""
    rows = message.joints or [(0.0, 0.0, 0.0)] * len(OPENXR)
    require(None if len(rows) in _LAYOUTS else WRONG_TYPE)
    points = in_layout(_points(rows, message.axes)[None], _LAYOUTS[len(rows)])
    sure, time = torch.tensor([_confidence(message)]), torch.tensor([timestamp], dtype=torch.float64)
    return FingerStream(time, points, torch.tensor([not message.lost]), sure)


def _rotation(message: _Message) -> torch.Tensor:
    if message.rotation_wxyz is not None:
        return matrix_of(message.rotation_wxyz)
    require(NO_POSE if message.matrix is None else None)
    return torch.tensor(message.matrix)


def _pose(message: _Message) -> Rigid:
    if message.position is None:
        raise Fault(NO_POSE)
    return checked_pose(message.position, _rotation(message), message.axes)


def _points(rows: list[_Vector], axes: str) -> torch.Tensor:
    """Points of the surroundings, "point 3" (m)."""
    if len(rows) > MAX_POINTS:
        raise Fault(WRONG_TYPE)
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        points = torch.from_numpy(np.array(rows, np.float64).reshape(-1, 3).astype(np.float32))
    require(values_fault(points, (len(rows), 3), MAX_POSITION_M))
    return points @ AXES[axes].T


class WebSocketSource(JsonSource):
    """The same JSON over WebSocket. Beyond this machine only with the token that `url` shows (or `token=…` sets)."""

    scheme, port = "ws", 9101
    own_options = ("token",)

    def __init__(self, address: Address):
        super().__init__(address)
        given = address.options.get("token")
        self.token = given if given or self.loopback else secrets.token_urlsafe(18)
        self.budget = Budget(size=MAX_BYTES_PER_S)

    @property
    def url(self) -> str:
        return f"{super().url}/" + (f"?token={self.token}" if self.token else "")

    async def listen(self, inbox: Inbox) -> Callable[[], Awaitable[None]]:
        server = await serve_sockets(
            lambda connection: self._listen(connection, inbox),
            self.address.host,
            self.address.port,
            Guard.of(self.address.host, self.token or None),
            lambda why: inbox.refuse(self.name, why),
            MAX_POINTS_MESSAGE,
        )

        async def end() -> None:
            server.close()
            await server.wait_closed()

        return end

    async def _listen(self, connection: Any, inbox: Inbox) -> None:
        """Deliver what one adapter sends."""
        place = connection.place
        assert place is not None
        place.rise(SPOKEN)
        with contextlib.suppress(ConnectionClosed):
            async for message in connection:
                data = message.encode() if isinstance(message, str) else message
                if len(data) > MAX_MESSAGE and b'"points"' not in data:
                    inbox.refuse(self.name, TOO_LARGE)
                elif self.take(data, inbox, place):
                    place.rise(DELIVERING)
                await asyncio.sleep(0)
