"""The devices of one wearer: whose packets are admitted, their rates, and their poses as the page shows them."""

import math
import time
from collections.abc import Mapping, Sequence
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
FORGOTTEN_S = 60.0
"""Time without packets after which a device makes room for another."""
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


class Devices:
    """A wearer's devices by name, bounded: names come from the network."""

    def __init__(self, needed: Sequence[str]):
        """`needed`: those that are always admitted."""
        self.needed = tuple(needed)
        self._devices: dict[str, Device] = {}

    def admit(self, name: str) -> Device | None:
        """The device of a name, new where it was not known; None where there are too many."""
        if (known := self._devices.get(name)) is not None:
            return known
        if name not in self.needed and len(self._devices) >= MAX_DEVICES:
            others = (each for each in self._devices if each not in self.needed)
            oldest = min(others, key=lambda each: self._devices[each].arrived_s)
            if time.monotonic() - self._devices[oldest].arrived_s < FORGOTTEN_S:
                return None
            del self._devices[oldest]
        device = self._devices[name] = Device()
        return device

    def get(self, name: str) -> Device | None:
        """The device of a name, if it is known."""
        return self._devices.get(name)

    @property
    def late(self) -> int:
        """Packets of all of them that came after newer ones."""
        return sum(device.late for device in list(self._devices.values()))

    def status(self, seats: Mapping[str, Seat]) -> tuple[DeviceStatus, ...]:
        """All of them, for the page; any thread may ask. `seats`: by device, as far as they are known."""
        now_s = time.monotonic()
        return tuple(device.status(name, seats.get(name), now_s) for name, device in list(self._devices.items()))


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
