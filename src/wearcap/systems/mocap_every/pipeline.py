"""MocapEvery (Lee and Joo 2024): full-body motion from two watches and a head-mounted camera, on stairs and hills."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import FloorTrack
from wearcap.recording.timing import at_times
from wearcap.runtime.onnx import Runner, missing_libraries, onnx_runner
from wearcap.scene.floor_update import FloorFixed, FloorFollow, FloorFollower, FloorUpdate
from wearcap.sensors.watches import watches_at
from wearcap.systems.mocap_every.energy import LatentSolution
from wearcap.systems.mocap_every.features import Sensed, WatchFeatures, synthetic_wrists
from wearcap.systems.mocap_every.model import Estimate, WatchEstimator
from wearcap.systems.mocap_every.visual_cues import VisualCues
from wearcap.systems.mocap_every.windows import EstimatorWindows, FinalPoses
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.floor import floor_from_points
from wearcap.tracking.head_path import HeadPath, head_path

FLOORS = ("follow", "update", "points", "fixed")


@dataclass(frozen=True, eq=False)
class Captured:
    """What came out."""

    motion: Motion
    floor: FloorTrack
    """As the estimator was told it."""
    edits: list[LatentSolution]
    """How the editing by cues went, batch by batch."""


@dataclass
class MocapEvery:
    """Captures whole recordings: estimator in overlapping windows, floor followed window by window."""

    net: WatchEstimator
    features: WatchFeatures
    skeleton: Skeleton
    """For recordings that do not say whose body it is."""
    fps: float
    stride: int = 20
    """Frames by which windows advance; 1 in a stream."""
    lookahead: int = 20
    """Frames that must follow a pose before it is final."""
    floor: str = "follow"
    """follow: ours. update: the document's D.2. points: beneath the head, from points alone. fixed: where it was."""
    anchor: bool = True
    """Whether the body hangs from the measured head (ours) or stands where the estimator puts it (the document)."""
    mirror_average: bool = False
    """Whether each window is asked in a mirror, too (ours)."""
    cues: VisualCues | None = None
    """Edits the motion by the recording's keypoints (§3.4); None: it stays as estimated."""
    runtime: str = "eager"
    """onnx: ONNX Runtime on the CPU; it takes some seconds to begin."""
    int8: bool = False
    """Whether ONNX Runtime multiplies int8."""
    device: str = "cpu"
    _runner: Runner | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        if self.runtime not in ("eager", "onnx"):
            raise WearcapError(f"no runtime {self.runtime!r}", expected="eager or onnx")
        if self.runtime == "onnx" and (missing := missing_libraries()):
            raise WearcapError(f"runtime 'onnx' needs {', '.join(missing)}", fix='Run: pip install "wearcap[export]", or choose pipeline.runtime=eager.')  # fmt: skip
        if self.floor not in FLOORS:
            raise WearcapError(f"no floor {self.floor!r}", expected=f"one of {', '.join(FLOORS)}")
        if not 0 < self.stride <= self.net.window or not 0 <= self.lookahead <= self.net.window - self.stride:
            raise WearcapError(f"windows of {self.net.window} frames with stride {self.stride} and lookahead {self.lookahead}",
                               expected="a stride from 1 to the window, and a lookahead of no more than what windows share")  # fmt: skip

    def __call__(self, recording: Recording, seed: int = 0) -> Motion:
        return self.capture([recording], [seed])[0]

    def prepare(self) -> None:
        """Bring the network to its device and into the form it runs in; what is exported is made once."""
        self.net.to(self.device).eval()
        if self.runtime == "onnx" and self._runner is None:
            size, window = self.features.size, self.net.window
            self._runner = onnx_runner(self.net, {"features": torch.zeros(2, window, size)}, int8=self.int8)

    @torch.inference_mode()
    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording; seeds change nothing.

        Raises WearcapError for a recording without head poses, or whose watches are missing, silent or swapped.
        """
        return [self.run(recording).motion for recording in recordings]

    @torch.inference_mode()
    def run(self, recording: Recording) -> Captured:
        """One recording, with all that is found on the way. Raises as `capture` does."""
        self.prepare()
        # 1. the head's path and the watches, on one clock
        path = head_path(recording, self.skeleton, self.fps)
        sensed = self._sensed(recording, path)
        # 2. end-effectors, contacts and poses, window after window; 3. the floor by where the feet touch it
        output = [self._stretch(recording, path, sensed, start, stop) for start, stop in path.stretches]
        whole = _bridged(output, path)
        motion = Motion(path.timestamps, path.skeleton, whole.R_parent_joint, whole.t_world_root,
                        whole.contact_prob.repeat_interleave(2, -1), provenance=self.settings())  # fmt: skip
        # 4. the head is where it was measured
        if self.anchor:
            motion = anchored_to_head(motion, path.T_world_head)
        # 5. the motion agrees with what was seen, as far as the manifold of motions allows
        edits: list[LatentSolution] = []
        if self.cues is not None:
            motion, edits = self.cues.edit(motion, recording, path.T_world_head)
        return Captured(motion, FloorTrack(path.timestamps, whole.floor_height), edits)

    def estimate(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """The network's answer, on the CPU."""
        if self._runner is not None:
            motion, contact, *ends = self._runner(features)
            return Estimate(motion, contact, ends[0] if ends else None)
        output = self.net(features.to(self.device))
        return Estimate(*(part if part is None else part.cpu() for part in output))

    def _sensed(self, recording: Recording, path: HeadPath) -> Sensed:
        """What is worn, at the path's times; a recording of a true motion without watches has synthetic ones (eq. 8)."""
        R, t = path.T_world_head.R.float(), path.T_world_head.t.float()
        truth = recording.motion
        if self.features.wrists == "positions" or (not recording.imu and truth is not None):
            if truth is None:
                raise WearcapError("hands are tracked by nothing in this recording", where=recording.name,
                                   expected="a recording with `motion`, or a checkpoint of watches")  # fmt: skip
            truth = at_times(truth, path.timestamps)
            return Sensed(
                R, t, *synthetic_wrists(truth.skeleton, truth.R_parent_joint, truth.t_world_root, self.fps)
            )
        return Sensed(
            R, t, *watches_at(recording.imu, path.timestamps, recording.name), torch.zeros(len(t), 2, 3)
        )

    def _stretch(
        self, recording: Recording, path: HeadPath, sensed: Sensed, start: int, stop: int
    ) -> FinalPoses:
        times = path.timestamps[start:stop]
        floor = self._follower(recording, path, times[0].item())
        windows, parts = EstimatorWindows(self, path.skeleton, floor), []
        below = self._below(recording, path) if self.floor == "points" else None
        seen = -torch.inf
        for first in range(start, stop, self.stride):
            last = min(first + self.stride, stop)
            seen = self._show(recording, floor, seen, path.timestamps[last - 1].item())
            if below is not None:
                assert isinstance(floor, FloorFixed)
                floor.height = below[first].item()
            parts.append(windows.advance(Sensed(*(part[first:last] for part in sensed))))
        parts.append(windows.finish())
        return FinalPoses(*(torch.cat(part) for part in zip(*parts)))

    def _follower(self, recording: Recording, path: HeadPath, time_s: float) -> FloorFollower:
        """Begins with the measured height of the floor (the document's h_0) where there is one, else with what the
        head's path says."""
        track = recording.floor
        if track is not None:
            initial = interpolate_clamped(
                track.timestamps, track.height, torch.tensor([time_s], dtype=torch.float64)
            )[0].item()
        else:
            initial = path.floor_height[int(torch.searchsorted(path.timestamps, time_s))].item()
        return self.follower(path.skeleton, initial)

    def follower(self, skeleton: Skeleton, initial_m: float) -> FloorFollower:
        """What follows the floor from a height (m) on."""
        if self.floor == "update":
            return FloorUpdate(initial_m)
        if self.floor == "follow":
            return FloorFollow(initial_m, skeleton.height_of("left_toe"), self.fps)
        return FloorFixed(initial_m)

    def _below(self, recording: Recording, path: HeadPath) -> Float[Tensor, "time"]:
        found = floor_from_points(recording.points, path.T_world_head.t, path.stature)
        return path.floor_height if found is None else found

    def _show(self, recording: Recording, floor: FloorFollower, seen: float, until: float) -> float:
        """Show the follower the points that have been seen by a time."""
        cloud = recording.points
        if cloud is None or self.floor not in ("follow", "update"):
            return until
        when = cloud.first_seen
        if when is None:
            if seen == -torch.inf:
                floor.see(cloud.points_world)
        elif ((when > seen) & (when <= until)).any():
            floor.see(cloud.points_world[(when > seen) & (when <= until)])
        return until

    def settings(self) -> dict[str, str]:
        """What the motion depends on, beside the network."""
        return {
            "pipeline": "mocap_every", "stride": str(self.stride), "lookahead": str(self.lookahead), "floor": self.floor,
            "anchor": str(self.anchor), "mirror_average": str(self.mirror_average),
        }  # fmt: skip


def _bridged(output: list[FinalPoses], path: HeadPath) -> FinalPoses:
    """Stretches as one; frames in the gaps between them hold the pose before, at the interpolated head."""
    whole, held = FinalPoses(*(torch.cat(part) for part in zip(*output))), path.held_frames
    return FinalPoses(*(part[held] for part in whole))
