"""HMD²'s windows (thesis eq. 6.5): each holds on to what the last one said and adds a few frames to it.

Captures of whole recordings and streaming captures both go through here, so that with the same noise they are the same.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.data.features import FEET, HeadFeatures
from wearcap.diffusion.sampler import Denoise, sample
from wearcap.diffusion.schedule import Schedule
from wearcap.geometry.rigid import Rigid
from wearcap.models.denoiser import Conditions, MotionDenoiser


class Frames(NamedTuple):
    """What the model is told of some frames; one row per wearer, recording or stretch of a recording ("lane")."""

    R_world_head: Float[Tensor, "lane time 3 3"]
    t_world_head: Float[Tensor, "lane time 3"]
    floor_height: Float[Tensor, "lane time"]
    points: Float[Tensor, "lane time point_feature"]
    points_valid: Bool[Tensor, "lane time"]
    image: Float[Tensor, "lane time image_feature"]
    image_valid: Bool[Tensor, "lane time"]
    valid: Bool[Tensor, "lane time"]
    """False where the head is not known, and behind a recording's end; the other fields then hold any finite numbers."""


class Poses(NamedTuple):
    """What the model says of some frames."""

    R_parent_joint: Float[Tensor, "lane time joint 3 3"]
    foot_contact: Float[Tensor, "lane time foot"]


@runtime_checkable
class Model(Protocol):
    """What windows are sampled with: `HMD2`'s own fields."""

    net: MotionDenoiser
    features: HeadFeatures
    schedule: Schedule
    fps: float
    steps: int
    eta: float
    spacing: float
    memory: int | None
    fade: int
    device: str

    def denoiser(self, conditions: Conditions, valid: Bool[Tensor, "lane time"]) -> Denoise: ...


class WindowSampler:
    """The windows of one lane, one after the other; memory is bounded by the window.

    The first windows grow: they hold the frames there are, left-aligned, with the rest masked.
    """

    def __init__(self, pipeline: Model, size: Float[Tensor, "limb"], seed: int):
        self.pipeline, self.size = pipeline, size
        self.frames: Frames | None = None
        """The last window's."""
        self.said: Poses | None = None
        """Of the last window's frames."""
        self._random = torch.Generator().manual_seed(seed)

    def state(self) -> dict[str, Tensor]:
        """Everything that the next windows depend on, as tensors by name."""
        tensors = {"size": self.size, "random": self._random.get_state()}
        for part in (self.frames, self.said):
            tensors |= part._asdict() if part is not None else {}
        return tensors

    @classmethod
    def restored(cls, pipeline: Model, state: dict[str, Tensor]) -> "WindowSampler":
        """One that goes on from what `state` gave."""
        sampler = cls(pipeline, state["size"], 0)
        sampler._random.set_state(state["random"].contiguous())
        if "valid" in state:
            sampler.frames = Frames(*(state[name] for name in Frames._fields))
            sampler.said = Poses(*(state[name] for name in Poses._fields))
        return sampler

    def amend(self, T_world_head: Rigid) -> None:
        """Put the head of the last frames where it turned out to have been."""
        if self.frames is not None:
            kept = self.frames.valid.shape[1] - len(T_world_head.t)
            self.frames = self.frames._replace(
                R_world_head=torch.cat([self.frames.R_world_head[:, :kept], T_world_head.R[None]], 1),
                t_world_head=torch.cat([self.frames.t_world_head[:, :kept], T_world_head.t[None]], 1),
            )

    def joined(self, fresh: Frames) -> tuple[Frames, Poses, int]:
        """Frames of the next window, their poses, and the number of those that are said already."""
        count, joints = fresh.valid.shape[1], self.pipeline.features.joints
        unsaid = Poses(torch.eye(3).expand(1, count, joints, 3, 3), torch.zeros(1, count, FEET))
        if self.frames is None or self.said is None:
            return fresh, unsaid, 0
        overlap = min(self.pipeline.net.window - count, self.frames.valid.shape[1])
        first = self.frames.valid.shape[1] - overlap
        frames = Frames(*(torch.cat([old[:, first:], new], 1) for old, new in zip(self.frames, fresh)))
        return (
            frames,
            Poses(*(torch.cat([old[:, first:], new], 1) for old, new in zip(self.said, unsaid))),
            overlap,
        )

    def noise(self) -> Float[Tensor, "draw time feature"]:
        pipeline = self.pipeline
        shape = pipeline.steps, pipeline.net.window, pipeline.features.motion_size
        return torch.randn(shape, generator=self._random)


@torch.inference_mode()
def advance(samplers: Sequence[WindowSampler], fresh: Sequence[Frames]) -> list[Poses]:
    """Poses of the next frames of several lanes of one pipeline, in one batch.

    All lanes bring the same number of frames, at most a window's; how many they brought before may differ.
    """
    joined = [sampler.joined(new) for sampler, new in zip(samplers, fresh)]
    poses = _sample(samplers, joined)
    given = []
    for lane, (sampler, (frames, _, overlap)) in enumerate(zip(samplers, joined)):
        sampler.frames = frames
        sampler.said = Poses(*(part[lane : lane + 1, : frames.valid.shape[1]] for part in poses))
        given.append(Poses(*(part[:, overlap:] for part in sampler.said)))
    return given


def _sample(samplers: Sequence[WindowSampler], lanes: list[tuple[Frames, Poses, int]]) -> Poses:
    """Poses of a whole window of every lane."""
    pipeline = samplers[0].pipeline
    net, features, device = pipeline.net, pipeline.features, pipeline.device
    frames = Frames(*_padded([lane[0] for lane in lanes], net.window))
    held = Poses(*_padded([lane[1] for lane in lanes], net.window))
    number = torch.arange(net.window)
    is_known = number < torch.tensor([[overlap] for _, _, overlap in lanes])
    valid = frames.valid & (number < torch.tensor([[lane[0].valid.shape[1]] for lane in lanes]))
    size = torch.stack([sampler.size for sampler in samplers])
    head = features.condition(
        frames.R_world_head, frames.t_world_head, frames.floor_height, size, pipeline.fps
    )
    # Re-expressed in this window's frame, which may have moved since the last one.
    known = net.motion_normalizer(
        features.encode(held.R_parent_joint, frames.R_world_head, held.foot_contact).to(device)
    )
    memory = net.window if pipeline.memory is None else pipeline.memory
    remembered = is_known & (number >= torch.tensor([[overlap - memory] for _, _, overlap in lanes]))
    told = head, frames.points, frames.points_valid, frames.image, frames.image_valid, known, remembered
    conditions = Conditions(*(part.to(device) for part in told))
    noise = torch.stack([sampler.noise() for sampler in samplers], 1).to(device)
    x0 = sample(
        pipeline.denoiser(conditions, valid.to(device)), noise, pipeline.schedule,
        eta=pipeline.eta, spacing=pipeline.spacing, known=known, is_known=remembered.to(device),
        fade=pipeline.fade,
    )  # fmt: skip
    motion = net.motion_normalizer.inverse(x0.float()).cpu()
    poses = Poses(*features.decode(motion, frames.R_world_head))
    return Poses(
        *(
            torch.where(is_known.reshape(*is_known.shape, *[1] * (old.ndim - 2)), old, new)
            for old, new in zip(held, poses)
        )
    )


def _padded(lanes: list, window: int) -> Iterator[Tensor]:
    """Fields of several lanes stacked, their last frame repeated up to the window's length."""
    for parts in zip(*lanes):
        number = [torch.arange(window).clamp_max(part.shape[1] - 1) for part in parts]
        yield torch.cat([part[:, take] for part, take in zip(parts, number)])
