"""Validation of live device packets before a streaming session uses them, so that bad input cannot break a session.

The `…_fault` functions return why a value is invalid, or None; `PacketClock` decides which timestamps are accepted;
`HeadInput` combines both for the head device, whose clock is the session's, and `WristInput` buffers the wrists' samples.
"""

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory

MAX_TIME_S = 1e10
"""Largest valid time (s): beyond it a double no longer resolves a microsecond; Unix times are 1.7e9 s."""
MAX_POSITION_M = 10_000.0
"""Largest valid coordinate (m) along each axis: there a float32 still resolves a millimetre."""
MAX_JUMP_M = 100.0
"""Largest valid distance (m) between consecutive head poses; after `AGREEING` farther poses in a row the new position
is accepted."""
MAX_ACC_M_S2 = 2_000.0
"""Largest valid acceleration. Accelerometers of wearables saturate at 16 g (157 m/s²), those for impacts at 200 g."""
MAX_FEATURE = 10_000.0
"""Largest valid component of an embedding; those of image encoders are around 1 to 10."""
ROTATION_TOLERANCE = 0.02
"""Tolerance of each entry of R Rᵀ - 1: matrices rounded to two digits pass, scales and shears do not."""
AHEAD_S = 0.5
"""Packets further ahead (s) of their stream are accepted only when others confirm them; captures restart after such
gaps."""
BEHIND_S = 1.0
"""Packets further behind (s) are accepted only when others confirm them; by then poses are final."""
AGREEING = 5
"""Number of consecutive packets, at most `AGREEING_STEP_S` apart, that confirm a clock jump."""
AGREEING_STEP_S = 1.0
CONNECTED_S = 10.0
"""Longest pause (s) within the samples that arrived before the head's clock started and are kept for it."""
MAX_WAITING = 100_000
"""Capacity of one stream's buffer: a quarter of an hour at 100 Hz. The oldest packets are dropped."""

WRONG_TYPE = "wrong type or shape"
NOT_FINITE = "not finite"
OUT_OF_RANGE = "out of range"
NOT_A_ROTATION = "not a rotation"
OFF_THE_CLOCK = "off the clock"


def number_fault(value: object, limit: float) -> str | None:
    """Why a number is invalid (magnitude above `limit`, not finite, wrong type), or None."""
    if not isinstance(value, float | int | np.floating | np.integer):
        return WRONG_TYPE
    if abs(value) <= limit:
        return None
    return OUT_OF_RANGE if abs(value) < math.inf else NOT_FINITE


def time_fault(timestamp: object) -> str | None:
    """Why a time (s) is invalid, or None."""
    return number_fault(timestamp, MAX_TIME_S)


def values_fault(values: object, shape: Sequence[int], limit: float) -> str | None:
    """Why an array of values with magnitudes up to `limit` is invalid, or None."""
    if not _is_float(values, tuple(shape)):
        return WRONG_TYPE
    if values.numel() > 16:
        # Comparisons with NaN are false, whereas min and max may ignore it.
        valid, finite = bool((values.detach().abs() <= limit).all()), bool(values.isfinite().all())
    else:  # of a few numbers Python is faster
        few = values.flatten().tolist()
        valid, finite = all(-limit <= value <= limit for value in few), all(map(math.isfinite, few))
    return None if valid else OUT_OF_RANGE if finite else NOT_FINITE


def rotation_fault(R: object, shape: Sequence[int] = (3, 3)) -> str | None:
    """Why a rotation matrix, or an array of them of this shape, is invalid, or None."""
    if fault := values_fault(R, shape, 2.0):
        return NOT_A_ROTATION if fault is OUT_OF_RANGE else fault
    assert isinstance(R, Tensor)
    if R.ndim > 2:
        R = R.detach().double()
        skew = (R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs()
        fine = bool((skew <= ROTATION_TOLERANCE).all() and (torch.linalg.det(R) > 0).all())
        return None if fine else NOT_A_ROTATION
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = R.tolist()
    products = (
        ax * ax + ay * ay + az * az - 1,
        bx * bx + by * by + bz * bz - 1,
        cx * cx + cy * cy + cz * cz - 1,
        ax * bx + ay * by + az * bz,
        ax * cx + ay * cy + az * cz,
        bx * cx + by * cy + bz * cz,
    )
    right_handed = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx) > 0
    orthogonal = min(products) >= -ROTATION_TOLERANCE and max(products) <= ROTATION_TOLERANCE
    return None if orthogonal and right_handed else NOT_A_ROTATION


def pose_fault(pose: object) -> str | None:
    """Why a pose in the world (R "3 3", t "3" in m) is invalid, or None."""
    if not isinstance(pose, Rigid):
        return WRONG_TYPE
    return rotation_fault(pose.R) or values_fault(pose.t, (3,), MAX_POSITION_M)


def owned(value: Tensor) -> Tensor:
    """A copy (float32, CPU), since the device may reuse the memory for its next packet."""
    return value.detach().to("cpu", torch.float32, copy=True)


def owned_pose(pose: Rigid) -> Rigid:
    """A copy of a pose (float32, CPU)."""
    return Rigid(owned(pose.R), owned(pose.t))


def connected(times: Sequence[float], at: float) -> slice:
    """Slice of increasing times (s) that are connected to `at` without a pause longer than `CONNECTED_S`."""
    first = stop = bisect_left(times, at)
    while first > 0 and (times[first] if first < stop else at) - times[first - 1] <= CONNECTED_S:
        first -= 1
    last = at
    while stop < len(times) and times[stop] - last <= CONNECTED_S:
        last, stop = times[stop], stop + 1
    return slice(first, stop)


class Admitted(NamedTuple):
    """Packets that a clock accepts at once, which may include earlier ones that were waiting for confirmation."""

    packets: list[tuple[float, Any]]
    """Times (s) and packets, in the order in which to process them."""
    refused: int = 0
    """Number of packets refused for an unconfirmed time."""
    begins: bool = False
    """Whether the clock starts or restarts with these packets."""
    again: bool = False
    """Whether the packets before a restart were valid; otherwise they were a few packets with a wrong time."""


class PacketClock:
    """Clock of one stream. A single packet far from the others is refused; several consistent ones move the clock.

    `leads`: this is the session's clock; other clocks jump back only to the session's time.
    """

    def __init__(self, leads: bool = True):
        self.leads = leads
        self.newest = -math.inf
        """Time (s) of the newest accepted packet."""
        self.taken = 0
        """Number of packets accepted since the clock started, counted up to `AGREEING`."""
        self.waiting: list[tuple[float, Any]] = []
        """Consecutive packets that await confirmation, fewer than `AGREEING`."""

    def admit(self, time: float, packet: Any, leader: float = -math.inf) -> Admitted:
        """Decide on a packet at a time (s) and on the waiting ones; `leader`: the session's newest time."""
        newest = self.newest
        begins = not self.taken
        if begins or newest - BEHIND_S <= time <= max(newest, leader) + AHEAD_S:
            late, refused = self.dismiss() if self.waiting else ([], 0)
            self.newest, self.taken = max(newest, time), min(self.taken + 1, AGREEING)
            return Admitted([*late, (time, packet)], refused, begins)
        late, refused = [], 0
        if self.waiting and not 0 < time - self.waiting[-1][0] <= AGREEING_STEP_S:
            late, refused = self.dismiss()
        self.waiting.append((time, packet))
        if len(self.waiting) < AGREEING:
            return Admitted(late, refused)
        if time < newest and not self.leads and abs(time - leader) > CONNECTED_S:
            self.waiting = []
            return Admitted([], AGREEING)
        # A confirmed jump of the clock.
        packets, self.waiting = self.waiting, []
        again = self.taken >= AGREEING
        begins, refused = packets[0][0] < self.newest or not again, 0 if again else self.taken
        self.newest, self.taken = packets[-1][0], AGREEING
        return Admitted(packets, refused, begins, begins and again)

    def dismiss(self) -> tuple[list[tuple[float, Any]], int]:
        """Clear the waiting packets: those that were merely late, and the number of the others, which are refused."""
        waiting, self.waiting = self.waiting, []
        late = [(time, packet) for time, packet in waiting if time < self.newest]
        return late, len(waiting) - len(late)

    def set(self, newest: float | None) -> int:
        """Continue from a newest time (None: restart with the next packet); returns the number of refused packets."""
        refused, self.waiting = len(self.waiting), []
        self.newest, self.taken = (-math.inf, 0) if newest is None else (newest, AGREEING)
        return refused


@dataclass
class HeadInput:
    """Validates the packets of one wearer's head device and counts the refused ones."""

    refused: Counter[str] = field(default_factory=Counter)
    """Number of refused packets by reason, such as "head: not a rotation"."""
    dropped: int = 0
    """Number of refused head poses."""
    clock: PacketClock = field(default_factory=PacketClock)
    place: tuple[float, float, float] | None = None
    """Position (m) of the last accepted pose."""
    far: int = 0
    """Number of poses since then that were too far from it."""

    def pose(self, T_world_device: object) -> Rigid | None:
        """A copy of the device's pose; None for a missing or invalid one."""
        if T_world_device is None:
            return None
        fault = pose_fault(T_world_device)
        if fault is None:
            assert isinstance(T_world_device, Rigid)
            pose = owned_pose(T_world_device)
            x, y, z = pose.t.tolist()
            self.far = 0 if self.place is None or math.dist(self.place, (x, y, z)) <= MAX_JUMP_M else self.far + 1
            if self.far in (0, AGREEING):
                self.place, self.far = (x, y, z), 0
                return pose
            fault = OUT_OF_RANGE
        self.refuse("head", fault)
        self.dropped += 1
        return None

    def points(self, points_world: object) -> Float[Tensor, "point 3"] | None:
        """A copy of the world points (m) that are finite and within range; None where there are none."""
        if points_world is None:
            return None
        shaped = isinstance(points_world, Tensor) and points_world.ndim == 2
        if not shaped or not _is_float(points_world, (len(points_world), 3)):
            self.refuse("points", WRONG_TYPE)
            return None
        points = owned(points_world)
        inside = (points.abs() <= MAX_POSITION_M).all(-1)
        if inside.all():
            return points
        self.refuse("points", OUT_OF_RANGE if points.isfinite().all() else NOT_FINITE)
        return points[inside]

    def timely(self, timestamp: object) -> bool:
        """Whether a packet has a valid time."""
        if fault := time_fault(timestamp):
            self.refuse("head", fault)
            self.dropped += 1
        return fault is None

    def admit(self, time: float, packet: Any) -> Admitted:
        """The packets to process now, given a new one."""
        admitted = self.clock.admit(time, packet)
        self.refuse("head", OFF_THE_CLOCK, admitted.refused)
        self.dropped += admitted.refused
        return admitted

    def end(self) -> list[tuple[float, Any]]:
        """End of input: the waiting packets that were merely late."""
        late, refused = self.clock.dismiss()
        self.refuse("head", OFF_THE_CLOCK, refused)
        self.dropped += refused
        return late

    def refuse(self, stream: str, fault: str, count: int = 1) -> None:
        """Count packets of a stream as refused; none leave no entry."""
        if count:
            self.refused[f"{stream}: {fault}"] += count


class WristInput:
    """Buffers of both wrists' samples in order of time; the wrists' clocks follow the head device's."""

    def __init__(self, head: HeadInput):
        self.head = head
        self.samples: dict[str, list[Any]] = {joint: [] for joint in WRISTS}
        """Samples of each wrist: tuples that begin with their time (s)."""
        self._clocks = {joint: PacketClock(leads=False) for joint in WRISTS}

    def add(self, joint: str, sample: Sequence[Any]) -> None:
        """Buffer a sample of a wrist; repeated ones are ignored."""
        samples = self.samples[joint]
        admitted = self._clocks[joint].admit(sample[0], sample, self.head.clock.newest)
        self.head.refuse(joint, OFF_THE_CLOCK, admitted.refused)
        if admitted.begins:
            first = bisect_left(samples, admitted.packets[0][0], key=itemgetter(0))
            del samples[first if admitted.again else 0 :]
        for time, accepted in admitted.packets:
            place = bisect_left(samples, time, key=itemgetter(0))
            if place == len(samples) or samples[place][0] != time:
                samples.insert(place, accepted)
                del samples[:-MAX_WAITING]

    def add_pose(self, joint: str, timestamp: object, T_world_joint: object) -> None:
        """Buffer a tracked pose of a wrist, unless it is invalid, which is counted as refused."""
        if fault := time_fault(timestamp) or pose_fault(T_world_joint):
            self.head.refuse(joint, fault)
            return
        assert isinstance(timestamp, float | int)
        assert isinstance(T_world_joint, Rigid)
        self.add(joint, (float(timestamp), owned(T_world_joint.R), owned(T_world_joint.t)))

    def track(self, joint: str, time: float) -> Trajectory | None:
        """Tracked poses of a wrist so far; None without any. Those of more than a second before a time are dropped, but one."""
        samples = self.samples[joint]
        if not samples:
            return None
        times, R, t = zip(*samples)
        old = bisect_left(times, time - 1.0) - 1
        self.samples[joint] = samples[max(old, 0) :]
        return Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(R), torch.stack(t))

    def rejoin(self, time: float | None) -> None:
        """Keep the samples that belong to the head's clock starting at a time (s); None: drop all of them."""
        for joint, samples in self.samples.items():
            kept = [] if time is None else samples[connected([sample[0] for sample in samples], time)]
            refused = self._clocks[joint].set(kept[-1][0] if kept else None)
            count = refused if time is None else refused + len(samples) - len(kept)
            self.head.refuse(joint, OFF_THE_CLOCK, count)
            self.samples[joint] = kept

    def arrived(self, until_s: float, at_s: float, head_s: float, silent_s: float) -> bool:
        """Whether both wrists have samples until `until_s`, or none within `silent_s` of the head's newest time
        `head_s`; `at_s`: time of the frame that needs them (s)."""
        newest = (samples[-1][0] if samples else -math.inf for samples in self.samples.values())
        return all(last >= until_s or head_s > max(at_s, last) + silent_s for last in newest)


def _is_float(value: object, shape: tuple[int, ...]) -> TypeGuard[Tensor]:
    """Whether a value is a dense tensor of floats of this shape."""
    return (
        isinstance(value, Tensor)
        and value.shape == shape
        and value.is_floating_point()
        and value.layout is torch.strided
        and not value.is_meta
    )
