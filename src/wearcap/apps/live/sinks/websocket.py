"""The body as JSON over WebSocket, to any number of clients.

The first message of a client describes each wearer: {"skeleton": {"wearer", "joints", "parents", "offsets"}, "fps"}; every
frame follows as {"wearer", "time", "root": [x, y, z], "rotations_wxyz": [[w, x, y, z], …], "contact": [0…1 of left heel,
left toe tip, right heel, right toe tip] or null}: rotations relative to the parent joint, in wearcap's axes (z up, metres).
Frames of a system that says how sure it is of each joint also have {"joint_std": [m, …], "joint_dof": number or null}, as a Motion.
Frames with objects also have "objects": {NAME: {"position": [x, y, z], "rotation_wxyz": [w, x, y, z], "contact": 0…1 or
null}}: the pose of the object's mesh in the world, and the largest probability that a point of the body touches it.
"""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, broadcast

from wearcap.apps.live.pacing import Pacing
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sinks.objects import SeenObject, objects_of
from wearcap.apps.live.source import Address, Addressed
from wearcap.apps.web.connections import DELIVERING, SPOKEN
from wearcap.apps.web.guard import LOOPBACK, Guard
from wearcap.apps.web.loop import LoopThread
from wearcap.apps.web.sockets import serve_sockets
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.recording import Motion

CLOSE_S = 2.0
"""Time in which clients may close their connections at the end, before that is done for them."""
MAX_CLIENT_BYTES = 1024
"""Bytes of a message from a client, which nobody reads."""
MAX_WAITING_BYTES = 1 << 20
"""Bytes that may wait for one client; a client that reads more slowly is disconnected."""


class WebSocketSink(Sink, Addressed):
    """Serves frames on an address; beyond loopback a client gives the token of the printed address."""

    port, serves = 9102, True
    convention = "JSON; wearcap's axes (x forward, y left, z up), metres, quaternions wxyz"

    def __init__(self, address: Address, pace: bool = True):
        """Raises WearcapError for options that the sink does not have."""
        address.require_options()
        self.address, self.guard = address, Guard(address.host, open=address.host in LOOPBACK)
        self.name = f"ws://{address.host}:{address.port}"
        self.open_to_others = address.host not in LOOPBACK
        self.pace, self._paces = pace, dict[str, tuple[Pacing, float]]()
        """By wearer, when frames are due and the time of one (s): those of several are sent side by side."""
        self._server: Server | None = None
        self._last_s = 0.0
        """Our time (s) at which the last frame so far is due."""
        self._clients: set[ServerConnection] = set()
        self._about: dict[str, str] = {}
        self.slow = 0
        """Number of clients disconnected because they read too slowly."""

    @property
    def url(self) -> str:
        """Address for clients, with the token where one is needed."""
        if self.guard.open:
            return self.name
        return self.guard.url(self.address.port).replace("http://", "ws://", 1)

    def open(self) -> None:
        self._thread = LoopThread(self.name)
        self._loop, (host, port) = self._thread.loop, (self.address.host, self.address.port)
        try:
            serving = serve_sockets(self._client, host, port, self.guard, lambda _: None, MAX_CLIENT_BYTES)
            self._server = self._thread.start(serving).result()
        except (OSError, UnicodeError) as error:  # the latter of a host's name
            self._thread.stop()
            what = f"cannot serve here ({getattr(error, 'strerror', None) or error})"
            raise WearcapError(what, self.name, fix="Choose another port.") from error

    def begin(self, wearer: str, skeleton: Skeleton, fps: float) -> None:
        self._paces[wearer] = Pacing(self.pace), 1 / fps
        offsets = [[round(each, 6) for each in row] for row in skeleton.t_parent_joint.tolist()]
        names, parents = list(skeleton.joint_names), list(skeleton.parents)
        about = {"wearer": wearer, "joints": names, "parents": parents, "offsets": offsets}
        text = json.dumps({"skeleton": about, "fps": fps})
        self._loop.call_soon_threadsafe(self._describe, wearer, text)

    def take(self, wearer: str, motion: Motion) -> None:
        objects = objects_of(motion)
        pacing, step_s = self._paces[wearer]
        hurry = pacing.behind(len(motion), step_s)
        for k in range(len(motion)):
            due_s = pacing.due(step_s, hurry)
            if self._clients:
                self._at(due_s, self._send_frame, _frame(wearer, motion, k, objects[k]))

    def _at(self, due_s: float, call: Callable[..., None], *arguments: str) -> None:
        """Call something on the server's loop at our time (s); the loop's clock is the same."""
        self._last_s = max(self._last_s, due_s)
        self._loop.call_soon_threadsafe(self._loop.call_at, due_s, call, *arguments)

    def end(self, wearer: str) -> None:
        pacing, step_s = self._paces.pop(wearer, (Pacing(False), 0.0))
        self._at(pacing.due(step_s, False), self._leave, wearer)

    def close(self) -> None:
        """Returns once the last frame has been sent when it is due, and clients have left."""

        async def end(server: Server) -> None:
            await asyncio.sleep(max(0.0, self._last_s - time.monotonic()))
            server.close()
            with suppress(TimeoutError):
                await asyncio.wait_for(server.wait_closed(), CLOSE_S)
            for client in list(self._clients):  # that do not read
                client.transport.abort()
            with suppress(TimeoutError):
                await asyncio.wait_for(server.wait_closed(), CLOSE_S)

        if self._server is not None:
            self._thread.start(end(self._server)).result()
            self._thread.stop()

    async def _client(self, connection: Any) -> None:
        connection.place.rise(DELIVERING if self.open_to_others else SPOKEN)  # with its token it is the user's
        self._clients.add(connection)
        try:
            for about in list(self._about.values()):
                await connection.send(about)
            async for _ in connection:  # whatever a client says is ignored
                pass
        finally:
            self._clients.discard(connection)

    def _describe(self, wearer: str, text: str) -> None:
        self._about[wearer] = text
        self._broadcast(text)

    def _leave(self, wearer: str) -> None:
        self._about.pop(wearer, None)
        self._broadcast(json.dumps({"left": wearer}))

    def _send_frame(self, frame: str) -> None:
        self._broadcast(frame)
        self.sent += bool(self._clients)

    def _broadcast(self, text: str) -> None:
        for client in list(self._clients):
            if client.transport.get_write_buffer_size() > MAX_WAITING_BYTES:
                self.slow += 1
                self._clients.discard(client)
                client.transport.abort()
        broadcast(self._clients, text)


def _frame(wearer: str, motion: Motion, k: int, objects: dict[str, SeenObject]) -> str:
    """The message of one frame of a motion."""
    wxyz, contact = quat_wxyz_from_matrix(motion.R_parent_joint[k].double()), motion.contact_prob
    frame = {
        "wearer": wearer,
        "time": motion.timestamps[k].item(),
        "root": [round(each, 5) for each in motion.t_world_root[k].tolist()],
        "rotations_wxyz": [[round(each, 6) for each in row] for row in wxyz.tolist()],
        "contact": None if contact is None else [round(each, 3) for each in contact[k].tolist()],
    }
    if motion.joint_std is not None:
        frame |= {"joint_std": [round(each, 4) for each in motion.joint_std[k].tolist()], "joint_dof": motion.joint_dof}
    if motion.fingers_measured is not None:
        frame["fingers_measured"] = [bool(each) for each in motion.fingers_measured[k].tolist()]
    if objects:
        frame["objects"] = {name: _row(seen) for name, seen in objects.items()}
    return json.dumps(frame)


def _row(seen: SeenObject) -> dict[str, Any]:
    pose, wxyz = seen.T_world_object, quat_wxyz_from_matrix(seen.T_world_object.R.double())
    return {
        "position": [round(each, 5) for each in pose.t.tolist()],
        "rotation_wxyz": [round(each, 6) for each in wxyz.tolist()],
        "contact": None if seen.contact is None else round(seen.contact, 3),
    }
