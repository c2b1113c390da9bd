"""HMD² (thesis ch. 6): environment-aware full-body capture from a head-mounted device by conditional diffusion."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.data.features import body_size
from wearcap.data.surroundings import latest_before
from wearcap.diffusion.process import Denoise, step_levels
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Motion, PointCloud, Recording
from wearcap.runtime.needs import HEAD, HEIGHT, POINTS
from wearcap.runtime.system import CaptureInput, LearnedSystem
from wearcap.scene.voxels import voxelize
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser, StepRunner
from wearcap.systems.hmd2.windows import Frames, Poses, WindowSampler, advance, no_poses
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.floor import floor_from_points, tracked_floor
from wearcap.tracking.head_path import HeadPath, head_path
from wearcap.tracking.refinement import Measured, Refinement

MODALITIES = ("points", "images")


@dataclass(frozen=True, eq=False)
class DiffusionModel:
    """What a training gives a capture: the network, and what it was trained with."""

    net: MotionDenoiser
    features: HeadFeatures
    schedule: Schedule
    skeleton: Skeleton
    """Skeleton for recordings without one of their own."""
    fps: float
    place_encoder: VoxelAutoencoder | None = None
    image_encoder: str | None = None
    """Name of the encoder whose embeddings the network was trained on."""


@dataclass(frozen=True)
class Sampling:
    """How a window is denoised."""

    steps: int = 1
    """Number of denoising steps: 1 leads to the mean of the plausible motions (ours; thesis: 20)."""
    eta: float = 1.0
    """Stochasticity of the steps: 1 samples the posterior (thesis eq. 6.2, 6.3), 0 is DDIM."""
    spacing: float = 1.0
    """Spacing of the steps' noise levels (`diffusion.process.step_levels`)."""
    guidance: float = 1.0
    """Scale of classifier-free guidance by points and images (Ho & Salimans 2022; ours); 1 turns it off."""


@dataclass(frozen=True)
class Overlap:
    """How successive windows continue each other."""

    stride: int | None = None
    """Frames by which windows advance; None: half a window, or with `inpaint` three quarters (thesis: 180 of 240)."""
    lookahead: int | None = None
    """Frames that must follow a pose before it is final (ours): the next frames show where the feet are going.
    None: half of the overlap, so that poses come from the windows' middle; with `inpaint` none."""
    inpaint: bool = False
    """Whether steps overwrite the overlap with the last window's poses (thesis eq. 6.5) or re-denoise it (ours)."""
    fade: int = 20
    """Frames over which the difference between successive windows fades out after their seam (without `inpaint`)."""
    window: int | None = None
    """Most frames of a window (ours): a shorter past is computed sooner. None: as many as the network was trained on."""


@dataclass
class HMD2(LearnedSystem):
    """Captures whole recordings in overlapping windows (thesis eq. 6.5); its fields also set up streams."""

    model: DiffusionModel
    sampling: Sampling = Sampling()
    overlap: Overlap = Overlap()
    use: Sequence[str] = MODALITIES
    """Modalities that condition the model, of those that it was trained on and the recording contains."""
    refinement: Refinement | None = None
    """How predicted motion is refined (ours); None: it stays as predicted."""
    live: bool = False
    """Whether the floor at a frame is estimated from earlier data only, as it must be in a stream."""
    runtime: str = "eager"
    """Backend of the denoising steps (`runtime.graphs.RUNTIMES`)."""
    precision: str = "auto"
    """Number format of the steps' matrix products (`runtime.graphs.PRECISIONS`)."""
    device: str = "cpu"

    name = "hmd2"
    pipeline = "hmd2"
    experiment = "experiment=hmd2"
    shared = ("hmd2",)
    required = (HEAD, POINTS, HEIGHT)

    def __post_init__(self):
        self._steps: StepRunner | None = None
        if unknown := set(self.use) - set(MODALITIES):
            raise WearcapError(f"no modality {min(unknown)!r}", expected=f"some of {', '.join(MODALITIES)}")

    @property
    def window(self) -> int:
        """Frames of a full window. Raises WearcapError for a length that does not split into the network's tokens."""
        most, net = self.overlap.window, self.model.net
        if most is None:
            return net.window
        if most < 1 or most % net.frames_per_token:
            what = f"a window of {most} frames does not split into tokens of {net.frames_per_token}"
            raise WearcapError(what, expected=f"a multiple of {net.frames_per_token}")
        return min(most, net.window)

    @property
    def advance(self) -> int:
        """Frames by which windows advance. Raises WearcapError when successive windows would leave a gap."""
        window, overlap = self.window, self.overlap
        advance = (3 * window // 4 if overlap.inpaint else window // 2) if overlap.stride is None else overlap.stride
        if not 0 < advance <= window:
            what = f"windows of {window} frames cannot advance by {advance}"
            raise WearcapError(what, expected=f"a stride from 1 to {window}")
        return advance

    @property
    def lookahead_frames(self) -> int:
        """Frames at a window's end that the next one re-denoises. Raises WearcapError when the overlap is shorter."""
        shared, lookahead_frames = self.window - self.advance, self.overlap.lookahead
        if lookahead_frames is None:
            lookahead_frames = 0 if self.overlap.inpaint else shared // 2
        if not 0 <= lookahead_frames <= shared:
            what = f"windows that share {shared} frames cannot look {lookahead_frames} ahead"
            raise WearcapError(what, expected=f"a lookahead from 0 to {shared}")
        return lookahead_frames

    @property
    def fps(self) -> float:
        """Frame rate of captures (Hz)."""
        return self.model.fps

    @property
    def latency_s(self) -> float:
        """Longest time between a frame and its final pose (s): a stride's first frame waits for its last."""
        refinement = 0 if self.refinement is None else self.refinement.lookahead
        return (self.advance - 1 + self.lookahead_frames + refinement) / self.model.fps

    def prepare(self) -> None:
        """Move the network to its device and set up its runtime, as every capture does first.

        Compilation or export happens once, with the weights of that moment.
        """
        self.model.net.to(self.device).eval()
        if self._steps is None or self.runtime == "eager":
            levels = step_levels(self.sampling.steps, self.sampling.spacing)[:-1]
            self._steps = StepRunner(self.model.net, levels, self.runtime, self.precision, self.window)

    def undisturbed(self) -> AbstractContextManager[None]:
        """A context for small batches, after `prepare`, in which other threads leave the cores to the steps."""
        assert self._steps is not None
        return self._steps.undisturbed()

    @torch.inference_mode()
    def motions(self, sources: Sequence[CaptureInput], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording and seed."""
        self.prepare()
        recordings = [source.recording for source in sources]
        # 1. head path and floor; 2. codes of the points around the body; 3. image embeddings; once for all seeds
        once = {id(recording): recording for recording in recordings}
        path_of = {key: head_path(recording, self.model.skeleton, self.model.fps) for key, recording in once.items()}
        sensed = {key: self.sense(recording, path_of[key]) for key, recording in once.items()}
        paths, frames = zip(*((path_of[id(recording)], sensed[id(recording)]) for recording in recordings))
        # 4. windows of the diffusion model, every stretch of a path separately
        poses = self._windows(paths, frames, seeds)
        # 5. anchor the body to the measured head; 6. smooth it and hold its feet
        return [self._refined(*parts) for parts in zip(paths, frames, poses)]

    def sense(self, recording: Recording, path: HeadPath) -> Frames:
        """Steps 2 and 3: the conditioning of a whole recording, as a batch of one.

        Raises WearcapError for embeddings of an encoder that the network was not trained on.
        """
        count, net, camera = len(path.timestamps), self.model.net, recording.camera
        cloud = recording.points if net.points_size and "points" in self.use else None
        points, points_valid = torch.zeros(count, net.points_size), torch.zeros(count, dtype=torch.bool)
        if cloud is not None and (encoder := self.model.place_encoder) is not None:  # what had been seen by each frame
            grid = voxelize(cloud.points_world, path.T_world_device, encoder.grid, cloud.first_seen, path.timestamps)
            points = torch.cat([encoder.encode(part) for part in grid.split(2048)])
            points_valid = torch.ones(count, dtype=torch.bool)
        image, image_valid = torch.zeros(count, net.image_size), torch.zeros(count, dtype=torch.bool)
        if net.image_size and "images" in self.use and camera is not None and camera.embedding is not None:
            size = camera.embedding.shape[1]
            if (camera.embedding_name, size) != (self.model.image_encoder, net.image_size):
                what = f"embeddings of {camera.embedding_name!r} with {size} features"
                expected = f"{net.image_size} of {self.model.image_encoder!r}, which the network was trained on"
                fix = "Prepare its embeddings with that encoder, or leave images out: pipeline.use=[points]."
                raise WearcapError(what, where=recording.name, expected=expected, fix=fix)
            number, image_valid = latest_before(camera.timestamps, path.timestamps)
            image = camera.embedding[number].float()
            image_valid &= image.isfinite().all(-1)
            image = image.nan_to_num(0.0, 0.0, 0.0)
        head, floor, valid = path.T_world_head, self._floor(cloud, path), torch.ones(count, dtype=torch.bool)
        fields = head.R, head.t, floor, points, points_valid, image, image_valid, valid
        return Frames(*(part[None] for part in fields))

    def _floor(self, cloud: PointCloud | None, path: HeadPath) -> Float[Tensor, "time"]:
        """Floor height (m) below the head: from the points where they are used, else from the head's path."""
        if self.live:
            return tracked_floor(cloud, path.timestamps, path.T_world_head.t, path.stature, self.model.fps)
        floor = floor_from_points(cloud, path.T_world_head.t, path.stature)
        return path.floor_height if floor is None else floor

    def denoiser(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Denoise:
        """x̂0 as a function of x_t, to be called once per sampling step in order; conditions are encoded once."""
        net, guidance = self.model.net, self.sampling.guidance
        encoded, unguided = net.encode(conditions, valid), None
        if guidance != 1.0:
            none = torch.zeros_like(valid)
            unguided = net.encode(conditions._replace(points_valid=none, image_valid=none), valid)
        steps, number, last = self._steps, 0, None
        assert steps is not None

        def denoise(x_t: Tensor, level: Tensor) -> Tensor:
            nonlocal last, number
            x0_hat = steps(number, x_t, encoded, valid, last)
            if unguided is not None:
                plain = steps(number, x_t, unguided, valid, last)
                x0_hat = plain + guidance * (x0_hat - plain)
            last, number = x0_hat if net.self_conditioning else None, number + 1
            return x0_hat

        return denoise

    def _windows(self, paths: Sequence[HeadPath], frames: Sequence[Frames], seeds: Sequence[int]) -> list[Poses]:
        """Step 4: poses of every path, window after window; all stretches of all paths share batches."""
        stride, lookahead_frames, passed = self.advance, self.lookahead_frames, 0
        whole = [no_poses(self, len(path.timestamps)) for path in paths]
        items = [
            (i, start, stop, self.sampler(path.skeleton, seeds[i], start))
            for i, path in enumerate(paths)
            for start, stop in path.stretches
        ]
        while items:
            fresh = []
            for i, start, stop, _ in items:  # from `stop` on the last frame is repeated and marked as not valid
                take = torch.arange(start + passed, start + passed + stride)
                cut = Frames(*(part[:, take.clamp_max(stop - 1)] for part in frames[i]))
                fresh.append(cut._replace(valid=cut.valid & (take < stop)))
            advance([sampler for *_, sampler in items], fresh)
            passed += stride
            for i, start, stop, sampler in items:
                ended = start + passed >= stop
                left = 0 if ended else lookahead_frames
                (final, _), end = sampler.finalize(left), min(start + passed, stop) - left
                for target, part in zip(whole[i], final):
                    target[0, end - part.shape[1] : end] = part[0]
            items = [item for item in items if item[1] + passed < item[2]]
        return [Poses(*(part[0] for part in poses)) for poses in whole]

    def sampler(self, skeleton: Skeleton, seed: int, start: int) -> WindowSampler:
        """A sampler for the stretch that begins at frame `start`; every stretch of a recording has its own noise."""
        return WindowSampler(self, body_size(skeleton), seed + 1_000_003 * start)

    def _refined(self, path: HeadPath, frames: Frames, poses: Poses) -> Motion:
        """Steps 5 and 6 of a whole recording."""
        motion = self.motion(path.timestamps, path.skeleton, path.T_world_head, poses)
        if self.refinement is not None:
            measured = Measured.of(path.T_world_head, frames.floor_height[0])
            motion = self.refinement.refined(motion, measured, path.stretches, self.model.fps, anchored=True)
        if len(path.stretches) == 1:
            return motion
        return anchored_to_head(_bridged(motion, path.stretches), path.T_world_head)

    def motion(
        self, timestamps: Float64[Tensor, "time"], skeleton: Skeleton, T_world_head: Rigid, poses: Poses
    ) -> Motion:
        """Step 5: poses (without the batch axis) as a motion that is anchored to the measured head."""
        settings = {
            "pipeline": "hmd2",
            "steps": str(self.sampling.steps),
            "stride": str(self.advance),
            "eta": str(self.sampling.eta),
            "lookahead": str(self.lookahead_frames),
            "refinement": str(self.refinement),
        }
        contact = poses.foot_contact.repeat_interleave(2, -1) if self.model.features.contacts else None
        root = torch.zeros(len(timestamps), 3)
        motion = Motion(timestamps, skeleton, poses.R_parent_joint, root, contact, provenance=settings)
        return anchored_to_head(motion, T_world_head)


def _bridged(motion: Motion, stretches: tuple[tuple[int, int], ...]) -> Motion:
    """The motion with the frames between stretches interpolated (slerp) from the last pose before to the first one
    after."""
    R = motion.R_parent_joint.clone()
    for (_, before), (after, _) in pairwise(stretches):
        if after > before:
            share = torch.linspace(0, 1, after - before + 2)[1:-1]
            R[before:after] = rotation.between(R[before - 1], R[after], share[:, None])
    return replace(motion, R_parent_joint=R)
