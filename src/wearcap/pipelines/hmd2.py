"""HMD² (thesis ch. 6): environment-aware full-body motion from a head-mounted device by conditional motion diffusion."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.body.hang import hang
from wearcap.body.skeleton import Skeleton
from wearcap.data.features import HeadFeatures, body_size
from wearcap.data.floor import floor_from_path, floor_from_points, tracked_floor
from wearcap.data.prepare.check import MIN_DURATION_S
from wearcap.data.surroundings import latest_before
from wearcap.diffusion.sampler import Denoise, step_levels
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.models.denoiser import Conditions, MotionDenoiser
from wearcap.models.denoiser_runtime import StepRunner
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.pipelines.hmd2_windows import Frames, Poses, WindowSampler, advance, unsaid
from wearcap.recording import Motion, Recording
from wearcap.scene.voxels import voxelize

MODALITIES = ("points", "images")
MAX_GAP_S = 0.5
"""Head poses further apart than this say nothing of what was between: the capture begins anew behind the gap."""
MAX_FILL = 600
"""Frames of the model's rate per head pose that a recording may have at most: what has more has another unit of time."""
MAX_SPEED_M_S = 12.0
"""No head moves faster (sprinters do not): a step that asks for more is a jump of the tracking."""


@dataclass(frozen=True)
class HeadPath:
    """What the model is told about one recording's head, at the model's frame rate."""

    timestamps: Float64[Tensor, "time"]
    T_world_head: Rigid
    T_world_device: Rigid
    floor_height: Float[Tensor, "time"]
    skeleton: Skeleton
    stretches: tuple[tuple[int, int], ...]
    """Frames (start, stop) between gaps and jumps of the tracking; poses in the gaps are interpolated."""

    @property
    def stature(self) -> float:
        """Height of the head joint in the rest pose (m)."""
        return self.skeleton.height_of("head")

    @property
    def held_frames(self) -> Int64[Tensor, "time"]:
        """Which frame of all stretches' together counts at each time: in a gap the last one before it."""
        frames = torch.cat([torch.arange(start, stop) for start, stop in self.stretches])
        count = len(self.timestamps)
        return torch.searchsorted(frames, torch.arange(count), right=True).sub(1).clamp_min(0)


@dataclass
class HMD2:
    """Captures whole recordings in overlapping windows (thesis eq. 6.5)."""

    net: MotionDenoiser
    features: HeadFeatures
    schedule: Schedule
    skeleton: Skeleton
    """For recordings that do not say whose body it is."""
    fps: float
    place_encoder: VoxelAutoencoder | None = None
    image_encoder: str | None = None
    """Name of the encoder whose embeddings the network was trained on."""
    use: Sequence[str] = MODALITIES
    """Modalities that are listened to, of those that the network knows and a recording has."""
    steps: int = 5
    stride: int | None = None
    """Frames by which windows advance; None: half a window, or with `hold` three quarters (the document's 180 of 240)."""
    eta: float = 1.0
    guidance: float = 1.0
    """Classifier-free guidance by points and images (Ho & Salimans 2022; ours): 1 leaves it out."""
    live: bool = False
    """Whether even the floor is told only from what has been sensed by then, as it must be in a stream."""
    spacing: float = 1.0
    """How the steps' levels are spaced (`diffusion.sampler.step_levels`)."""
    hold: bool = False
    """Whether windows hold on to what was said before in every step (thesis eq. 6.5) or say it anew (ours)."""
    fade: int = 20
    """Frames over which what windows differ by fades out where one goes on from the other (without `hold`)."""
    lookahead: int | None = None
    """Frames that must follow a pose before it is final (ours): what comes next says what the feet are about to do.
    None: half of what windows share, so that poses come from their middle; with `hold` none."""
    runtime: str = "eager"
    """What the steps run on (`models.denoiser_runtime.RUNTIMES`); all but eager take some seconds to begin."""
    precision: str = "auto"
    """Of the steps' products (`models.denoiser_runtime.PRECISIONS`)."""
    device: str = "cpu"
    _steps: StepRunner | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        if unknown := set(self.use) - set(MODALITIES):
            raise WearcapError(f"no modality {min(unknown)!r}", expected=f"some of {', '.join(MODALITIES)}")

    @property
    def advance(self) -> int:
        """Frames by which windows advance. Raises WearcapError when the windows would not touch."""
        window = self.net.window
        advance = (3 * window // 4 if self.hold else window // 2) if self.stride is None else self.stride
        if not 0 < advance <= window:
            raise WearcapError(f"windows of {window} frames cannot advance by {advance}",
                               expected=f"a stride from 1 to {window}")  # fmt: skip
        return advance

    @property
    def waiting(self) -> int:
        """Frames at a window's end that are said again. Raises WearcapError where windows do not share as many."""
        shared = self.net.window - self.advance
        waiting = (0 if self.hold else shared // 2) if self.lookahead is None else self.lookahead
        if not 0 <= waiting <= shared:
            raise WearcapError(f"windows that share {shared} frames cannot look {waiting} ahead",
                               expected=f"a lookahead from 0 to {shared}")  # fmt: skip
        return waiting

    def __call__(self, recording: Recording, seed: int = 0) -> Motion:
        return self.capture([recording], [seed])[0]

    def prepare(self) -> None:
        """Bring the network to its device and its steps into the form they run in, as every capture does first.

        What is compiled or exported is made once, from the weights as they are then.
        """
        self.net.to(self.device).eval()
        if self._steps is None or self.runtime == "eager":
            levels = step_levels(self.steps, self.spacing)[:-1]
            self._steps = StepRunner(self.net, levels, self.runtime, self.precision)

    def undisturbed(self) -> AbstractContextManager[None]:
        """For windows of few lanes, after `prepare`: nothing else takes the cores from the steps."""
        assert self._steps is not None
        return self._steps.undisturbed()

    @torch.inference_mode()
    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (recording, seed); recordings share batches, which changes nothing but the time."""
        self.prepare()
        # 1. head path and floor; 2. points around the body as codes; 3. pictures as embeddings; once for all seeds
        once = {id(recording): recording for recording in recordings}
        path_of = {key: head_path(recording, self.skeleton, self.fps) for key, recording in once.items()}
        sensed = {key: self.sense(recording, path_of[key]) for key, recording in once.items()}
        paths, frames = zip(*((path_of[id(recording)], sensed[id(recording)]) for recording in recordings))
        # 4. windows of the diffusion model, each stretch of a path by itself
        poses = self._windows(paths, frames, seeds)
        # 5. the body hangs from the measured head
        return [
            self.motion(path.timestamps, path.skeleton, path.T_world_head, said)
            for path, said in zip(paths, poses)
        ]

    def sense(self, recording: Recording, path: HeadPath) -> Frames:
        """Everything that the network is told of a recording, as one lane.

        Raises WearcapError for embeddings that the network does not know.
        """
        count = len(path.timestamps)
        points, points_valid = self._points(recording, path)
        image, image_valid = torch.zeros(count, self.net.image_size), torch.zeros(count, dtype=torch.bool)
        camera = recording.camera
        if (
            self.net.image_size
            and "images" in self.use
            and camera is not None
            and camera.embedding is not None
        ):
            size = camera.embedding.shape[1]
            if (camera.embedding_name, size) != (self.image_encoder, self.net.image_size):
                raise WearcapError(
                    f"embeddings of {camera.embedding_name!r} with {size} features", where=recording.name,
                    expected=f"{self.net.image_size} of {self.image_encoder!r}, which the network was trained on",
                    fix="Prepare its embeddings with that encoder, or leave images out: pipeline.use=[points].",
                )  # fmt: skip
            number, image_valid = latest_before(camera.timestamps, path.timestamps)
            image = camera.embedding[number].float()
            image_valid &= image.isfinite().all(-1)
            image = image.nan_to_num(0.0, 0.0, 0.0)
        lane = Frames(
            path.T_world_head.R, path.T_world_head.t, self._floor(recording, path), points, points_valid,
            image, image_valid, torch.ones(count, dtype=torch.bool),
        )  # fmt: skip
        return Frames(*(part[None] for part in lane))

    def _listens_to_points(self, recording: Recording) -> bool:
        return bool(self.net.points_size) and "points" in self.use and recording.points is not None

    def _points(
        self, recording: Recording, path: HeadPath
    ) -> tuple[Float[Tensor, "time feature"], Bool[Tensor, "time"]]:
        """Codes of the points around the body at every frame, of those that had been seen by then."""
        count, cloud = len(path.timestamps), recording.points
        if not self._listens_to_points(recording) or self.place_encoder is None or cloud is None:
            return torch.zeros(count, self.net.points_size), torch.zeros(count, dtype=torch.bool)
        grid = voxelize(
            cloud.points_world,
            path.T_world_device,
            self.place_encoder.grid,
            cloud.first_seen,
            path.timestamps,
        )
        code = torch.cat([self.place_encoder.encode(part) for part in grid.split(2048)])
        return code, torch.ones(count, dtype=torch.bool)

    def _floor(self, recording: Recording, path: HeadPath) -> Float[Tensor, "time"]:
        """Floor beneath the head: from points that are listened to, else from the head's path."""
        cloud = recording.points if self._listens_to_points(recording) else None
        if self.live:
            return tracked_floor(cloud, path.timestamps, path.T_world_head.t, path.stature, self.fps)
        floor = floor_from_points(cloud, path.T_world_head.t, path.stature)
        return path.floor_height if floor is None else floor

    def denoiser(self, conditions: Conditions, valid: Bool[Tensor, "lane time"]) -> Denoise:
        """x̂0 of a window as a function of x_t and its level, asked for at the levels of the steps, one after the other.

        What the conditions say, and what the levels do, is computed once.
        """
        encoded = self.net.encode(conditions, valid)
        blind = None
        if self.guidance != 1.0:
            nothing = torch.zeros_like(valid)
            blind = self.net.encode(conditions._replace(points_valid=nothing, image_valid=nothing), valid)
        steps, number, last = self._steps, 0, None
        assert steps is not None

        def denoise(x_t: Tensor, level: Tensor) -> Tensor:
            nonlocal last, number
            x0_hat = steps(number, x_t, encoded, valid, last)
            if blind is not None:
                plain = steps(number, x_t, blind, valid, last)
                x0_hat = plain + self.guidance * (x0_hat - plain)
            last, number = x0_hat if self.net.self_conditioning else None, number + 1
            return x0_hat

        return denoise

    def _windows(
        self, paths: Sequence[HeadPath], frames: Sequence[Frames], seeds: Sequence[int]
    ) -> list[Poses]:
        """Poses of every path: its stretches side by side, window after window."""
        stride, waiting, passed = self.advance, self.waiting, 0
        done = [unsaid(self, len(path.timestamps)) for path in paths]
        lanes = [
            (i, start, stop, self.sampler(path.skeleton, seeds[i], start))
            for i, path in enumerate(paths)
            for start, stop in path.stretches
        ]
        while lanes:
            advance(
                [sampler for *_, sampler in lanes],
                [_cut(frames[i], start + passed, stop, stride) for i, start, stop, _ in lanes],
            )
            passed += stride
            for i, start, stop, sampler in lanes:
                ended = start + passed >= stop
                left = 0 if ended else waiting
                given, behind = sampler.give(left), min(start + passed, stop) - left
                for whole, part in zip(done[i], given.poses):
                    whole[0, behind - part.shape[1] : behind] = part[0]
            lanes = [lane for lane in lanes if lane[1] + passed < lane[2]]
        return [
            _bridged(Poses(*(part[0] for part in poses)), path.stretches) for poses, path in zip(done, paths)
        ]

    def sampler(self, skeleton: Skeleton, seed: int, start: int) -> WindowSampler:
        """Windows of a stretch that begins at frame `start`; stretches of one recording have noise of their own."""
        return WindowSampler(self, body_size(skeleton), seed + 1_000_003 * start)

    def motion(
        self, timestamps: Float64[Tensor, "time"], skeleton: Skeleton, T_world_head: Rigid, poses: Poses
    ) -> Motion:
        """Step 5: poses without the lane axis as a motion that hangs from the measured head."""
        settings = {
            "pipeline": "hmd2",
            "steps": str(self.steps),
            "stride": str(self.advance),
            "eta": str(self.eta),
            "lookahead": str(self.waiting),
        }
        contact = poses.foot_contact.repeat_interleave(2, -1) if self.features.contacts else None
        motion = Motion(
            timestamps,
            skeleton,
            poses.R_parent_joint,
            torch.zeros(len(timestamps), 3),
            contact,
            provenance=settings,
        )
        return hang_from_head(motion, T_world_head)


def head_path(recording: Recording, fallback: Skeleton, fps: float) -> HeadPath:
    """Step 1: the head joint's path at `fps`, and the floor beneath it as the path tells it. Poses that are not finite count as missing.

    Raises WearcapError when the recording has no head stream, or hardly one, for timestamps that do not grow, and for poses
    that are no rotations or hardly any for their time.
    """
    if recording.head is None:
        raise WearcapError("no head poses in this recording", where=recording.name,
                           expected="a recording with a `head` stream")  # fmt: skip
    head = recording.head
    known = head.R_world_device.isfinite().all(-1).all(-1) & head.t_world_device.isfinite().all(-1)
    times = head.timestamps[known]
    if len(times) < 2 or times[-1] - times[0] < MIN_DURATION_S:
        raise WearcapError(f"head poses of {len(times)} frames", where=recording.name,
                           expected=f"at least {MIN_DURATION_S} s")  # fmt: skip
    if not (times.diff() > 0).all():
        raise WearcapError("head poses whose timestamps do not grow", where=recording.name,
                           fix="Sort the head stream by time and leave repeated poses out.")  # fmt: skip
    _require_plausible(head.R_world_device[known], times, fps, recording.name)
    skeleton = recording.skeleton or (recording.motion.skeleton if recording.motion else fallback)
    trajectory = Trajectory(times, head.R_world_device[known], head.t_world_device[known])
    broken = breaks(trajectory)
    count = int((times[-1] - times[0]).item() * fps + 1e-3) + 1
    timestamps = times[0] + torch.arange(count, dtype=torch.float64) / fps
    if count != len(times) or (timestamps - times).abs().max() > 1e-4:
        trajectory = resample(trajectory, timestamps.clamp_max(times[-1].item()))
    T_device_head = Rigid(head.R_head_device, head.t_head_device).inverse()
    T_world_head = trajectory.T_world_body @ T_device_head
    floor = floor_from_path(timestamps, T_world_head.t, skeleton.height_of("head"))
    stretches, first = [], 0
    for before, after in broken:
        stretches.append((first, int(torch.searchsorted(timestamps, before + 1e-6))))
        first = int(torch.searchsorted(timestamps, after - 1e-6))
    stretches.append((first, count))
    return HeadPath(
        timestamps, T_world_head, trajectory.T_world_body, floor, skeleton,
        tuple((start, stop) for start, stop in stretches if stop > start),
    )  # fmt: skip


def _require_plausible(
    R_world_device: Float[Tensor, "time 3 3"], times: Float64[Tensor, "time"], fps: float, name: str
) -> None:
    """Raise WearcapError for matrices that are no rotations, and for clocks that are none of seconds."""
    skewed = (R_world_device.transpose(-1, -2) @ R_world_device - torch.eye(3)).abs().amax((-1, -2)) > 0.05
    if skewed.any():
        raise WearcapError(f"the head pose at {times[skewed][0].item():.3f} s is no rotation", where=name,
                           expected="orthonormal matrices", fix="Run `wearcap doctor` on the recording.")  # fmt: skip
    span = (times[-1] - times[0]).item()
    if span * fps > MAX_FILL * len(times):
        raise WearcapError(f"{len(times)} head poses over {span:.0f} s", where=name,
                           expected=f"one in {MAX_FILL / fps:.0f} s at least", fix="Give timestamps in seconds, or cut the recording at its pauses.")  # fmt: skip


def breaks(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Times (last before, first behind) of gaps and of jumps."""
    step = trajectory.timestamps.diff()
    speed = trajectory.t_world_body.diff(dim=0).norm(dim=-1) / step
    turn = rotation.geodesic(trajectory.R_world_body[:-1], trajectory.R_world_body[1:]) / step
    broken = (step > MAX_GAP_S) | (speed > MAX_SPEED_M_S) | (turn > 60.0)
    return [
        (trajectory.timestamps[i].item(), trajectory.timestamps[i + 1].item())
        for i in broken.nonzero()[:, 0].tolist()
    ]


def hang_from_head(motion: Motion, T_world_head: Rigid) -> Motion:
    """Last step: shift the body and turn its head so that the head is where it was measured."""
    R_parent_joint, T_world_joint = hang(motion.skeleton, motion.R_parent_joint, T_world_head)
    return replace(motion, R_parent_joint=R_parent_joint, t_world_root=T_world_joint.t[:, 0])


def _cut(frames: Frames, start: int, stop: int, length: int) -> Frames:
    """`length` frames from `start`; behind `stop` the last one is repeated as not valid."""
    take = torch.arange(start, start + length)
    there = take < stop
    cut = Frames(*(part[:, take.clamp_max(stop - 1)] for part in frames))
    return cut._replace(valid=cut.valid & there)


def _bridged(poses: Poses, stretches: tuple[tuple[int, int], ...]) -> Poses:
    """Frames between stretches turn from the pose before to the pose behind."""
    for (_, before), (after, _) in pairwise(stretches):
        if after > before:
            R = poses.R_parent_joint
            share = torch.linspace(0, 1, after - before + 2)[1:-1]
            turn = rotation.log(R[before - 1].transpose(-1, -2) @ R[after])
            R[before:after] = R[before - 1] @ rotation.exp(share[:, None, None] * turn)
    return poses
