"""HMD² (thesis ch. 6): environment-aware full-body capture from a head-mounted device by conditional diffusion."""

from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.diffusion.process import Denoise, sample, step_levels
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording
from wearcap.runtime.needs import HEAD, HEIGHT, POINTS
from wearcap.runtime.system import CaptureInput, LearnedSystem
from wearcap.runtime.windows import FinalPoses, batched, cut, over_path
from wearcap.systems.hmd2.conditions import CONDITIONS
from wearcap.systems.hmd2.model import Conditions, StepRunner
from wearcap.systems.hmd2.sensing import Sensing
from wearcap.systems.hmd2.windows import DiffusionModel, Frames, Predicted, WindowSampler, blended
from wearcap.tracking.anchor import anchored_to_head
from wearcap.tracking.floor import floor_from_points
from wearcap.tracking.head_path import HeadPath, head_path
from wearcap.tracking.refinement import Refinement


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
    """Scale of classifier-free guidance by the conditions beside the head (Ho & Salimans 2022; ours); 1 turns it off."""


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
    use: Sequence[str] | None = None
    """Conditions beside the head, of those that the model was trained on and the recording contains; None: all."""
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
    sampled = "ablation/hmd2_sampled"
    experiment = "experiment=hmd2"
    shared = ("hmd2",)
    required = (HEAD, POINTS, HEIGHT)

    def __post_init__(self):
        self._steps: StepRunner | None = None
        known = [kind.use for kind in CONDITIONS.values()]
        if unknown := set(self.used) - set(known):
            raise WearcapError(f"no condition {min(unknown)!r}", expected=f"some of {', '.join(known)}")

    @property
    def used(self) -> Collection[str]:
        """Conditions that are used, of those that the model and the recording have."""
        return [kind.use for kind in CONDITIONS.values()] if self.use is None else self.use

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
        once = {id(recording): recording for recording in recordings}
        # 1. head path and floor; 2. codes of the points around the body; 3. image embeddings; once for all seeds
        path_of = {key: head_path(recording, self.model.skeleton, self.fps) for key, recording in once.items()}
        sensed = {key: self.sense(recording, path_of[key]) for key, recording in once.items()}
        # 4. windows of the diffusion model; all stretches of all paths share batches
        paths, samplers = [path_of[id(recording)] for recording in recordings], []
        for recording, path, seed in zip(recordings, paths, seeds):
            samplers.append([self.sampler(path.skeleton, seed, start) for start, _ in path.stretches])
            for stretch, sampler in zip(path.stretches, samplers[-1]):
                sampler.push(cut(sensed[id(recording)], slice(*stretch)))
        self.predict([sampler for mine in samplers for sampler in mine])
        # 5. anchor the body to the measured head; 6. smooth it and hold its feet
        return [self._refined(*parts) for parts in zip(paths, samplers)]

    def sense(self, recording: Recording, path: HeadPath) -> Frames:
        """Steps 2 and 3: the conditions of a whole recording. Raises WearcapError as `Sensing.of` does."""
        sensing, floor = Sensing.of(self.model, self.used, recording, path.stature), None
        if not self.live:  # from the points where they are used, else from the head's path
            cloud = recording.points if "points" in sensing.sensed else None
            floor = floor_from_points(cloud, path.T_world_head.t, path.stature)
            floor = path.floor_height if floor is None else floor
        return sensing.frames(path.timestamps, path.T_world_device, path.T_world_head, floor)

    def denoiser(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Denoise:
        """x̂0 as a function of x_t, to be called once per sampling step in order; conditions are encoded once."""
        net, guidance = self.model.net, self.sampling.guidance
        encoded, unguided = net.encode(conditions, valid), None
        if guidance != 1.0:
            unguided = net.encode(conditions._replace(given=torch.zeros_like(conditions.given)), valid)
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

    def sampler(self, skeleton: Skeleton, seed: int, start: int) -> WindowSampler:
        """A sampler for the stretch that begins at frame `start`; every stretch of a recording has its own noise."""
        seed = seed + 1_000_003 * start
        return WindowSampler(self.model.features, skeleton, self.window, self.sampling.steps, seed)

    @torch.inference_mode()
    def predict(self, samplers: Sequence[WindowSampler]) -> None:
        """Step 4: predict the frames that wait in several batch items, window after window.

        How many frames an item has, or had before, may differ.
        """
        while samplers := [sampler for sampler in samplers if sampler.waiting is not None]:
            for sampler in samplers:
                sampler.join(self.advance)
            self._predict(samplers)
            for sampler in samplers:
                sampler.emit(self.lookahead_frames)

    def _predict(self, samplers: Sequence[WindowSampler]) -> None:
        """Predict one window of every batch item."""
        count = self.window
        frames = batched([sampler.frames for sampler in samplers if sampler.frames is not None], count)
        predicted = batched([sampler.predicted for sampler in samplers], count)
        number = torch.arange(count)
        is_observed = number < torch.tensor([[sampler.final_count] for sampler in samplers])
        valid = frames.valid & (number < torch.tensor([[sampler.count] for sampler in samplers]))
        size = torch.stack([sampler.size for sampler in samplers])
        poses = self.window_poses(frames._replace(valid=valid), predicted, is_observed, size)
        for item, sampler in enumerate(samplers):
            mine = (part[item : item + 1, : sampler.count] for part in (*poses, predicted.noise))
            sampler.predicted = Predicted(*mine)

    def window_poses(
        self,
        frames: Frames,
        predicted: Predicted,
        is_observed: Bool[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rotations, contacts and deviations of full windows, as in `Predicted`; observed frames keep theirs.

        `size`: as of `HeadFeatures.condition`.
        """
        net, features, device, valid = self.model.net, self.model.features, self.device, frames.valid
        head = features.condition(frames.R_world_head, frames.t_world_head, frames.floor_height, size, self.model.fps)
        conditions = Conditions(*(part.to(device) for part in (head, frames.others, frames.given)))
        # The last window's poses are re-expressed in this window's canonical frame, which may have moved.
        observed = net.motion_normalizer(
            features.encode(predicted.R_parent_joint, frames.R_world_head, predicted.foot_contact).to(device)
        )
        is_observed_on_device = is_observed.to(device)
        x0 = sample(
            self.denoiser(conditions, valid.to(device)),
            predicted.noise.movedim(2, 0).to(device),
            self.model.schedule,
            eta=self.sampling.eta,
            spacing=self.sampling.spacing,
            observed=observed,
            is_observed=is_observed_on_device if self.overlap.inpaint else None,
        )
        x0 = blended(x0, observed, is_observed_on_device, self.overlap.fade)
        motion = net.motion_normalizer.inverse(x0.float()).cpu()
        found = *features.decode(motion, frames.R_world_head), features.joint_std(motion)
        R, contact, std = (
            torch.where(is_observed.reshape(*is_observed.shape, *[1] * (old.ndim - 2)), old, new)
            for old, new in zip(predicted[:3], found)
        )
        return R, contact, std

    def _refined(self, path: HeadPath, samplers: Sequence[WindowSampler]) -> Motion:
        """Steps 5 and 6 of a whole recording."""
        final = over_path(path, samplers)
        motion = self.motion(final, path.skeleton)
        if self.refinement is not None:
            motion = self.refinement.refined(motion, final.measured, path.stretches, self.fps, anchored=True)
        if len(path.stretches) == 1:
            return motion
        return anchored_to_head(_bridged(motion, path.stretches), path.T_world_head)

    def motion(self, final: FinalPoses, skeleton: Skeleton) -> Motion:
        """Step 5: predicted poses as a motion that is anchored to the measured head."""
        settings = {
            "pipeline": "hmd2",
            "steps": str(self.sampling.steps),
            "stride": str(self.advance),
            "eta": str(self.sampling.eta),
            "lookahead": str(self.lookahead_frames),
            "refinement": str(self.refinement),
        }
        motion = final.motion(skeleton, settings, self.model.features.contacts)
        return anchored_to_head(replace(motion, joint_dof=self.model.joint_dof), final.T_world_head)


def _bridged(motion: Motion, stretches: tuple[tuple[int, int], ...]) -> Motion:
    """The motion with the frames between stretches interpolated (slerp) from the last pose before to the first one
    after."""
    R = motion.R_parent_joint.clone()
    for (_, before), (after, _) in pairwise(stretches):
        if after > before:
            share = torch.linspace(0, 1, after - before + 2)[1:-1]
            R[before:after] = rotation.between(R[before - 1], R[after], share[:, None])
    return replace(motion, R_parent_joint=R)
