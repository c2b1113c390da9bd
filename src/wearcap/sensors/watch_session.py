"""A guided calibration of two watches and a head camera (MocapEvery, appendix C.2): its logs, its steps, its result applied.

Times of steps count from `WatchSession.watch_zero` and `camera_zero`, so that they can be read off the logs.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.recording import FloorTrack, ImuStream, Recording
from wearcap.sensors.camera_alignment import HeadMount, SlamAlignment
from wearcap.sensors.clock import SwingClock, fit_swing_clock, swing_peaks
from wearcap.sensors.stillness import Stretch, still_intervals
from wearcap.sensors.watch_calibration import WatchCalibration, propose_steps

MARK_S, STAND_S = 1.5, 8.0
"""Least durations (s) for which the camera rests on a mark, and the wearer stands."""


@dataclass(frozen=True)
class WornCalibration:
    """Result of a guided calibration; what was not calibrated is None or absent."""

    watches: dict[str, WatchCalibration]
    clocks: dict[str, SwingClock] = field(default_factory=dict)
    """Clock relation of the camera and each watch."""
    camera: SlamAlignment | None = None
    head: HeadMount | None = None


@dataclass(frozen=True)
class WatchSession:
    """Logs of both watches, by wrist, and the camera's path by SLAM, if there is one."""

    watches: dict[str, ImuStream]
    slam: Trajectory | None = None

    @property
    def watch_zero(self) -> float:
        """Time (s) at which both watches' logs have begun."""
        return max(stream.timestamps[0].item() for stream in self.watches.values())

    @property
    def camera_zero(self) -> float:
        """Time (s) of the first camera pose."""
        return 0.0 if self.slam is None else self.slam.timestamps[0].item()

    def proposed(self) -> dict[str, list[Stretch]]:
        """Stretches (s, from the zeros) of "board", "tpose", "marks" and "standing" that the logs probably contain."""
        found = {}
        for key, stretch in zip(("board", "tpose"), propose_steps(self.watches)):
            if stretch is not None:
                found[key] = [(stretch[0] - self.watch_zero, stretch[1] - self.watch_zero)]
        if self.slam is not None:
            still = still_intervals(self.slam.timestamps, self.slam.R_world_body, MARK_S, still_deg=1.0)
            steady = still_intervals(self.slam.timestamps, self.slam.R_world_body, STAND_S)
            zero = self.camera_zero
            if len(still) >= 4:
                found["marks"] = [(start - zero, stop - zero) for start, stop in still[:4]]
                steady = [stretch for stretch in steady if stretch[0] > still[3][1]]
            if steady:
                found["standing"] = [(steady[0][0] - zero, steady[0][1] - zero)]
        return found

    def swing_clock(
        self, watch: ImuStream, seen_s: Float64[Tensor, "swing"], stretch: Stretch, camera_fps: float
    ) -> SwingClock:
        """Clock relation of the camera and one calibrated watch, from times (s) at which the camera saw the swings.

        `stretch` is the part (s) of the watch's log with the swings. Raises WearcapError as `fit_swing_clock` does.
        """
        peaks = swing_peaks(watch, stretch) - self.watch_zero
        found = fit_swing_clock(seen_s, peaks, 1 / camera_fps)
        clock = found.clock
        clock = replace(clock, camera_s=clock.camera_s + self.camera_zero, suit_s=clock.suit_s + self.watch_zero)
        return SwingClock(clock, found.std_s)

    def added_to(self, recording: Recording, found: WornCalibration) -> Recording:
        """The recording with the calibrated streams; z = 0 of its world is the floor the wearer stands on: MocapEvery's h_0."""
        imu = {joint: found.watches[joint].apply(stream) for joint, stream in self.watches.items()}
        for joint, clock in found.clocks.items():
            imu[joint] = replace(imu[joint], timestamps=clock.clock.to_camera(self.watches[joint].timestamps))
        recording = replace(recording, imu=recording.imu | imu)
        if self.slam is None or found.camera is None or found.head is None:
            return recording
        head = found.head.apply(found.camera.apply(self.slam))
        floor = recording.floor or FloorTrack(head.timestamps[:1], torch.zeros(1))
        return replace(recording, head=head, floor=floor)
