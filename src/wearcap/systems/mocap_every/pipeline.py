"""MocapEvery (Lee and Joo 2024): full-body motion from two watches and a head-mounted camera, on stairs and hills."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import FEET, Skeleton
from wearcap.errors import WearcapError, require_choice
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.scores import score_in_world
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import FloorTrack
from wearcap.recording.timing import at_times
from wearcap.runtime.graphs import Run, chosen, run_of
from wearcap.runtime.needs import HEAD, HEIGHT, POINTS, WATCHES
from wearcap.runtime.system import CaptureInput, LearnedSystem
from wearcap.runtime.windows import FinalPoses, over_path
from wearcap.scene.floor import FloorFixed, FloorFollow, FloorFollower, FloorUpdate
from wearcap.sensors.watches import FILTER, watch_gaps, watches_at
from wearcap.systems.mocap_every.features import Sensed, WatchFeatures, synthetic_wrists
from wearcap.systems.mocap_every.model import Estimate, WatchEstimator
from wearcap.systems.mocap_every.visual_cues import VisualCues
from wearcap.systems.mocap_every.windows import EstimatorWindows
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.floor import CARRIED, floor_from_points
from wearcap.tracking.head_path import HeadPath, head_path
from wearcap.tracking.refinement import Measured, Refinement, refined_over

FLOORS = ("follow", "update", "points", "fixed")


@dataclass(frozen=True, eq=False)
class CapturedWithFloor:
    """Motion of one recording, with the floor that it came from."""

    motion: Motion
    floor: FloorTrack
    """Floor height that conditioned the estimator."""


@dataclass(frozen=True, eq=False)
class WatchModel:
    """What a training gives a capture: the estimator, and what it was trained with."""

    net: WatchEstimator
    features: WatchFeatures
    skeleton: Skeleton
    """Skeleton for recordings without their own."""
    fps: float
    """Frame rate of the estimator (Hz)."""
    joint_dof: float | None = None
    """As of the motions that are captured."""


@dataclass(frozen=True)
class Overlap:
    """How successive windows continue each other."""

    stride: int = 20
    """Frames by which windows advance; 1: frame by frame."""
    lookahead: int = 20
    """Frames that must follow a pose before it is final (latency)."""
    mirror_average: bool = True
    """Mirror test-time augmentation: the prediction for the mirrored window is averaged in (ours)."""


@dataclass
class MocapEvery(LearnedSystem):
    """Captures recordings: the estimator runs on overlapping windows, the floor is updated from window to window."""

    model: WatchModel
    overlap: Overlap = Overlap()
    floor: str = "follow"
    """follow: ours. update: the paper's D.2. points: below the head, from points only. fixed: constant height."""
    carried: float = CARRIED
    """How high the head is carried while upright, as a share of its height in the rest pose (ours); 1: as in that pose."""
    anchor: bool = True
    """Whether the body is anchored to the measured head (ours) or keeps the estimator's translation (the paper)."""
    refinement: Refinement | None = None
    """How estimated motion is refined (ours); None: it stays as estimated."""
    cues: VisualCues | None = None
    """Motion editing by the recording's keypoints (§3.4); None: no editing."""
    runtime: str = "eager"
    """Backend of the network (`runtime.graphs.RUNTIMES`)."""
    precision: str = "float32"
    """Number format of the network's matrix products (`runtime.graphs.PRECISIONS`)."""
    device: str = "cpu"

    name = "mocap_every"
    pipeline = "mocap_every"
    experiment = "experiment=mocap_every"
    shared = ("mocap_every",)
    required = (HEAD, WATCHES, POINTS, HEIGHT)

    def __post_init__(self):
        self._run: Run | None = None
        self._backend = chosen(self.runtime, self.precision, self.device)
        require_choice(self.floor, FLOORS, f"no floor {self.floor!r}")
        window, stride, lookahead = self.model.net.window, self.overlap.stride, self.overlap.lookahead
        if not 0 < stride <= window or not 0 <= lookahead <= window - stride:
            what = f"windows of {window} frames with stride {stride} and lookahead {lookahead}"
            expected = "a stride from 1 to the window, and a lookahead of at most the overlap of two windows"
            raise WearcapError(what, expected=expected)

    @property
    def fps(self) -> float:
        """Frame rate of captures (Hz)."""
        return self.model.fps

    @property
    def latency_s(self) -> float:
        """Longest time between a frame and its final pose (s), with the future frames of the watches' mean filter."""
        refinement = 0 if self.refinement is None else self.refinement.lookahead
        return (self.overlap.stride - 1 + self.overlap.lookahead + refinement + FILTER / 2) / self.model.fps

    def prepare(self) -> None:
        """Move the network to its device and set up its runtime, compiled or exported once."""
        self.model.net.to(self.device).eval()
        if self._run is None and self._backend != ("eager", "float32"):
            self._run = run_of(self.model.net.graph(self.model.features.size), *self._backend)

    @torch.inference_mode()
    def motions(self, sources: Sequence[CaptureInput], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording; the seeds have no effect.

        Raises WearcapError for a recording without head poses, or whose watches are missing. A watch that is silent for a
        while is taken as static, and the motion's note says so.
        """
        return [self.run(source.recording).motion for source in sources]

    @torch.inference_mode()
    def run(self, recording: Recording) -> CapturedWithFloor:
        """Capture one recording, with floor and editing results. Raises as `capture` does."""
        self.prepare()
        # 1. head path and watches on a common clock
        path = head_path(recording, self.model.skeleton, self.model.fps)
        sensed = self._sensed(recording, path)
        # 2. end-effectors, contacts and poses, window by window; 3. floor height from the feet in contact
        whole = self._estimated(recording, path, sensed)
        # 4. anchor the body to the measured head
        motion = self.motion(whole, path.skeleton)
        if gaps := watch_gaps(recording.imu, path.timestamps):
            motion = replace(motion, provenance=motion.provenance | {"note": "; ".join(gaps)})
        # 5. smooth it, hold its feet, and bend its arms to tracked hands
        tracked = self.model.features.wrists == "positions"
        hands = Rigid(sensed.R_world_wrist, sensed.t_world_wrist) if tracked else None
        measured = Measured.of(path.T_world_head, whole.floor_height, hands)
        motion = refined_over(self.refinement, motion, measured, path, self.fps, self.anchor)
        # 6. edit the motion within the manifold to fit the visual cues
        if self.cues is not None:
            motion, _ = self.cues.edit(motion, recording, path.T_world_head)
        return CapturedWithFloor(motion, FloorTrack(path.timestamps, whole.floor_height))

    def score(self, motion: Motion, source: CaptureInput, seed: int) -> Row:
        """All metrics in the world, without anchoring or alignment (MocapEvery §4.1)."""
        return score_in_world(motion, source.recording, source.recording.name, seed)

    def estimate(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """Run the network; the prediction is on the CPU."""
        if self._run is not None:
            output = self._run(features=features.to(self.device)).cpu()
            return Estimate(output[..., :-FEET], output[..., -FEET:], None)
        output = self.model.net(features.to(self.device))
        return Estimate(*(part if part is None else part.cpu() for part in output))

    def _sensed(self, recording: Recording, path: HeadPath) -> Sensed:
        """Sensor inputs at the path's times; a recording with true motion but no watches gets synthetic IMUs."""
        R, t = path.T_world_head.R.float(), path.T_world_head.t.float()
        truth = recording.motion
        if self.model.features.wrists == "positions" or (not recording.imu and truth is not None):
            if truth is None:
                expected = "a recording with `motion`, or a checkpoint for watches"
                raise WearcapError("no hand positions in this recording", where=recording.name, expected=expected)
            truth = at_times(truth, path.timestamps)
            return Sensed(
                R, t, *synthetic_wrists(truth.skeleton, truth.R_parent_joint, truth.t_world_root, self.model.fps)
            )
        return Sensed(R, t, *watches_at(recording.imu, path.timestamps, recording.name), torch.zeros(len(t), 2, 3))

    def _estimated(self, recording: Recording, path: HeadPath, sensed: Sensed) -> FinalPoses:
        """Steps 2 and 3: sliding windows over every stretch of a recording."""
        initial_m, known_m, cloud, track = path.floor_below(self.carried), None, recording.points, recording.floor
        if self.floor == "points":  # below the head; from the head path where there are too few points
            known_m = floor_from_points(cloud, path.T_world_head.t, path.stature)
            known_m = initial_m if known_m is None else known_m
        if track is not None:  # the measured floor, the paper's h_0
            initial_m = interpolate_clamped(track.timestamps, track.height, path.timestamps)
        stretches = []
        for start, stop in path.stretches:
            windows, part = self.windows(path.skeleton, initial_m[start].item()), slice(start, stop)
            if cloud is not None and self.floor in ("follow", "update"):
                windows.see(cloud.points_world, cloud.first_seen)
            inputs = path.timestamps[part], Sensed(*(field[part] for field in sensed))
            windows.push(*inputs, None if known_m is None else known_m[part])
            stretches.append(windows)
        return over_path(path, stretches)

    def windows(self, skeleton: Skeleton, floor_m: float) -> EstimatorWindows:
        """Windows over a stretch that begins at a height of the floor (m), with a follower of the configured kind."""
        return EstimatorWindows(self, skeleton, self._follower(skeleton, floor_m))

    def motion(self, final: FinalPoses, skeleton: Skeleton) -> Motion:
        """Step 4: estimated poses as a motion, anchored to the measured head."""
        about = self.settings() | {"refinement": self.refinement}
        settings = {"pipeline": "mocap_every"} | {name: str(about[name]) for name in about}
        motion = replace(final.motion(skeleton, settings), joint_dof=self.model.joint_dof)
        return anchored_to_head(motion, final.T_world_head) if self.anchor else motion

    def _follower(self, skeleton: Skeleton, initial_m: float) -> FloorFollower:
        if self.floor == "update":
            return FloorUpdate(initial_m)
        if self.floor == "follow":
            return FloorFollow(initial_m, skeleton.height_of("left_toe"), self.model.fps)
        return FloorFixed(initial_m)

    def settings(self) -> dict[str, Any]:
        """Settings that a motion depends on, which an exported model carries along."""
        return asdict(self.overlap) | {"floor": self.floor, "carried": self.carried, "anchor": self.anchor}
