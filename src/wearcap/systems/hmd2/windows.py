"""HMD²'s windows: each goes on from what the last one said and adds a few frames to it (thesis eq. 6.5).

In the document a window overwrites what was said already in every step of its denoising. In small strides its own errors
then lead it astray. Ours (`inpaint` off) says the whole window anew from the same noise, which belongs to the frames and
moves along with them: what windows say of the same moment agrees but for what they have learned since, and that
difference fades out over a few frames. Captures of whole recordings and streams both go through here, so that with the
same noise they are the same.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.data.features import FEET
from wearcap.diffusion.sampler import Denoise, sample
from wearcap.diffusion.schedule import Schedule
from wearcap.geometry.rigid import Rigid
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser


class Frames(NamedTuple):
    """What the model is told of some frames; one row per wearer, recording or stretch of a recording ("lane")."""

    R_world_head: Float[Tensor, "batch time 3 3"]
    t_world_head: Float[Tensor, "batch time 3"]
    floor_height: Float[Tensor, "batch time"]
    points: Float[Tensor, "batch time point_feature"]
    points_valid: Bool[Tensor, "batch time"]
    image: Float[Tensor, "batch time image_feature"]
    image_valid: Bool[Tensor, "batch time"]
    valid: Bool[Tensor, "batch time"]
    """False where the head is not known, and behind a recording's end; the other fields then hold any finite numbers."""


class Poses(NamedTuple):
    """What the model says of some frames."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    foot_contact: Float[Tensor, "batch time foot"]


class Given(NamedTuple):
    """Final poses of a lane's next frames, and where the head was."""

    poses: Poses
    T_world_head: Rigid


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
    inpaint: bool
    fade: int
    device: str

    def denoiser(self, conditions: Conditions, valid: Bool[Tensor, "batch time"]) -> Denoise: ...


def no_poses(pipeline: Model, count: int) -> Poses:
    """Placeholders for frames that nothing is said of yet."""
    joints = pipeline.features.joints
    return Poses(torch.eye(3).repeat(1, count, joints, 1, 1), torch.zeros(1, count, FEET))


def _behind(old: Iterable[Tensor], first: int, new: Iterable[Tensor]) -> Iterator[Tensor]:
    """Fields from frame `first` on, and what is new behind them."""
    return (torch.cat([before[:, first:], after], 1) for before, after in zip(old, new))


class WindowSampler:
    """The windows of one lane, one after the other; memory is bounded by the window.

    The first windows grow: they hold the frames there are, left-aligned, with the rest masked.
    """

    def __init__(self, pipeline: Model, size: Float[Tensor, "limb"], seed: int):
        self.pipeline, self.size = pipeline, size
        self.frames: Frames | None = None
        """The last window's."""
        self.predicted = no_poses(pipeline, 0)
        """Of the last window's frames."""
        self.noise = torch.zeros(1, 0, pipeline.steps, pipeline.features.motion_size)
        """Of the last window's frames, for every step."""
        self.given = 0
        """Number of the last window's frames whose poses are final; those of the others wait for what comes next."""
        self._random = torch.Generator().manual_seed(seed)

    def state(self) -> dict[str, Tensor]:
        """Everything that the next windows depend on, as tensors by name."""
        tensors = {"size": self.size, "random": self._random.get_state(), "noise": self.noise}
        tensors |= {"given": torch.tensor(self.given), **self.predicted._asdict()}
        return tensors | (self.frames._asdict() if self.frames is not None else {})

    @classmethod
    def restored(cls, pipeline: Model, state: dict[str, Tensor]) -> "WindowSampler":
        """One that goes on from what `state` gave."""
        sampler = cls(pipeline, state["size"], 0)
        sampler._random.set_state(state["random"].contiguous())
        sampler.noise, sampler.given = state["noise"], int(state["given"])
        sampler.predicted = Poses(*(state[name] for name in Poses._fields))
        if "valid" in state:
            sampler.frames = Frames(*(state[name] for name in Frames._fields))
        return sampler

    def correct(self, T_world_head: Rigid) -> None:
        """Put the head of the last frames where it turned out to have been."""
        if self.frames is not None:
            kept = self.frames.valid.shape[1] - len(T_world_head.t)
            self.frames = self.frames._replace(
                R_world_head=torch.cat([self.frames.R_world_head[:, :kept], T_world_head.R[None]], 1),
                t_world_head=torch.cat([self.frames.t_world_head[:, :kept], T_world_head.t[None]], 1),
            )

    @property
    def count(self) -> int:
        """Frames of the window that have come."""
        return self.noise.shape[1]

    def join(self, fresh: Frames) -> None:
        """Move the window on to what is new."""
        new = fresh.valid.shape[1]
        first = max(0, self.count + new - self.pipeline.net.window)
        self.given = max(0, self.given - first)
        noise = torch.randn(1, new, *self.noise.shape[2:], generator=self._random)
        self.noise = torch.cat([self.noise[:, first:], noise], 1)
        self.predicted = Poses(*_behind(self.predicted, first, no_poses(self.pipeline, new)))
        self.frames = fresh if self.frames is None else Frames(*_behind(self.frames, first, fresh))

    def give(self, lookahead_frames: int) -> Given:
        """What is said and not given yet, but for the last `lookahead_frames` frames, which the next windows say again."""
        assert self.frames is not None
        # Behind a recording's end there is nothing to give.
        until = max(self.given, int(self.frames.valid.sum()) - lookahead_frames)
        part = slice(self.given, until)
        self.given = until
        head = Rigid(self.frames.R_world_head[0, part], self.frames.t_world_head[0, part])
        return Given(Poses(*(poses[:, part] for poses in self.predicted)), head)


@torch.inference_mode()
def advance(samplers: Sequence[WindowSampler], fresh: Sequence[Frames]) -> None:
    """Say the next frames of several lanes of one pipeline, in one batch.

    All lanes bring the same number of frames, at most a window's; how many they brought before may differ.
    """
    for sampler, new in zip(samplers, fresh):
        sampler.join(new)
    poses = _sample(samplers)
    for item, sampler in enumerate(samplers):
        sampler.predicted = Poses(*(part[item : item + 1, : sampler.count] for part in poses))


def _sample(samplers: Sequence[WindowSampler]) -> Poses:
    """Poses of a whole window of every lane."""
    pipeline = samplers[0].pipeline
    net, features, device = pipeline.net, pipeline.features, pipeline.device
    frames = Frames(*_padded([sampler.frames for sampler in samplers], net.window))
    predicted = Poses(*_padded([sampler.predicted for sampler in samplers], net.window))
    noise, *_ = _padded([(sampler.noise,) for sampler in samplers], net.window)
    number = torch.arange(net.window)
    is_observed = number < torch.tensor([[sampler.given] for sampler in samplers])
    valid = frames.valid & (number < torch.tensor([[sampler.count] for sampler in samplers]))
    size = torch.stack([sampler.size for sampler in samplers])
    head = features.condition(
        frames.R_world_head, frames.t_world_head, frames.floor_height, size, pipeline.fps
    )
    parts = head, frames.points, frames.points_valid, frames.image, frames.image_valid
    conditions = Conditions(*(part.to(device) for part in parts))
    # Re-expressed in this window's frame, which may have moved since the last one.
    observed = net.motion_normalizer(
        features.encode(predicted.R_parent_joint, frames.R_world_head, predicted.foot_contact).to(device)
    )
    is_observed_there = is_observed.to(device)
    x0 = sample(
        pipeline.denoiser(conditions, valid.to(device)), noise.movedim(2, 0).to(device), pipeline.schedule,
        eta=pipeline.eta, spacing=pipeline.spacing, observed=observed, is_observed=is_observed_there if pipeline.inpaint else None,
    )  # fmt: skip
    x0 = joined(x0, observed, is_observed_there, pipeline.fade)
    motion = net.motion_normalizer.inverse(x0.float()).cpu()
    poses = Poses(*features.decode(motion, frames.R_world_head))
    return Poses(
        *(
            torch.where(is_observed.reshape(*is_observed.shape, *[1] * (old.ndim - 2)), old, new)
            for old, new in zip(predicted, poses)
        )
    )


def joined(
    x0_hat: Float[Tensor, "batch time feature"],
    observed: Float[Tensor, "batch time feature"],
    is_observed: Bool[Tensor, "batch time"],
    fade: int,
) -> Float[Tensor, "batch time feature"]:
    """x̂0 overwritten where it is known; what the last known frame and its step differ by fades out over the `fade` frames behind it.

    The way back is a cubic (Hermite) with neither a step nor a kink at its ends. 0 leaves a step there.
    """
    whole = torch.where(is_observed[..., None], observed, x0_hat)
    if not fade:
        return whole
    number = torch.arange(x0_hat.shape[1], device=x0_hat.device)
    seam = (number * is_observed).amax(1)
    row = torch.arange(len(seam), device=seam.device)
    there, before = (is_observed[row, frame, None] for frame in (seam, seam - 1))
    differs = observed - x0_hat
    step = differs[row, seam] * there
    slope = (step - differs[row, seam - 1]) * (there & before)
    way = ((number - seam[:, None]) / fade).clamp(0, 1)[..., None]
    carried = (1 - way) ** 2 * ((1 + 2 * way) * step[:, None] + fade * way * slope[:, None])
    return torch.where(is_observed[..., None], whole, whole + carried * (number > seam[:, None])[..., None])


def _padded(items: Sequence, window: int) -> Iterator[Tensor]:
    """Fields of several lanes stacked, their last frame repeated up to the window's length."""
    for parts in zip(*items):
        number = [torch.arange(window).clamp_max(part.shape[1] - 1) for part in parts]
        yield torch.cat([part[:, take] for part, take in zip(parts, number)])
