"""HMD²'s overlapping windows: each continues the last one's prediction by a few frames (thesis eq. 6.5).

In the thesis every denoising step of a window overwrites the overlap with the last window's prediction (inpainting).
With small strides a window then accumulates its own errors. Ours (`inpaint` off) re-denoises each window from the same
noise, which is drawn per frame and moves along with its frame: successive windows' predictions for a frame differ only
by what the later window has seen since, and after the last final frame that difference fades out over `fade` frames.
Captures of whole recordings and streams both use this module, so that the same noise gives the same poses.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import FEET
from wearcap.diffusion.process import sample
from wearcap.geometry.rigid import Rigid
from wearcap.systems.hmd2.model import Conditions
from wearcap.tracking.refinement import Measured

if TYPE_CHECKING:
    from wearcap.systems.hmd2.pipeline import HMD2


class Frames(NamedTuple):
    """Conditioning of some frames; a batch item is one wearer, recording or stretch of a recording."""

    R_world_head: Float[Tensor, "batch time 3 3"]
    t_world_head: Float[Tensor, "batch time 3"]
    floor_height: Float[Tensor, "batch time"]
    points: Float[Tensor, "batch time point_feature"]
    points_valid: Bool[Tensor, "batch time"]
    image: Float[Tensor, "batch time image_feature"]
    image_valid: Bool[Tensor, "batch time"]
    valid: Bool[Tensor, "batch time"]
    """False where the head pose is missing and after a recording's end; other fields are any finite numbers there."""


class Poses(NamedTuple):
    """Predicted poses and foot contacts of some frames."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    foot_contact: Float[Tensor, "batch time foot"]


def no_poses(pipeline: "HMD2", count: int) -> Poses:
    """Placeholder poses (identity rotations, no contact) for frames without a prediction."""
    joints = pipeline.model.features.joints
    return Poses(torch.eye(3).repeat(1, count, joints, 1, 1), torch.zeros(1, count, FEET))


def _appended(old: Iterable[Tensor], first: int, new: Iterable[Tensor]) -> Iterator[Tensor]:
    """Every field without its frames before `first`, followed by the new frames."""
    return (torch.cat([before[:, first:], after], 1) for before, after in zip(old, new))


class WindowSampler:
    """Samples the windows of one batch item one after the other; memory is bounded by the window.

    The first windows grow: they contain the frames so far, left-aligned, and the remaining frames are masked.
    """

    def __init__(self, pipeline: "HMD2", size: Float[Tensor, "limb"], seed: int):
        self.pipeline, self.size = pipeline, size
        self.frames: Frames | None = None
        """Conditioning of the last window's frames."""
        self.predicted = no_poses(pipeline, 0)
        """Poses of the last window's frames."""
        self.noise = torch.zeros(1, 0, pipeline.sampling.steps, pipeline.model.features.motion_size)
        """Noise of the last window's frames for every sampling step: "1 time step feature"."""
        self.final = 0
        """Number of the last window's frames whose poses are final; the next windows re-denoise the others."""
        self._random = torch.Generator().manual_seed(seed)

    def correct(self, T_world_head: Rigid) -> None:
        """Replace the last frames' extrapolated head poses by the measured ones."""
        if self.frames is not None:
            kept = self.frames.valid.shape[1] - len(T_world_head.t)
            self.frames = self.frames._replace(
                R_world_head=torch.cat([self.frames.R_world_head[:, :kept], T_world_head.R[None]], 1),
                t_world_head=torch.cat([self.frames.t_world_head[:, :kept], T_world_head.t[None]], 1),
            )

    @property
    def count(self) -> int:
        """Number of frames in the window so far."""
        return self.noise.shape[1]

    def join(self, fresh: Frames) -> None:
        """Append new frames to the window and drop the oldest beyond its length."""
        new = fresh.valid.shape[1]
        first = max(0, self.count + new - self.pipeline.window)
        self.final = max(0, self.final - first)
        noise = torch.randn(1, new, *self.noise.shape[2:], generator=self._random)
        self.noise = torch.cat([self.noise[:, first:], noise], 1)
        self.predicted = Poses(*_appended(self.predicted, first, no_poses(self.pipeline, new)))
        self.frames = fresh if self.frames is None else Frames(*_appended(self.frames, first, fresh))

    def finalize(self, lookahead_frames: int) -> tuple[Poses, Measured]:
        """Mark all predictions but the last `lookahead_frames` as final; returns the newly final ones with their head
        poses and floor."""
        assert self.frames is not None
        # Frames after a recording's end are not valid and never output.
        until = max(self.final, int(self.frames.valid.sum()) - lookahead_frames)
        part = slice(self.final, until)
        self.final = until
        head = Rigid(self.frames.R_world_head[0, part], self.frames.t_world_head[0, part])
        measured = Measured.of(head, self.frames.floor_height[0, part])
        return Poses(*(poses[:, part] for poses in self.predicted)), measured


@torch.inference_mode()
def advance(samplers: Sequence[WindowSampler], fresh: Sequence[Frames]) -> None:
    """Predict the next frames of several batch items of one pipeline.

    All items add the same number of frames, at most a window; how many they had before may differ.
    """
    for sampler, new in zip(samplers, fresh):
        sampler.join(new)
    pipeline = samplers[0].pipeline
    net, features, device, window = pipeline.model.net, pipeline.model.features, pipeline.device, pipeline.window
    frames = Frames(*_padded([sampler.frames for sampler in samplers], window))
    predicted = Poses(*_padded([sampler.predicted for sampler in samplers], window))
    noise, *_ = _padded([(sampler.noise,) for sampler in samplers], window)
    number = torch.arange(window)
    is_observed = number < torch.tensor([[sampler.final] for sampler in samplers])
    valid = frames.valid & (number < torch.tensor([[sampler.count] for sampler in samplers]))
    size = torch.stack([sampler.size for sampler in samplers])
    head = features.condition(frames.R_world_head, frames.t_world_head, frames.floor_height, size, pipeline.model.fps)
    parts = head, frames.points, frames.points_valid, frames.image, frames.image_valid
    conditions = Conditions(*(part.to(device) for part in parts))
    # The last window's poses are re-expressed in this window's canonical frame, which may have moved.
    observed = net.motion_normalizer(
        features.encode(predicted.R_parent_joint, frames.R_world_head, predicted.foot_contact).to(device)
    )
    is_observed_on_device = is_observed.to(device)
    x0 = sample(
        pipeline.denoiser(conditions, valid.to(device)),
        noise.movedim(2, 0).to(device),
        pipeline.model.schedule,
        eta=pipeline.sampling.eta,
        spacing=pipeline.sampling.spacing,
        observed=observed,
        is_observed=is_observed_on_device if pipeline.overlap.inpaint else None,
    )
    x0 = blended(x0, observed, is_observed_on_device, pipeline.overlap.fade)
    motion = net.motion_normalizer.inverse(x0.float()).cpu()
    poses = [
        torch.where(is_observed.reshape(*is_observed.shape, *[1] * (old.ndim - 2)), old, new)
        for old, new in zip(predicted, features.decode(motion, frames.R_world_head))
    ]
    for item, sampler in enumerate(samplers):
        sampler.predicted = Poses(*(part[item : item + 1, : sampler.count] for part in poses))


def blended(
    x0_hat: Float[Tensor, "batch time feature"],
    observed: Float[Tensor, "batch time feature"],
    is_observed: Bool[Tensor, "batch time"],
    fade: int,
) -> Float[Tensor, "batch time feature"]:
    """x̂0 overwritten by the observed frames; its offset at the last of them fades out over the next `fade` frames.

    The offset (its value and slope) follows a cubic Hermite curve to zero, so that neither the motion nor its velocity
    jumps. `fade` 0 leaves a jump.
    """
    whole = torch.where(is_observed[..., None], observed, x0_hat)
    if not fade:
        return whole
    number = torch.arange(x0_hat.shape[1], device=x0_hat.device)
    seam = (number * is_observed).amax(1)
    row = torch.arange(len(seam), device=seam.device)
    there, before = (is_observed[row, frame, None] for frame in (seam, seam - 1))
    difference = observed - x0_hat
    step = difference[row, seam] * there
    slope = (step - difference[row, seam - 1]) * (there & before)
    share = ((number - seam[:, None]) / fade).clamp(0, 1)[..., None]
    offset = (1 - share) ** 2 * ((1 + 2 * share) * step[:, None] + fade * share * slope[:, None])
    return torch.where(is_observed[..., None], whole, whole + offset * (number > seam[:, None])[..., None])


def _padded(items: Sequence, window: int) -> Iterator[Tensor]:
    """Fields of several batch items concatenated, each padded to the window's length by its last frame."""
    for parts in zip(*items):
        number = [torch.arange(window).clamp_max(part.shape[1] - 1) for part in parts]
        yield torch.cat([part[:, take] for part, take in zip(parts, number)])
