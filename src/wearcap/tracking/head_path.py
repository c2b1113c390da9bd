"""The head's path at a constant frame rate, the input of every head-driven system: of a whole recording (`head_path`), or
streamed (`HeadTrack`), with equal frame times, stretches between gaps and jumps, and interpolated poses.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording import Recording
from wearcap.recording.recording import MIN_DURATION_S
from wearcap.tracking.floor import floor_from_path

MAX_GAP_S = 0.5
"""Longest interval (s) between head poses that is interpolated; a longer one is a gap, after which capture restarts."""
MAX_FILL = 600
"""Largest ratio of frames at the model's rate to head poses; above it the timestamps are not in seconds."""
MAX_SPEED_M_S = 12.0
"""Highest plausible speed of a head (faster than sprinters); a faster step is a jump of the tracking."""
MAX_TURN_RAD_S = 60.0
"""Highest plausible angular speed of a head."""


_SAME_S = 1e-4
"""Largest difference (s) of timestamps that count as equal."""


@dataclass(frozen=True)
class HeadPath:
    """One recording's head path at the model's frame rate, with the wearer's skeleton and the floor below."""

    timestamps: Float64[Tensor, "time"]
    T_world_head: Rigid
    T_world_device: Rigid
    floor_height: Float[Tensor, "time"]
    """Floor height (m) below the head, estimated from the head's path alone, as if people were as upright as the rest pose."""
    skeleton: Skeleton
    stretches: tuple[tuple[int, int], ...]
    """Frame ranges (start, stop) between gaps and jumps of the tracking; head poses in the gaps are interpolated."""

    @property
    def stature(self) -> float:
        """Height of the head joint in the rest pose (m)."""
        return self.skeleton.height_of("head")

    def floor_below(self, carried: float) -> Float[Tensor, "time"]:
        """Floor height (m) below a head that is carried at a share of its height in the rest pose (`CARRIED`)."""
        return self.floor_height + (1 - carried) * self.stature

    @property
    def held_frames(self) -> Int64[Tensor, "time"]:
        """Index into the concatenated stretches for each frame; frames in a gap repeat the last index before it."""
        frames = torch.cat([torch.arange(start, stop) for start, stop in self.stretches])
        count = len(self.timestamps)
        return torch.searchsorted(frames, torch.arange(count), right=True).sub(1).clamp_min(0)


def head_path(recording: Recording, fallback: Skeleton, fps: float) -> HeadPath:
    """Step 1: the head joint's path at `fps` and the floor below it. Poses that are not finite count as missing.

    Raises WearcapError when the head stream is missing or too short, for timestamps that do not increase, for matrices
    that are not rotations, and for too few poses for their time span.
    """
    if recording.head is None:
        expected = "a recording with a `head` stream"
        raise WearcapError("no head poses in this recording", where=recording.name, expected=expected)
    head = recording.head
    finite = head.R_world_device.isfinite().all(-1).all(-1) & head.t_world_device.isfinite().all(-1)
    times = head.timestamps[finite]
    if len(times) < 2 or times[-1] - times[0] < MIN_DURATION_S:
        what = f"head poses of {len(times)} frames"
        raise WearcapError(what, where=recording.name, expected=f"at least {MIN_DURATION_S} s")
    if not (times.diff() > 0).all():
        fix = "Sort the head stream by time and leave repeated poses out."
        raise WearcapError("head poses whose timestamps do not grow", where=recording.name, fix=fix)
    R_world_device, span = head.R_world_device[finite], (times[-1] - times[0]).item()
    skewed = (R_world_device.transpose(-1, -2) @ R_world_device - torch.eye(3)).abs().amax((-1, -2)) > 0.05
    if skewed.any():
        what = f"the head pose at {times[skewed][0].item():.3f} s is no rotation"
        fix = "Run `wearcap doctor` on the recording."
        raise WearcapError(what, where=recording.name, expected="orthonormal matrices", fix=fix)
    if span * fps > MAX_FILL * len(times):
        what = f"{len(times)} head poses over {span:.0f} s"
        fix = "Give timestamps in seconds, or cut the recording at its pauses."
        raise WearcapError(what, where=recording.name, expected=f"one in {MAX_FILL / fps:.0f} s at least", fix=fix)
    skeleton = recording.skeleton or (recording.motion.skeleton if recording.motion else fallback)
    trajectory = Trajectory(times, R_world_device, head.t_world_device[finite])
    broken = _breaks(trajectory)
    count = int(span * fps + 1e-3) + 1
    timestamps = times[0] + torch.arange(count, dtype=torch.float64) / fps
    if count != len(times) or (timestamps - times).abs().max() > 1e-4:
        trajectory = resample(trajectory, timestamps.clamp_max(times[-1].item()))
    T_world_head = trajectory.T_world_body @ Rigid(head.R_head_device, head.t_head_device).inverse()
    floor = floor_from_path(timestamps, T_world_head.t, skeleton.height_of("head"))
    stretches, first = [], 0
    for before, after in broken:
        stretches.append((first, int(torch.searchsorted(timestamps, before + 1e-6))))
        first = int(torch.searchsorted(timestamps, after - 1e-6))
    stretches.append((first, count))
    whole = tuple((start, stop) for start, stop in stretches if stop > start)
    return HeadPath(timestamps, T_world_head, trajectory.T_world_body, floor, skeleton, whole)


def _breaks(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Gaps and jumps of a trajectory, each as the times of the last pose before and the first pose after it."""
    step = trajectory.timestamps.diff()
    speed = trajectory.t_world_body.diff(dim=0).norm(dim=-1) / step
    turn = rotation.geodesic(trajectory.R_world_body[:-1], trajectory.R_world_body[1:]) / step
    broken = (step > MAX_GAP_S) | (speed > MAX_SPEED_M_S) | (turn > MAX_TURN_RAD_S)
    return [
        (trajectory.timestamps[i].item(), trajectory.timestamps[i + 1].item()) for i in broken.nonzero()[:, 0].tolist()
    ]


class Chunk(NamedTuple):
    """The next frames of one stretch."""

    timestamps: Float64[Tensor, "time"]
    T_world_device: Rigid
    corrected: Rigid
    """Poses of the last frames of the previous chunk, which had only repeated the newest pose."""
    first: int
    """Number of the chunk's first frame, counted from the first pose at the model's rate."""
    begins: bool
    """Whether a stretch begins with this chunk."""


class HeadTrack:
    """Turns poses into chunks of `stride` frames, or fewer at the end of a stretch."""

    def __init__(self, fps: float, stride: int):
        self.fps, self.stride = fps, stride
        self.dropped = 0
        """Number of poses that were late or duplicated."""
        self._start: float | None = None
        """Time of frame 0, which is that of the first pose (s)."""
        self._next = 0
        """Number of the next frame to go out."""
        self.inside = False
        """Whether the next frame continues a stretch, according to the poses so far."""
        self._provisional = 0
        """Number of the last frames whose pose only repeats the newest one."""
        self.newest = -math.inf
        self._poses: list[tuple[float, Tensor, Tensor]] = []

    def take(self, timestamp: float, T_world_device: Rigid | None) -> None:
        """Add a timestamp with the device's pose, if there is one; older than the newest until their chunk is out.

        Both must be finite, which `sensors.packets` ensures.
        """
        self.newest = max(self.newest, timestamp)
        if T_world_device is None:
            return
        place = bisect_right(self._poses, timestamp, key=lambda pose: pose[0])
        late = self._next > 0 and timestamp <= self._time(self._next - 1) + _SAME_S
        twice = place > 0 and self._poses[place - 1][0] == timestamp
        if late or twice:
            self.dropped += 1
        else:
            self._poses.insert(place, (timestamp, T_world_device.R, T_world_device.t))

    def next(self, ended: bool = False) -> Chunk | None:
        """The next chunk once all its frames' times have passed; with `ended`, no more poses will arrive."""
        while self._poses:
            start = self._poses[0][0] if self._start is None else self._start
            first = self._next
            if not self.inside:
                first = max(first, math.ceil((self._poses[0][0] - 1e-6 - start) * self.fps))
            if not ended and start + (first + self.stride - 1) / self.fps > self.newest + _SAME_S:
                return None
            measured = self._measured()
            # Number of the frame after the stretch's last one, if the stretch has certainly ended
            last, stop = measured.timestamps[-1].item(), None
            if len(measured) < len(self._poses) or self.newest - last > MAX_GAP_S:
                stop = math.ceil((last + 1e-6 - start) * self.fps)
            elif ended:
                stop = int((last - start) * self.fps + 1e-3) + 1
            count = self.stride if stop is None else min(stop - first, self.stride)
            chunk = None
            if count > 0:
                frames = torch.arange(first - self._provisional, first + count, dtype=torch.float64)
                times = start + frames / self.fps
                at = times.clamp(measured.timestamps[0].item(), measured.timestamps[-1].item())
                place = torch.searchsorted(measured.timestamps, at - _SAME_S).clamp_max(len(measured) - 1)
                exact = (measured.timestamps[place] - at).abs() <= _SAME_S
                at = torch.where(exact, measured.timestamps[place], at)
                poses = (measured[place] if exact.all() else resample(measured, at)).T_world_body
                old, self._provisional = self._provisional, int((times > measured.timestamps[-1] + _SAME_S).sum())
                chunk = Chunk(times[old:], poses[old:], poses[:old], first, not self.inside)
                self._start, self._next, self.inside = start, first + count, True
            if stop is not None and first + count >= stop:
                self.inside, self._provisional = False, 0
                self._poses = self._poses[len(measured) :]
            else:
                self._forget(measured)
            if chunk is not None:
                return chunk
        return None

    def _time(self, frame: int) -> float:
        assert self._start is not None
        return self._start + frame / self.fps

    def _measured(self) -> Trajectory:
        """Measured poses up to the first gap or jump."""
        times, R, t = zip(*self._poses)
        every = Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(R), torch.stack(t))
        cut = _breaks(every)
        return every[: int(torch.searchsorted(every.timestamps, cut[0][0], right=True))] if cut else every

    def _forget(self, measured: Trajectory) -> None:
        """Drop the poses that later frames are not interpolated from."""
        decided = self._time(self._next - 1 - self._provisional)
        keep = int(torch.searchsorted(measured.timestamps, decided + _SAME_S, right=True)) - 1
        self._poses = self._poses[max(keep, 0) :]
