"""Devices of a wearer on the live page: axes and names, shown as late as the body, so that they sit on it."""

import math
from collections import deque

import numpy as np
import viser
from jaxtyping import Float

from wearcap.apps.live.status import DeviceStatus
from wearcap.apps.viewer.page_layers import BodyLayer
from wearcap.apps.web.page_text import fitting
from wearcap.geometry.rotation import quat_wxyz_from_matrix

MAX_SHOWN = 16
"""Most devices of one wearer that are shown."""
AXES_M, LABEL_M = 0.13, 0.05
"""Length of the axes, and height of the names (m)."""
KEPT = 40
"""Number of newest places that are kept of a device."""
MAX_DELAY_S = 2.0


class Device:
    """One device: its node, and where it was lately."""

    def __init__(self, server: viser.ViserServer, node: str, device: DeviceStatus):
        self.joint = device.name
        """Joint that wears it, or its name until that is known."""
        self.frame = server.scene.add_frame(
            node, axes_length=AXES_M, axes_radius=0.006, origin_radius=0.012, visible=False
        )
        self.label = server.scene.add_label(
            f"{node}/name", _plain(self.joint), anchor="bottom-left", font_size_mode="scene", font_scene_height=LABEL_M
        )
        self._path: deque[tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "4"]]] = deque(maxlen=KEPT)

    def see(self, device: DeviceStatus, now_s: float) -> None:
        """Keep where it is now; one without a pose is not shown."""
        if device.joint is not None and device.joint != self.joint:
            self.joint, self.label.text = device.joint, _plain(device.joint)
        pose = device.T_world_device
        if pose is None or not bool(pose.R.isfinite().all()):
            self._path.clear()
            return
        wxyz = quat_wxyz_from_matrix(pose.R.double()).numpy()
        self._path.append((now_s, pose.t.double().numpy().reshape(3), wxyz))

    def show(self, at_s: float, visible: bool, body: BodyLayer | None) -> None:
        """Show where it was at a time (s) of the screen; a watch, which has no place, is at its wrist of the `body`."""
        found = self._at(at_s) if visible else None
        place = None if found is None else found[0]
        if place is not None and not np.isfinite(place).all():
            skeleton = None if body is None else body.motion.skeleton
            place = None
            if body is not None and body.handle.visible and skeleton is not None and self.joint in skeleton:
                bone = body.handle.bones[skeleton.index(self.joint)]
                place = np.asarray(body.handle.position) + np.asarray(bone.position)
        if self.frame.visible != (place is not None):
            self.frame.visible = place is not None
        if found is not None and place is not None:
            self.frame.position, self.frame.wxyz = place, found[1]

    def _at(self, at_s: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Place and rotation at a time, between the two that were seen around it; the ends beyond them."""
        after = next((number for number, seen in enumerate(self._path) if seen[0] >= at_s), len(self._path))
        if not self._path:
            return None
        if after in (0, len(self._path)):
            return self._path[min(after, len(self._path) - 1)][1:]
        (before_s, before, turned), (after_s, later, turned_later) = self._path[after - 1], self._path[after]
        share = (at_s - before_s) / max(after_s - before_s, 1e-6)
        if turned @ turned_later < 0:
            turned_later = -turned_later
        wxyz = (1 - share) * turned + share * turned_later
        return (1 - share) * before + share * later, wxyz / max(float(np.linalg.norm(wxyz)), 1e-6)


class Devices:
    """The devices of one wearer."""

    def __init__(self, node: str):
        """`node` is their parent's name."""
        self.node = node
        self.known: dict[str, Device] = {}

    def see(self, server: viser.ViserServer, devices: tuple[DeviceStatus, ...], now_s: float) -> None:
        """Take in where they are now; those that are gone are hidden."""
        for device in devices[:MAX_SHOWN]:
            if device.name not in self.known and len(self.known) < MAX_SHOWN:
                self.known[device.name] = Device(server, f"{self.node}/{len(self.known)}", device)
            if device.name in self.known:
                self.known[device.name].see(device, now_s)
        for name in self.known.keys() - {device.name for device in devices}:
            self.known[name].see(DeviceStatus(name, 0.0), now_s)

    def show(self, now_s: float, delay_s: float, visible: bool, body: BodyLayer | None) -> None:
        """Show them as they were `delay_s` ago."""
        delay_s = min(max(delay_s, 0.0), MAX_DELAY_S) if math.isfinite(delay_s) else 0.0
        for device in self.known.values():
            device.show(now_s - delay_s, visible, body)


def _plain(name: str) -> str:
    """A joint's or device's name as a label."""
    return fitting(name).replace("_", " ")
