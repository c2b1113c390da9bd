"""One device of a wearer: its rate, how late its packets are, and its pose as the page shows it."""

import math
from dataclasses import dataclass

import torch

from wearcap.apps.live.packets import Packet, Sample
from wearcap.apps.live.setup import Seat
from wearcap.apps.live.status import DeviceStatus
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.samples import HeadSample, LocalizationSample, ObjectSample, WatchSample, WristSample

MAX_DEVICES = 32
"""Most devices of a wearer, beside those that the session needs."""
LATE_S = 1.0
"""Time by which a packet may be behind the newest one and be late; beyond it the device's clock was set back."""
RATE_S = 2.0
"""Time over which rates are averaged."""


@dataclass(eq=False)
class Device:
    """What is known of one device."""

    clock: str = ""
    """Clock of its newest packet."""
    arrived_s: float = -math.inf
    count: int = 0
    """Packets since `since_s`."""
    since_s: float = 0.0
    hz: float = 0.0
    newest_s: float = -math.inf
    """Newest time (s) on the leading clock."""
    late: int = 0
    """Packets that came after newer ones."""
    pose: Rigid | None = None

    def see(self, packet: Packet, clock: str, time_s: float) -> None:
        """A packet has come, which counts as of a time (s) on the leading clock."""
        self.since_s = self.since_s or packet.arrived_s
        self.count += 1
        if packet.arrived_s - self.since_s >= RATE_S:
            self.hz = self.count / (packet.arrived_s - self.since_s)
            self.count, self.since_s = 0, packet.arrived_s
        self.clock, self.arrived_s = clock, packet.arrived_s
        late = self.newest_s - LATE_S < time_s <= self.newest_s
        self.late += int(late)
        self.newest_s = self.newest_s if late else time_s
        self.pose = _shown(packet.sample) or self.pose

    def status(self, name: str, seat: Seat | None, now_s: float) -> DeviceStatus:
        """What the page shows; a watch's own world is turned to the head's once its seat is known."""
        silent_s = now_s - self.arrived_s
        hz, pose = self.hz or self.count / max(now_s - self.since_s, RATE_S), self.pose
        if pose is not None and seat is not None and seat.yaw_rad:
            pose = Rigid(rotation.about_axis("z", torch.tensor(seat.yaw_rad)) @ pose.R, pose.t)
        joint = None if seat is None else seat.joint
        return DeviceStatus(name, 0.0 if silent_s > RATE_S else hz, pose, silent_s, joint)


def _shown(sample: Sample) -> Rigid | None:
    """The pose that the page shows of a sample; a watch has no place."""
    match sample:
        case HeadSample():
            return sample.T_world_device
        case WristSample():
            return sample.T_world_joint
        case WatchSample():
            return Rigid(sample.R_world_imu, torch.full((3,), torch.nan))
        case LocalizationSample():
            return sample.T_world_cam
        case ObjectSample():
            return sample.T_world_object
    return None
