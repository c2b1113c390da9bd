"""Streaming head path of one wearer: poses arrive in any order and at any rate, chunks at a constant rate go out.

Frame times, stretches between gaps and jumps, and interpolated poses equal those of `tracking.head_path.head_path`,
which sees the whole recording.
"""

import math
from bisect import bisect_right
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.tracking.head_path import MAX_GAP_S, breaks

_SAME_S = 1e-4
"""Largest difference (s) of timestamps that count as equal."""


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
            stop = self._stop(measured, start, ended)
            count = self.stride if stop is None else min(stop - first, self.stride)
            chunk = None
            if count > 0:
                chunk = self._chunk(measured, start, first, count)
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
        cut = breaks(every)
        return every[: int(torch.searchsorted(every.timestamps, cut[0][0], right=True))] if cut else every

    def _stop(self, measured: Trajectory, start: float, ended: bool) -> int | None:
        """Number of the frame after the stretch's last one, if the stretch has certainly ended."""
        last = measured.timestamps[-1].item()
        if len(measured) < len(self._poses) or self.newest - last > MAX_GAP_S:
            return math.ceil((last + 1e-6 - start) * self.fps)
        return int((last - start) * self.fps + 1e-3) + 1 if ended else None

    def _chunk(self, measured: Trajectory, start: float, first: int, count: int) -> Chunk:
        frames = torch.arange(first - self._provisional, first + count, dtype=torch.float64)
        times = start + frames / self.fps
        at = times.clamp(measured.timestamps[0].item(), measured.timestamps[-1].item())
        place = torch.searchsorted(measured.timestamps, at - _SAME_S).clamp_max(len(measured) - 1)
        exact = (measured.timestamps[place] - at).abs() <= _SAME_S
        at = torch.where(exact, measured.timestamps[place], at)
        poses = (measured[place] if exact.all() else resample(measured, at)).T_world_body
        old, self._provisional = self._provisional, int((times > measured.timestamps[-1] + _SAME_S).sum())
        return Chunk(times[old:], poses[old:], poses[:old], first, not self.inside)

    def _forget(self, measured: Trajectory) -> None:
        """Drop the poses that later frames are not interpolated from."""
        decided = self._time(self._next - 1 - self._provisional)
        keep = int(torch.searchsorted(measured.timestamps, decided + _SAME_S, right=True)) - 1
        self._poses = self._poses[max(keep, 0) :]
