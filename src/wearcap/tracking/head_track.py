"""One wearer's head while it is being recorded: poses come in any order and rate, chunks of a steady clock go out.

The clock, the stretches between gaps and jumps, and the poses between those that were measured are those of
`hmd2.head_path`, which knows the whole recording.
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
"""Times nearer than this are one."""


class Chunk(NamedTuple):
    """The next frames of one stretch."""

    timestamps: Float64[Tensor, "time"]
    T_world_device: Rigid
    corrected: Rigid
    """Poses of the last frames of the chunk before, which had been held for want of newer ones."""
    first: int
    """Number of the first frame on the wearer's clock."""
    begins: bool
    """Whether a stretch begins with it."""


class HeadTrack:
    """Poses in, chunks of `stride` frames out, or of fewer at the end of a stretch."""

    def __init__(self, fps: float, stride: int):
        self.fps, self.stride = fps, stride
        self.dropped = 0
        """Poses that came too late, or twice."""
        self._start: float | None = None
        """Time of frame 0: of the first pose."""
        self._next = 0
        """The next frame to go out."""
        self.inside = False
        """Whether it continues a stretch, as far as is known."""
        self._held = 0
        """Of the last frames, those that no pose was known for."""
        self.newest = -math.inf
        self._poses: list[tuple[float, Tensor, Tensor]] = []

    def state(self) -> dict[str, Tensor]:
        start = math.nan if self._start is None else self._start
        numbers = [start, self._next, self.inside, self._held, self.newest, self.dropped]
        times, R, t = (
            zip(*self._poses) if self._poses else ((), (torch.zeros(0, 3, 3),), (torch.zeros(0, 3),))
        )
        return {
            "numbers": torch.tensor(numbers, dtype=torch.float64), "times": torch.tensor(times, dtype=torch.float64),
            "R": torch.stack(R).reshape(-1, 3, 3), "t": torch.stack(t).reshape(-1, 3),
        }  # fmt: skip

    def restore(self, state: dict[str, Tensor]) -> None:
        start, next_frame, inside, held, self.newest, dropped = state["numbers"].tolist()
        self._start = None if math.isnan(start) else start
        self._next, self.inside, self._held, self.dropped = (
            int(next_frame),
            bool(inside),
            int(held),
            int(dropped),
        )
        self._poses = list(zip(state["times"].tolist(), state["R"], state["t"]))

    def take(self, timestamp: float, T_world_device: Rigid | None) -> None:
        """Take in a moment, with the device's pose if it is known. It may come after later ones, until their chunk is out.

        Both are finite: `sensors.packets` lets nothing else in.
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
        """The next chunk, once all its frames' times have passed; `ended`: nothing more will come."""
        while self._poses:
            start = self._poses[0][0] if self._start is None else self._start
            first = self._next
            if not self.inside:
                first = max(first, math.ceil((self._poses[0][0] - 1e-6 - start) * self.fps))
            if not ended and start + (first + self.stride - 1) / self.fps > self.newest + _SAME_S:
                return None
            known = self._known()
            stop = self._stop(known, start, ended)
            count = self.stride if stop is None else min(stop - first, self.stride)
            chunk = None
            if count > 0:
                chunk = self._chunk(known, start, first, count)
                self._start, self._next, self.inside = start, first + count, True
            if stop is not None and first + count >= stop:
                self.inside, self._held = False, 0
                self._poses = self._poses[len(known) :]
            else:
                self._forget(known)
            if chunk is not None:
                return chunk
        return None

    def _time(self, frame: int) -> float:
        assert self._start is not None
        return self._start + frame / self.fps

    def _known(self) -> Trajectory:
        """Poses up to the first gap or jump."""
        times, R, t = zip(*self._poses)
        every = Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(R), torch.stack(t))
        cut = breaks(every)
        return every[: int(torch.searchsorted(every.timestamps, cut[0][0], right=True))] if cut else every

    def _stop(self, known: Trajectory, start: float, ended: bool) -> int | None:
        """Number of the frame behind the stretch's last, if the stretch is known to be over."""
        last = known.timestamps[-1].item()
        if len(known) < len(self._poses) or self.newest - last > MAX_GAP_S:
            return math.ceil((last + 1e-6 - start) * self.fps)
        return int((last - start) * self.fps + 1e-3) + 1 if ended else None

    def _chunk(self, known: Trajectory, start: float, first: int, count: int) -> Chunk:
        frames = torch.arange(first - self._held, first + count, dtype=torch.float64)
        times = start + frames / self.fps
        at = times.clamp(known.timestamps[0].item(), known.timestamps[-1].item())
        place = torch.searchsorted(known.timestamps, at - _SAME_S).clamp_max(len(known) - 1)
        exact = (known.timestamps[place] - at).abs() <= _SAME_S
        at = torch.where(exact, known.timestamps[place], at)
        poses = (known[place] if exact.all() else resample(known, at)).T_world_body
        held, self._held = self._held, int((times > known.timestamps[-1] + _SAME_S).sum())
        return Chunk(times[held:], poses[held:], poses[:held], first, not self.inside)

    def _forget(self, known: Trajectory) -> None:
        """Drop the poses that no later frame lies between."""
        decided = self._time(self._next - 1 - self._held)
        keep = int(torch.searchsorted(known.timestamps, decided + _SAME_S, right=True)) - 1
        self._poses = self._poses[max(keep, 0) :]
