"""Devices of a wearer on the live page: axes and names, shown as late as the body, so that they sit on it."""

import math
from collections import deque

import numpy as np
import torch
import viser

from wearcap.apps.live.status import DeviceStatus
from wearcap.apps.viewer.page_layers import BodyLayer
from wearcap.apps.web.page_text import fitting
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import interpolate_clamped, slerp

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
        self._path: deque[tuple[float, Rigid]] = deque(maxlen=KEPT)

    def see(self, device: DeviceStatus, now_s: float) -> None:
        """Keep where it is now; one without a pose is not shown."""
        self.joint = device.joint or self.joint
        self.label.text = _plain(self.joint)
        pose = device.T_world_device
        if pose is None or not bool(pose.R.isfinite().all()):
            self._path.clear()
        else:
            self._path.append((now_s, Rigid(pose.R.double(), pose.t.double().reshape(3))))

    def show(self, at_s: float, visible: bool, body: BodyLayer | None) -> None:
        """Show where it was at a time (s) of the screen; a watch, which has no place, is at its wrist of the `body`."""
        found = self._at(at_s) if visible and self._path else None
        place = None if found is None else found.t.numpy()
        if place is not None and not np.isfinite(place).all():
            skeleton = None if body is None else body.motion.skeleton
            place = None
            if body is not None and body.handle.visible and skeleton is not None and self.joint in skeleton:
                bone = body.handle.bones[skeleton.index(self.joint)]
                place = np.asarray(body.handle.position) + np.asarray(bone.position)
        self.frame.visible = place is not None
        if found is not None and place is not None:
            self.frame.position, self.frame.wxyz = place, quat_wxyz_from_matrix(found.R).numpy()

    def _at(self, at_s: float) -> Rigid:
        """Pose at a time, between the two that were seen around it; the ends beyond them."""
        times = torch.tensor([seen_s for seen_s, _ in self._path], dtype=torch.float64)
        R, t = (torch.stack([getattr(pose, part) for _, pose in self._path]) for part in ("R", "t"))
        at = torch.tensor([at_s], dtype=torch.float64)
        return Rigid(slerp(times, R, at)[0], interpolate_clamped(times, t, at)[0])


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
