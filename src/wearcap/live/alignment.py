"""Watches that reach us later than the head does: their constant delay, found by turns of the whole body.

The quickest packets show how two clocks stand only up to the time that every packet takes, which from a watch over its phone
may be tenths of a second.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.live.clock_offset import offset_by_turning
from wearcap.live.packets import HEAD
from wearcap.sensors.samples import HeadSample, WatchSample

KEPT_S = 20.0
"""Time of orientations that is compared."""
EVERY_S = 10.0
"""Time between comparisons, until one finds turns that agree."""
STEP_S = 0.015
"""Least time between kept orientations."""
LARGEST_S, LEAST_S = 2.0, 0.05
"""Offset that is believed, and the one from which it is made up for."""


class WatchAlignment:
    """Compares head and watches in a thread of its own, once enough has come; each watch is aligned once."""

    def __init__(self, found: Callable[[str, float], None]):
        """`found(device, seconds)` gets what is to be added to a watch's times; it is called from another thread."""
        self._found, self._tracks, self._done = found, {}, set()
        self._next_s = 0.0
        self._thread: threading.Thread | None = None

    def see(self, device: str, time_s: float, sample: Any) -> None:
        """Take in a sample on the head's clock."""
        match sample:
            case HeadSample(T_world_device=pose) if pose is not None:
                self._add(HEAD, time_s, pose.R)
            case WatchSample() if device not in self._done:
                self._add(device, time_s, sample.R_world_imu)
        head = self._tracks.get(HEAD)
        if (
            device != HEAD
            or not head
            or time_s < self._next_s
            or (self._thread is not None and self._thread.is_alive())
        ):
            return
        self._next_s = time_s + EVERY_S
        open_tracks = {name: list(track) for name, track in self._tracks.items() if name not in self._done}
        if len(open_tracks) > 1 and head[-1][0] - head[0][0] > KEPT_S / 2:
            self._thread = threading.Thread(target=self._compare, args=(open_tracks,), daemon=True)
            self._thread.start()

    def _add(self, device: str, time_s: float, R: Tensor) -> None:
        track = self._tracks.setdefault(device, deque(maxlen=round(KEPT_S / STEP_S)))
        if track and not track[-1][0] + STEP_S <= time_s:
            if time_s < track[-1][0] - LARGEST_S:  # the clock was set anew
                track.clear()
            return
        track.append((time_s, R))
        while track[-1][0] - track[0][0] > KEPT_S:
            track.popleft()

    def _compare(self, tracks: dict[str, list[tuple[float, Tensor]]]) -> None:
        head = _trajectory(tracks.pop(HEAD))
        for device, rows in tracks.items():
            try:
                seconds = offset_by_turning(head, _trajectory(rows), LARGEST_S)
            except (WearcapError, ValueError, RuntimeError):  # hardly a turn, or samples that are no rotations
                continue
            self._done.add(device)
            self._tracks.pop(device, None)
            if abs(seconds) >= LEAST_S:
                self._found(device, seconds)


def _trajectory(rows: list[tuple[float, Tensor]]) -> Trajectory:
    times, R = zip(*rows)
    return Trajectory(torch.tensor(times, dtype=torch.float64), torch.stack(R), torch.zeros(len(rows), 3))
