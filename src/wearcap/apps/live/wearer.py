"""One wearer of a live capture: clocks, first minute, session, and the counts that the page and the report show."""

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wearcap.apps.live.clocks import Clocks
from wearcap.apps.live.devices import MAX_DEVICES, Device
from wearcap.apps.live.hands import LiveHands
from wearcap.apps.live.packets import HEAD, SUIT, Packet
from wearcap.apps.live.recent import Recent
from wearcap.apps.live.setup import Seat, Setup
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.apps.live.status import MAX_POINTS, Counts, Latencies, Stage, WearerStatus
from wearcap.body.hands import has_fingers
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.runtime.session import Session
from wearcap.runtime.wearer import Wearer
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
from wearcap.tracking.fingers import fingered, posed
from wearcap.tracking.head_path import MAX_GAP_S

AWAY_S = 5.0
"""Time without packets after which a wearer has left: the last poses are returned, and the next packet begins anew."""
BEHIND_S = 2.0
"""Time for which packets may wait before the page says that the machine is too slow."""
MAX_HELD = 2_000
"""Most samples of the head that wait for a late watch."""
LEFT_OUT_S = 10.0
"""Time for which a capture that catches up leaves out what was measured before: sockets hold back that of some seconds. What
seems as old afterwards counts on a clock that was set back."""
ARRIVAL = "arrival"
"""Clock of packets that state no time."""


@dataclass(frozen=True)
class Opener:
    """How a capture opens a session, and what it knows of every wearer."""

    session: Callable[[Wearer], Session]
    devices: tuple[str, ...]
    """Devices that the session needs; the first one's clock times the motion."""
    tracks_wrists: bool
    takes_objects: bool
    estimation: Callable[[Setup | None, bool], SetupEstimation]
    """(set-up of last time, whether guided) → a new first minute."""
    patient: bool = False
    """Whether a wearer without packets stays: they come in pieces of any length."""
    hands: Mapping[str, Seat] = field(default_factory=dict)
    """Nominal seats of wrists that the session takes where they come, without a set-up that knows them."""


@dataclass(eq=False)
class LiveWearer:
    """Takes a wearer's packets and returns poses; never raises for what arrives."""

    name: str
    opener: Opener
    setup: Setup | None = None
    """Known from the beginning; None: the first minute finds it."""
    stage: Stage = "waiting"
    latencies: Latencies = field(default_factory=Latencies)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clocks = Clocks()
        self.first: SetupEstimation | None = None
        self.session: Session | None = None
        self.skeleton: Skeleton | None = None
        self.fps = 0.0
        self._devices = Recent(MAX_DEVICES, lambda _: Device(), self.opener.devices.__contains__)
        self._counted: Counter[str] = Counter()
        """Frames, sessions, gaps, packets of unknown devices and those that were left out; of ended sessions, those dropped."""
        self._heard_s = -np.inf
        self._head_s = -np.inf
        self._points: Tensor | None = None
        self._refused: Counter[str] = Counter()
        """Samples that earlier sessions refused, by reason."""
        self._frames_before = 0
        """Frames of earlier sessions."""
        self._caught_up_s = -np.inf
        """Our time (s) from which on packets count again after the capture was behind."""
        self._active: Packet | None = None
        """The newest choice of the active object."""
        self._taken = self._taken_before = False
        """Whether the session, and an earlier one, took that choice."""
        self._hands = LiveHands()
        self._held: deque[HeadSample] = deque(maxlen=MAX_HELD)
        """Samples of the head that wait for the latest watch."""

    # --- packets ----------------------------------------------------------------------------------------------------

    def take(self, packet: Packet) -> None:
        """Take in one packet."""
        if isinstance(packet.sample, ActiveObject | ObjectSample) and not self.opener.takes_objects:
            self._counted["unknown"] += 1
        elif isinstance(packet.sample, ActiveObject):
            self._choose(packet)
        elif self._is_left_out(packet):
            self._counted["dropped"] += 1
            self._heard_s = time.monotonic()
        elif (time_s := self._time_of(packet)) is None:
            self._counted["unknown"] += 1
        elif isinstance(packet.sample, HandSample):
            self._heard_s = max(packet.arrived_s, time.monotonic())
            if self.clocks.leader is not None:
                self._hands.take(packet.sample, time_s)
                self._give_fingers()
        else:
            self._hear(packet, time_s)
            self._pass_on(packet, _timed(packet.sample, time_s), time_s)

    def _leads(self, packet: Packet) -> bool:
        """Whether a packet is of the device whose clock times the motion."""
        return packet.device == self.opener.devices[0]

    def _time_of(self, packet: Packet) -> float | None:
        """Time (s) of a packet on the leading clock; None for a device too many."""
        device = self._devices.admit(packet.device, time.monotonic())
        if device is None:
            return None
        clock, sent_s = (ARRIVAL, packet.arrived_s) if packet.sent_s is None else (packet.clock, packet.sent_s)
        if self._leads(packet) and self.clocks.leader is None:
            self.clocks.leader = clock
        for name in self.clocks.see(clock, sent_s, packet.arrived_s):
            self.note(
                f"{name}: a clock was set anew; what the turn on the spot showed of it is void. Guide the wearer again."
            )
        time_s = self.clocks.on_leader(clock, sent_s, packet.device)
        device.see(packet, clock, time_s)
        return time_s

    def _is_left_out(self, packet: Packet) -> bool:
        """Whether a packet was measured before the capture caught up, by its clock as it stood before the stall."""
        if packet.arrived_s - self._caught_up_s > LEFT_OUT_S:
            return False
        if packet.sent_s is None or packet.clock not in self.clocks:
            return packet.arrived_s < self._caught_up_s
        time_s = self.clocks.on_leader(packet.clock, packet.sent_s, packet.device)
        return self.clocks.ours(time_s) < self._caught_up_s

    def _hear(self, packet: Packet, time_s: float) -> None:
        """Keep what the page and the report show of a packet, whatever becomes of it."""
        now_s, sample = time.monotonic(), packet.sample
        if not isinstance(sample, ObjectSample):  # objects stay when their wearer leaves
            self._heard_s = max(packet.arrived_s, now_s)  # of a capture that is behind, packets wait
        if now_s - packet.arrived_s > BEHIND_S:
            self.note(
                "The capture is slower than the packets come: end other programs, or give it more cores (threads=N)."
            )
        if self._leads(packet):
            self._counted["gaps"] += int(MAX_GAP_S < time_s - self._head_s < AWAY_S)
            self._head_s = time_s
        if isinstance(sample, HeadSample) and sample.points_world is not None and len(sample.points_world):
            self._keep_points(sample.points_world)

    def _pass_on(self, packet: Packet, sample: Any, time_s: float) -> None:
        """Give a sample to the session, or to the first minute while there is none."""
        if isinstance(sample, ObjectSample) and (self.session is None or self.clocks.leader is None):
            return
        if self.session is None and not self._is_prepared(packet.device, sample, packet.arrived_s):
            return
        leads = self._leads(packet)
        if leads and not self._taken:
            self._activate(time_s)
        if (seated := self._seated(packet.device, sample)) is None:
            self._counted["unknown"] += 1
            return
        late_s = self.clocks.late_s if leads else 0.0
        if late_s:  # the session takes a watch for silent that stays behind the head: the head waits for the latest one
            self._held.append(seated)
        if leads:
            self._release(time_s - late_s if late_s else np.inf)
        if not late_s:
            self._push(seated)

    def _choose(self, packet: Packet) -> None:
        """Take in a new choice of the active object."""
        self._active, self._taken, self._taken_before = packet, False, False
        if self.session is not None and self.clocks.leader is not None:
            self._activate(np.inf)

    def _release(self, until_s: float) -> None:
        """Push what was held back up to a time (s, head's clock)."""
        while self._held and self._held[0].timestamp <= until_s:
            self._push(self._held.popleft())

    def _push(self, sample: Any) -> None:
        assert self.session is not None
        try:
            self.session.push([[sample]])
        except WearcapError as error:
            self.note(str(error))

    def _activate(self, now_s: float) -> None:
        """Pass on which object is active; `now_s` is the time of the leading device.

        The choice's time may be any, so it says nothing about its sender's clock; on a clock that nothing else counts on,
        its arrival counts. What an earlier session took is active from the beginning of this one.
        """
        self._taken, packet = True, self._active
        if packet is None:
            return
        clock, time_s = packet.clock, packet.sent_s
        if time_s is None or clock not in self.clocks:
            clock, time_s = ARRIVAL, packet.arrived_s
            self.clocks.see(ARRIVAL, time_s, time_s)
        time_s = self.clocks.on_leader(clock, time_s)
        sample = packet.sample
        assert isinstance(sample, ActiveObject)
        self._push(sample._replace(timestamp=min(time_s, now_s) if self._taken_before else time_s))

    def _is_prepared(self, device: str, sample: Any, now_s: float) -> bool:
        """Look for the set-up, and open the session once it is known."""
        if self.setup is None or (self.first is not None and self.first.found is None):
            if self.first is None:
                self.first = self.opener.estimation(None, False)
            self.stage = "first minute"
            self.first.see(device, sample, now_s)
            self._align()
            if self.first.found is None:
                return False
            self.setup = self.first.found
            for note in self.setup.notes:
                self.note(note)
        self._open(self.setup)
        return True

    def _align(self) -> None:
        """Make up for what the first minute found of the watches' clocks, from the next sample on."""
        assert self.first is not None
        for device, offset_s, note in self.first.aligned:
            self.note(note)
            if offset_s and (known := self._devices.get(device)) is not None:
                self.clocks.shift(device, known.clock, offset_s)
                known.newest_s = -np.inf
        self.first.aligned.clear()

    def _open(self, setup: Setup) -> None:
        head = next((seat for seat in setup.seats.values() if seat.joint == HEAD), None)
        mounts = {seat.joint: seat.R_joint_device for seat in setup.seats.values() if seat.joint != HEAD}
        placed = {} if head is None else {"R_head_device": head.R_joint_device, "t_head_device": head.t_joint_device}
        wearer = Wearer(setup.skeleton, R_wrist_imu=mounts, floor_m=setup.floor_m, **placed)
        self.session, self.skeleton, self.stage = self.opener.session(wearer), setup.skeleton, "live"
        self._give_fingers()
        self._taken, self._taken_before = False, self._taken
        self._frames_before = self._counted["frames"]
        self._counted["sessions"] += 1
        self.fps = self.session.fps

    def _give_fingers(self) -> None:
        """A skeleton with fingers from the first tracked hand on; sinks begin anew with it."""
        if self._hands and self.skeleton is not None and not has_fingers(self.skeleton):
            self.skeleton = fingered(self.skeleton, {})

    def _seated(self, device: str, sample: Any) -> Any:
        """A device's sample as the session takes it, on the joint that wears it; None for a device that nobody wears."""
        assert self.setup is not None
        seat = self.setup.seats.get(device, self.opener.hands.get(device))
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
            case ObjectSample():
                return sample
            case SuitPiece() | LocalizationSample() if SUIT in self.opener.devices:
                return sample
        return None

    # --- poses ------------------------------------------------------------------------------------------------------

    def poses(self, now_s: float) -> list[Motion]:
        """Frames that became final. A wearer without packets for `AWAY_S` has left."""
        if self.session is None:
            if self.first is not None and self.first.found is None:
                self.first.look(now_s)
                self._align()
            return []
        if now_s - self._heard_s > AWAY_S and not self.opener.patient:
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
        if self.session is not None:
            self._release(np.inf)
        while self.session is not None and (found := self._final(ended=True)) is not None:
            motions.append(found)
        self._close()
        return motions

    def _close(self) -> None:
        """Keep the counts of the session, which ends; what waits for a late watch is forgotten."""
        self._held.clear()
        if self.session is not None:
            self._counted["dropped"] += self.session.dropped[0]
            self._refused.update(self.session.refused[0])
            self.session, self.stage = None, "away"

    def catch_up(self, now_s: float) -> list[Motion]:
        """End the session, leave out what was measured before now (our time, s), and begin anew with what comes then.

        Returns the last frames. A session that has given none goes on: its beginning may be what took so long.
        """
        if self.session is None or self._counted["frames"] == self._frames_before:
            return []
        self._caught_up_s, self._head_s = now_s, -np.inf
        self._counted["gaps"] += 1
        self.note(
            "The capture was behind by seconds, or suspended: it left out what had come meanwhile, and began anew. "
            "End other programs, or give it more cores (threads=N)."
        )
        return self.leave()

    def _final(self, ended: bool) -> Motion | None:
        assert self.session is not None
        try:
            found = self.session.poses(ended)[0]
        except WearcapError as error:  # a suit that was never localised
            self.note(str(error))
            self._close()
            return None
        if found is None:
            return None
        self._counted["frames"] += len(found)
        if self.skeleton is None or not has_fingers(self.skeleton):
            return found
        return posed(found, self.skeleton, self._hands.fitted(found.timestamps[0].item()))

    # --- the page's wishes ------------------------------------------------------------------------------------------

    def guide(self) -> None:
        """Begin the guided first minute; the session that runs ends."""
        self.leave()
        self.first, self.stage = self.opener.estimation(self.setup, True), "first minute"
        self.first.late_s = self.clocks.late_s

    def status(self) -> WearerStatus:
        """What the page shows; any thread may ask."""
        step, setup, now_s = None if self.first is None else self.first.step, self.setup, time.monotonic()
        seats = {} if setup is None else setup.seats
        devices = list(self._devices.items())
        return WearerStatus(
            self.name,
            self.stage,
            None if step is None else str(step),
            0.0 if step is None else step.progress,
            tuple(device.status(name, seats.get(name), now_s) for name, device in devices),
            self.latencies.quantiles,
            self._counts([device for _, device in devices]),
            None if setup is None else setup.floor_m,
            self._points,
            tuple(self.notes),
        )

    def _counts(self, devices: Sequence[Device]) -> Counts:
        counted, refused = self._counted.copy(), self._refused
        if (session := self.session) is not None:
            counted["dropped"] += session.dropped[0]
            refused = refused + Counter(session.refused[0])
        late = sum(device.late for device in devices)
        return Counts(**counted, late=late, clock_restarts=self.clocks.restarts, refused=dict(refused))

    def _keep_points(self, points: Tensor) -> None:
        kept = points if self._points is None else torch.cat([self._points, points])
        self._points = kept[-MAX_POINTS:]

    def note(self, note: str) -> None:
        """Show a sentence on the page and in the report, once."""
        if note not in self.notes:
            self.notes = [*self.notes, note][-20:]


def _timed(sample: Any, time_s: float) -> Any:
    """A sample at a time (s) on the leading clock."""
    if isinstance(sample, SuitPiece):
        shift = time_s - sample.suit.timestamps[0]
        return sample._replace(suit=replace(sample.suit, timestamps=sample.suit.timestamps + shift))
    return sample._replace(timestamp=time_s)
