"""wearcap's own JSON for adapters, one object a message or a line, over UDP and WebSocket; docs/live_adapters.md shows it.

{"device": "head" | "left_wrist" | "right_wrist" | "camera" | any serial, "wearer", "time" (s), "clock",
 "position": [x, y, z], "rotation_wxyz": [w, x, y, z] or "matrix": [[…], […], […]], "axes": "wearcap" | "unity" | …,
 "lost": true, "points": [[x, y, z], …], "floor" (the head's), "acceleration": [x, y, z] (a watch's, which has no
 position), "confidence" (a camera's)}
{"object": NAME, "wearer", "time", "clock", "position", "rotation_wxyz" or "matrix", "axes"}: an observed pose of an object
{"active_object": NAME or null, "wearer", "time", "clock"}: which object is the active one from that time on
"""

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

import numpy as np
import torch
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.live.packets import CAMERA, HEAD, OBJECT, SUIT, Inbox, Packet, Sample
from wearcap.live.source import Address, Budget, DatagramSource
from wearcap.live.sources.parts import AXES, MAX_LISTS, Names, bounded_json, checked_pose, matrix_of
from wearcap.live.sources.posts import admitting
from wearcap.sensors.packets import MAX_ACC_M_S2, MAX_POSITION_M, WRONG_TYPE, number_fault, time_fault, values_fault
from wearcap.sensors.samples import ActiveObject, HeadSample, LocalizationSample, ObjectSample, WatchSample, WristSample
from wearcap.viewer.guard import Refused

MAX_LINES = 64
"""Objects of a message."""
MAX_MESSAGE, MAX_POINTS_MESSAGE = 1 << 16, 1 << 20
"""Bytes of a message over WebSocket; the larger one for messages with points."""
MAX_BYTES_PER_S = 1 << 22
MAX_CONNECTIONS = 16
_KEYS = {
    *("device", "wearer", "time", "clock", "position", "rotation_wxyz", "matrix", "axes", "lost"),
    *("points", "floor", "acceleration", "confidence", "object", "active_object"),
}

_QUIET = logging.Logger("wearcap.live", logging.CRITICAL + 1)
"""What goes wrong with a connection is counted, not printed."""

NO_JSON = "no JSON object"
UNKNOWN_KEY = "unknown key"
UNKNOWN_AXES = "unknown axes"
NO_POSE = "no pose"
TOO_LARGE = "too large"
NO_DEVICE = "no device"
SEVERAL = "more than one of device, object and active_object"


class _Fault(Exception):
    """Why a message cannot be used."""


class JsonSource(DatagramSource):
    """Whatever an adapter sends as JSON datagrams."""

    scheme, port, hz = "json", 9100, 60.0
    convention = "JSON: metres, m/s², seconds; quaternion w x y z; x forward, y left, z up unless it says other axes"
    own_options: tuple[str, ...] = ()

    def __init__(self, address: Address):
        super().__init__(address)
        address.require_options(*self.own_options)
        self._names = {kind: Names() for kind in ("device", "object", "wearer", "clock")}

    def parse(self, data: bytes, arrived_s: float, refuse: Callable[[str], None]) -> list[Packet]:
        packets = []
        lines = [line for line in data.split(b"\n", MAX_LINES) if line.strip()]
        if len(lines) > MAX_LINES:
            refuse(TOO_LARGE)
        for line in lines[:MAX_LINES]:
            try:
                packets.append(self._packet(line, arrived_s, refuse))
            except WearcapError:
                refuse(NO_JSON)
            except _Fault as fault:
                refuse(str(fault))
        return packets

    def _packet(self, line: bytes, arrived_s: float, refuse: Callable[[str], None]) -> Packet:
        content = bounded_json(line)
        if not isinstance(content, dict):
            raise _Fault(NO_JSON)
        if not content.keys() <= _KEYS:
            refuse(UNKNOWN_KEY)  # and used without it
        sent_s = content.get("time")
        if sent_s is not None:
            _require(WRONG_TYPE if isinstance(sent_s, bool) else time_fault(sent_s))
        device, sample = self._about(content, float(arrived_s if sent_s is None else sent_s), arrived_s)
        wearer = self._name(content, "wearer", arrived_s) or self.wearer
        clock = self._name(content, "clock", arrived_s)
        own_clock = f"{self.name}/{clock}" if clock else self.name
        return Packet(wearer, device, own_clock, None if sent_s is None else float(sent_s), arrived_s, sample)

    def _about(self, content: dict[str, Any], timestamp: float, arrived_s: float) -> tuple[str, Sample]:
        """Device and sample of a message."""
        device, name = (self._name(content, key, arrived_s) for key in ("device", "object"))
        if ("active_object" in content) + (device is not None) + (name is not None) > 1:
            raise _Fault(SEVERAL)
        if "active_object" in content:
            return OBJECT, ActiveObject(self._name(content, "active_object", arrived_s, "object"), timestamp)
        if name is not None:
            return f"{OBJECT} {name}", ObjectSample(name, timestamp, _pose(content, _axes(content)))
        if device == SUIT or device is None:
            raise _Fault(NO_DEVICE)
        return device, self._sample(device, timestamp, content)

    def _name(self, content: dict[str, Any], key: str, arrived_s: float, kind: str = "") -> str | None:
        """The name that a key holds; `kind`: of which it is one, if not the key itself."""
        name = content.get(key)
        if name is None or name == "":
            return None
        _require(self._names[kind or key].fault(name, arrived_s))
        return name

    def _sample(self, device: str, timestamp: float, content: dict[str, Any]) -> Sample:
        axes = _axes(content)
        if device == HEAD:
            pose = None if content.get("lost") is True else _pose(content, axes)
            floor = content.get("floor")
            if floor is not None:
                _require(WRONG_TYPE if isinstance(floor, bool) else number_fault(floor, MAX_POSITION_M))
            points = _points(content["points"], axes) if content.get("points") is not None else None
            return HeadSample(timestamp, pose, points, floor_height=None if floor is None else float(floor))
        if content.get("lost") is True:
            raise _Fault(NO_POSE)
        if device == CAMERA:
            confidence = content.get("confidence", 1.0)
            _require(WRONG_TYPE if isinstance(confidence, bool) else number_fault(confidence, 1.0))
            return LocalizationSample(timestamp, _pose(content, axes), max(0.0, float(confidence)))
        if content.get("acceleration") is None:
            return WristSample(device, timestamp, _pose(content, axes))
        R = checked_pose((0.0, 0.0, 0.0), _rotation(content), axes)
        acc = torch.tensor(_numbers(content["acceleration"], 3))
        _require(R if isinstance(R, str) else values_fault(acc, (3,), MAX_ACC_M_S2))
        assert isinstance(R, Rigid)
        return WatchSample(timestamp, R.R, AXES[axes] @ acc, device)


def _require(fault: str | None) -> None:
    if fault is not None:
        raise _Fault(fault)


def _numbers(values: object, count: int) -> list[float]:
    """A list of so many numbers, which may be too large or not finite."""
    if not isinstance(values, list) or len(values) != count:
        raise _Fault(WRONG_TYPE)
    if not all(type(value) is float or type(value) is int for value in values):
        raise _Fault(WRONG_TYPE)
    return [float(value) for value in values]


def _axes(content: dict[str, Any]) -> str:
    axes = content.get("axes", "wearcap")
    if not isinstance(axes, str) or axes not in AXES:
        raise _Fault(UNKNOWN_AXES)
    return axes


def _rotation(content: dict[str, Any]) -> torch.Tensor:
    if content.get("rotation_wxyz") is not None:
        R = matrix_of(_numbers(content["rotation_wxyz"], 4))
        if isinstance(R, str):
            raise _Fault(R)
        return R
    rows = content.get("matrix")
    if not isinstance(rows, list) or len(rows) != 3:
        raise _Fault(NO_POSE if rows is None else WRONG_TYPE)
    return torch.tensor([_numbers(row, 3) for row in rows])


def _pose(content: dict[str, Any], axes: str) -> Rigid:
    if content.get("position") is None:
        raise _Fault(NO_POSE)
    pose = checked_pose(_numbers(content["position"], 3), _rotation(content), axes)
    if isinstance(pose, str):
        raise _Fault(pose)
    return pose


def _points(rows: object, axes: str) -> torch.Tensor:
    """Points of the surroundings, "point 3" (m)."""
    if not isinstance(rows, list) or len(rows) > MAX_LISTS:
        raise _Fault(WRONG_TYPE)
    try:
        values = np.asarray(rows if rows else np.zeros((0, 3)))
    except ValueError as error:  # rows of several lengths
        raise _Fault(WRONG_TYPE) from error
    if values.dtype.kind not in "iuf" or values.shape != (len(rows), 3):
        raise _Fault(WRONG_TYPE)
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        points = torch.from_numpy(values.astype(np.float32))
    _require(values_fault(points, (len(rows), 3), MAX_POSITION_M))
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
        self._open = 0

    @property
    def url(self) -> str:
        return f"{super().url}/" + (f"?token={self.token}" if self.token else "")

    async def run(self, inbox: Inbox) -> None:
        admit = admitting(self.address.host, self.token or None)

        def admitted(connection: ServerConnection, request: Request) -> Response | None:
            """An answer that ends a handshake, or None to go on."""
            try:
                admit(request.path, request.headers)
            except Refused as refused:
                inbox.refuse(self.name, "forbidden")
                return connection.respond(HTTPStatus.FORBIDDEN, f"{refused}\n")
            if self._open >= MAX_CONNECTIONS:
                inbox.refuse(self.name, "too many connections")
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections\n")
            return None

        try:
            server = await self._server(lambda connection: self._listen(connection, inbox), admitted)
        except OSError as error:
            raise self.cannot_listen(error) from error
        self.listens = True
        try:
            await asyncio.Event().wait()
        finally:
            server.close()
            await server.wait_closed()

    async def _server(self, listen: Any, admitted: Any) -> Server:
        return await serve(
            listen,
            self.address.host,
            self.address.port,
            process_request=admitted,
            compression=None,  # a small message could unpack to a large one
            max_size=MAX_POINTS_MESSAGE,
            max_queue=16,
            open_timeout=5,
            close_timeout=1,
            server_header=None,
            logger=_QUIET,
        )

    async def _listen(self, connection: ServerConnection, inbox: Inbox) -> None:
        """Deliver what one adapter sends."""

        def refuse(why: str) -> None:
            inbox.refuse(self.name, why)

        self._open += 1
        try:
            with contextlib.suppress(ConnectionClosed):
                async for message in connection:
                    data = message.encode() if isinstance(message, str) else message
                    if len(data) > MAX_MESSAGE and b'"points"' not in data:
                        refuse(TOO_LARGE)
                    else:
                        self.take(data, inbox)
                    await asyncio.sleep(0)
        finally:
            self._open -= 1
