"""One wearer of a live capture: clocks, first minute, session, and the counts that the page and the report show."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.live.clocks import Clocks
from wearcap.live.first_minute import FirstMinute
from wearcap.live.latency import Latencies
from wearcap.live.packets import HEAD, SUIT, Packet
from wearcap.live.setup import Seat, Setup
from wearcap.live.status import MAX_POINTS, DeviceStatus, Stage, WearerStatus
from wearcap.recording import Motion
from wearcap.runtime.session import Session
from wearcap.runtime.wearer import Wearer
from wearcap.sensors.samples import HeadSample, LocalizationSample, SuitPiece, WatchSample, WristSample
from wearcap.tracking.head_path import MAX_GAP_S

AWAY_S = 5.0
"""Time without packets after which a wearer has left: the last poses are returned, and the next packet begins anew."""
BEHIND_S = 2.0
"""Time for which packets may wait before the page says that the machine is too slow."""
MAX_DEVICES = 32
"""Most devices of a wearer; packets of further ones are counted as unknown."""
RATE_S = 2.0
"""Time over which rates are averaged."""
ARRIVAL = "arrival"
"""Clock of packets that state no time."""


@dataclass(frozen=True)
class Opener:
    """How a capture opens a session, and what it knows of every wearer."""

    session: Callable[[Wearer], Session]
    devices: tuple[str, ...]
    """Devices that the session needs; the first one's clock times the motion."""
    tracks_wrists: bool
    first_minute: Callable[[Setup | None, bool], FirstMinute]
    """(set-up of last time, whether guided) → a new first minute."""


@dataclass(eq=False)
class _Device:
    """What is known of one device."""

    arrived_s: float = -np.inf
    count: int = 0
    since_s: float = 0.0
    hz: float = 0.0
    newest_s: float = -np.inf
    """Newest device time."""
    late: int = 0
    pose: Rigid | None = None

    def see(self, packet: Packet, time_s: float) -> None:
        if not self.since_s:
            self.since_s = packet.arrived_s
        self.count += 1
        if packet.arrived_s - self.since_s >= RATE_S:
            self.hz = self.count / (packet.arrived_s - self.since_s)
            self.count, self.since_s = 0, packet.arrived_s
        self.arrived_s = packet.arrived_s
        if time_s <= self.newest_s and self.newest_s - time_s < 1.0:
            self.late += 1
        self.newest_s = time_s


@dataclass(eq=False)
class LiveWearer:
    """Takes a wearer's packets and returns poses; never raises for what arrives."""

    name: str
    opener: Opener
    setup: Setup | None = None
    """Known from the beginning; None: the first minute finds it."""
    stage: Stage = "waiting"
    frames: int = 0
    gaps: int = 0
    sessions: int = 0
    """How often the capture of this wearer began."""
    unknown: int = 0
    """Number of packets of devices that nobody wears."""
    latencies: Latencies = field(default_factory=Latencies)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clocks = Clocks()
        self.first: FirstMinute | None = None
        self.session: Session | None = None
        self.skeleton: Skeleton | None = None
        self.fps = 0.0
        self._devices: dict[str, _Device] = {}
        self._heard_s = -np.inf
        self._head_s = -np.inf
        self._points: Tensor | None = None
        self._dropped = 0
        """Packets that earlier sessions refused or dropped."""
        self._last: Motion | None = None

    # --- packets ----------------------------------------------------------------------------------------------------

    def take(self, packet: Packet) -> None:
        """Take in one packet."""
        clock, sent_s = (ARRIVAL, packet.arrived_s) if packet.sent_s is None else (packet.clock, packet.sent_s)
        if packet.device not in self._devices:
            if len(self._devices) >= MAX_DEVICES:
                self.unknown += 1
                return
            self._devices[packet.device] = _Device()
        leads = packet.device == self.opener.devices[0]
        if leads and self.clocks.leader is None:
            self.clocks.leader = clock
        self.clocks.see(clock, sent_s, packet.arrived_s)
        time_s = self.clocks.on_leader(clock, sent_s)
        device = self._devices[packet.device]
        device.see(packet, time_s)
        now_s = time.monotonic()
        self._heard_s = max(packet.arrived_s, now_s)  # of a capture that is behind, packets wait
        if now_s - packet.arrived_s > BEHIND_S:
            self._note(
                "The capture is slower than the packets come: end other programs, or give it more cores (threads=N)."
            )
        sample = _timed(packet.sample, time_s)
        device.pose = _shown(sample) or device.pose
        if leads:
            self.gaps += MAX_GAP_S < time_s - self._head_s < AWAY_S
            self._head_s = time_s
        if isinstance(sample, HeadSample) and sample.points_world is not None and len(sample.points_world):
            self._keep_points(sample.points_world)
        if self.session is None and not self._is_prepared(packet.device, sample, packet.arrived_s):
            return
        assert self.session is not None
        if (seated := self._seated(packet.device, sample)) is None:
            self.unknown += 1
        else:
            try:
                self.session.push([[seated]])
            except WearcapError as error:
                self._note(str(error))

    def _is_prepared(self, device: str, sample: Any, now_s: float) -> bool:
        """Look for the set-up, and open the session once it is known."""
        if self.setup is None or (self.first is not None and self.first.found is None):
            if self.first is None:
                self.first = self.opener.first_minute(None, False)
            self.stage = "first minute"
            self.first.see(device, sample, now_s)
            if self.first.found is None:
                return False
            self.setup = self.first.found
            for note in self.setup.notes:
                self._note(note)
        self._open(self.setup)
        return True

    def _open(self, setup: Setup) -> None:
        head = next((seat for seat in setup.seats.values() if seat.joint == HEAD), None)
        mounts = {seat.joint: seat.R_joint_device for seat in setup.seats.values() if seat.joint != HEAD}
        placed = {} if head is None else {"R_head_device": head.R_joint_device, "t_head_device": head.t_joint_device}
        wearer = Wearer(setup.skeleton, R_wrist_imu=mounts, floor_m=setup.floor_m, **placed)
        self.session, self.skeleton, self.stage = self.opener.session(wearer), setup.skeleton, "live"
        self.sessions, self.fps = self.sessions + 1, self.session.fps

    def _seated(self, device: str, sample: Any) -> Any:
        """A device's sample as the session takes it, on the joint that wears it; None for a device that nobody wears."""
        assert self.setup is not None
        seat = self.setup.seats.get(device)
        match sample:
            case HeadSample():
                floor_m = self.setup.floor_m if sample.floor_height is None else sample.floor_height
                return sample._replace(floor_height=floor_m)
            case WristSample() if seat is not None and self.opener.tracks_wrists:
                T_joint_device = Rigid(seat.R_joint_device, seat.t_joint_device)
                return sample._replace(joint=seat.joint, T_world_joint=sample.T_world_joint @ T_joint_device.inverse())
            case WatchSample() if seat is not None and not self.opener.tracks_wrists:
                if not seat.yaw_rad:
                    return sample._replace(joint=seat.joint)
                turn = rotation.about_axis("z", torch.tensor(seat.yaw_rad))
                R, acc = turn @ sample.R_world_imu, turn @ sample.acc_world
                return sample._replace(joint=seat.joint, R_world_imu=R, acc_world=acc)
            case SuitPiece() | LocalizationSample() if SUIT in self.opener.devices:
                return sample
        return None

    # --- poses ------------------------------------------------------------------------------------------------------

    def poses(self, now_s: float) -> list[Motion]:
        """Frames that became final. A wearer without packets for `AWAY_S` has left."""
        if self.session is None:
            if self.first is not None and self.first.found is None:
                self.first.look(now_s)
            return []
        if now_s - self._heard_s > AWAY_S:
            return self.leave()
        found = self._final(ended=False)
        if found is None:
            return []
        left_s = time.monotonic()
        ours = np.array([self.clocks.ours(each) for each in found.timestamps.tolist()])
        self.latencies.add(left_s - ours)
        return [found]

    def leave(self) -> list[Motion]:
        """End the session, and return the last frames."""
        motions = []
        while self.session is not None and (found := self._final(ended=True)) is not None:
            motions.append(found)
        if self.session is not None:
            self._dropped += self.session.dropped[0]
            self.session, self.stage = None, "away"
        return motions

    def _final(self, ended: bool) -> Motion | None:
        assert self.session is not None
        try:
            found = self.session.poses(ended)[0]
        except WearcapError as error:  # a suit that was never localised
            self._note(str(error))
            self.session, self.stage = None, "away"
            return None
        if found is not None:
            self.frames += len(found)
        return found

    # --- the page's wishes ------------------------------------------------------------------------------------------

    def guide(self) -> None:
        """Begin the guided first minute; the session that runs ends."""
        self.leave()
        self.first, self.stage = self.opener.first_minute(self.setup, True), "first minute"

    def status(self) -> WearerStatus:
        now_s = time.monotonic()
        devices = []
        for name, device in list(self._devices.items()):
            silent_s = now_s - device.arrived_s
            hz = device.hz or (device.count / max(now_s - device.since_s, RATE_S))
            seat = None if self.setup is None else self.setup.seats.get(name)
            pose, joint = (device.pose, None) if seat is None else (_turned(device.pose, seat), seat.joint)
            devices.append(DeviceStatus(name, 0.0 if silent_s > RATE_S else hz, pose, silent_s, joint))
        step = None if self.first is None else self.first.step
        session = self.session
        return WearerStatus(
            self.name,
            self.stage,
            None if step is None else str(step),
            0.0 if step is None else step.progress,
            tuple(devices),
            self.latencies.quantiles,
            self.frames,
            self._dropped + (0 if session is None else session.dropped[0]),
            sum(device.late for device in list(self._devices.values())),
            self.gaps,
            None if self.setup is None else self.setup.floor_m,
            self._points,
            tuple(self.notes),
        )

    @property
    def refused(self) -> dict[str, int]:
        """Samples that the session refused, by reason."""
        return {} if self.session is None else self.session.refused[0]

    def _keep_points(self, points: Tensor) -> None:
        kept = points if self._points is None else torch.cat([self._points, points])
        self._points = kept[-MAX_POINTS:]

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes = [*self.notes, note][-20:]


def _timed(sample: Any, time_s: float) -> Any:
    """A sample at a time (s) on the leading clock."""
    if isinstance(sample, SuitPiece):
        shift = time_s - sample.suit.timestamps[0]
        return sample._replace(suit=replace(sample.suit, timestamps=sample.suit.timestamps + shift))
    return sample._replace(timestamp=time_s)


def _shown(sample: Any) -> Rigid | None:
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
    return None


def _turned(pose: Rigid | None, seat: Seat) -> Rigid | None:
    """A watch's pose, turned from its own world to the head's."""
    if pose is None or not seat.yaw_rad:
        return pose
    return Rigid(rotation.about_axis("z", torch.tensor(seat.yaw_rad)) @ pose.R, pose.t)
