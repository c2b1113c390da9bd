"""ECHO's queue of frames (ECHO §3.3): conditioning enters frame by frame, final outputs leave frame by frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.features import body_size
from wearcap.data.transforms import mirrored_rotations
from wearcap.diffusion.conveyor import Conveyor, Correct, Observation
from wearcap.diffusion.observed import residual_weights, with_residuals
from wearcap.diffusion.schedule import Schedule
from wearcap.geometry.rigid import Rigid
from wearcap.models.point_encoder import PointNeXt
from wearcap.runtime.windows import Window, cut
from wearcap.systems.echo.features import TWIN_CONTACTS, TWIN_POINTS, Body, EchoFeatures, ThreePoints
from wearcap.systems.echo.model import EchoDenoiser


class Conditioning(NamedTuple):
    """Conditioning of frames of several batch items: three tracked points, the active object, and observed values of
    the outputs."""

    timestamps: Float64[Tensor, "batch frame"]
    R_world_point: Float[Tensor, "batch frame point 3 3"]
    t_world_point: Float[Tensor, "batch frame point 3"]
    floor_height: Float[Tensor, "batch frame"]
    """World z of the floor (m)."""
    has_object: Bool[Tensor, "batch frame"]
    """Whether an object is active."""
    object_code: Float[Tensor, "batch frame code"]
    """Condition for the active object (`ObjectShape.code`)."""
    object_code_mirrored: Float[Tensor, "batch frame code"]
    """The same for the object mirrored along its own y axis."""
    object_number: Float[Tensor, "batch frame"]
    """Index of the active object among the batch item's objects, -1 without one."""
    valid: Bool[Tensor, "batch frame"]
    """False for padding."""
    R_parent_joint: Float[Tensor, "batch frame joint 3 3"]
    t_world_root: Float[Tensor, "batch frame 3"]
    R_world_object: Float[Tensor, "batch frame 3 3"]
    t_world_object: Float[Tensor, "batch frame 3"]
    contact: Float[Tensor, "batch frame contact"]
    """These five are observed values; arbitrary in frames whose modality is not observed."""
    is_observed: Bool[Tensor, "batch frame modality"]
    seen: Bool[Tensor, "batch frame point"]
    """Which of the three points are tracked; others' poses are any."""

    def frames(self, part: slice | Tensor) -> "Conditioning":
        """A selection of frames."""
        return cut(self, part)

    def mirrored(self, skeleton: Skeleton) -> "Conditioning":
        """The frames mirrored left to right; the object is mirrored along its own y axis, too, so that its pose stays a
        rotation."""
        flip = self.t_world_point.new_tensor(MIRROR)
        turn = torch.outer(flip, flip)
        return self._replace(
            R_world_point=self.R_world_point[:, :, TWIN_POINTS] * turn,
            t_world_point=self.t_world_point[:, :, TWIN_POINTS] * flip,
            object_code=self.object_code_mirrored,
            object_code_mirrored=self.object_code,
            R_parent_joint=mirrored_rotations(self.R_parent_joint, skeleton),
            t_world_root=self.t_world_root * flip,
            R_world_object=self.R_world_object * turn,
            t_world_object=self.t_world_object * flip,
            contact=self.contact[..., TWIN_CONTACTS],
            seen=self.seen[..., TWIN_POINTS],
        )

    @property
    def T_world_head(self) -> Rigid:
        """Measured head poses."""
        return Rigid(self.R_world_point[:, :, 0], self.t_world_point[:, :, 0])

    @property
    def points(self) -> ThreePoints:
        """The three tracked points."""
        return ThreePoints(self.R_world_point, self.t_world_point, self.seen)


class Outputs(NamedTuple):
    """Final body, object pose and contacts of frames, in world coordinates."""

    R_parent_joint: Float[Tensor, "batch frame joint 3 3"]
    t_world_root: Float[Tensor, "batch frame 3"]
    R_world_object: Float[Tensor, "batch frame 3 3"]
    """Orientation of the active object; arbitrary in frames without one."""
    t_world_object: Float[Tensor, "batch frame 3"]
    """Position of the active object's centre (m)."""
    contact_prob: Float[Tensor, "batch frame contact"]
    """64 body points on the object, then `FOOT_PATCHES` on the floor."""

    def mirrored(self, skeleton: Skeleton) -> "Outputs":
        """The frames mirrored left to right, the object along its own y axis, too."""
        flip = self.t_world_root.new_tensor(MIRROR)
        return Outputs(
            mirrored_rotations(self.R_parent_joint, skeleton),
            self.t_world_root * flip,
            self.R_world_object * torch.outer(flip, flip),
            self.t_world_object * flip,
            self.contact_prob[..., TWIN_CONTACTS],
        )


Guided = tuple[Sequence[BodyModel], Sequence[Sequence[KDTree]]]
"""What guidance needs of each batch item: contact points of its body, and surface points of its objects."""


@dataclass(frozen=True, eq=False)
class EchoModel:
    """A trained network, and what it was trained with."""

    net: EchoDenoiser
    features: EchoFeatures
    schedule: Schedule
    skeleton: Skeleton
    """Skeleton for recordings without one."""
    encoder: PointNeXt | None = None
    """Object encoder; None: objects are described by class and extents alone."""
    contacts: bool = True
    """Whether the network was trained on contacts."""


class EchoQueue(Window[Conditioning]):
    """Frames of several batch items, at most a window of them; each batch item's noise comes from its own seed."""

    def __init__(self, pipeline: Any, skeletons: Sequence[Skeleton], seeds: Sequence[int]):
        """`pipeline`: an `Echo`, whose network denoises the frames."""
        self.pipeline = pipeline
        self.size = torch.stack([body_size(skeleton) for skeleton in skeletons])
        self.t_parent_joint = torch.stack([skeleton.t_parent_joint for skeleton in skeletons])[:, None]
        model, self.rolling = pipeline.model, pipeline.rolling
        super().__init__(self.rolling.window)
        self.conveyor = Conveyor(self.rolling, model.schedule, model.net.sizes, len(seeds))
        self.guided: Guided | None = None
        """Bodies and objects, for a pipeline with guidance."""
        self._random = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._frame: Rigid | None = None
        self._padded = 0
        """Number of padding frames after the last one."""
        self._final: list[tuple[Conditioning, Outputs]] = []
        """Final frames that were not taken yet."""

    def correct(self, T_world_head: Rigid) -> None:
        """Replace the head poses of the newest frames, as far as these are not final."""
        frames, count = self.frames, min(len(T_world_head.t), self.pending)
        if frames is not None and count:
            R, t = frames.R_world_point.clone(), frames.t_world_point.clone()
            R[0, -count:, 0], t[0, -count:, 0] = T_world_head.R[-count:], T_world_head.t[-count:]
            self.frames = frames._replace(R_world_point=R, t_world_point=t)

    def guide(self, guided: Guided) -> None:
        """Give the queue the bodies and objects that guidance needs."""
        self.guided = guided

    @property
    def pending(self) -> int:
        """Number of frames that are not final."""
        return max(0, self.taken - self._padded - self.final)

    @torch.no_grad()
    def push(self, fresh: Conditioning) -> None:
        """Add frames of every batch item (padding after a batch item's end)."""
        self._final += map(self._with_conditioning, self._advanced(fresh))

    @torch.no_grad()
    def take(self, ended: bool = False) -> tuple[Conditioning, Outputs] | None:
        """Frames that became final since the last call, or None; `ended`: with all others, as none will follow."""
        if ended:
            self._final += map(self._with_conditioning, self._rest())
        if not self._final:
            return None
        given, outputs = zip(*self._final)
        self._final = []
        frames, found = (type(parts[0])(*(torch.cat(each, 1) for each in zip(*parts))) for parts in (given, outputs))
        real = slice(frames.valid.shape[1] - max(0, self.final + self._padded - self.taken))
        return frames.frames(real), cut(found, real)

    def _with_conditioning(self, outputs: Outputs) -> tuple[Conditioning, Outputs]:
        assert self.frames is not None
        return self.frames.frames(slice(self.final_count - outputs.t_world_root.shape[1], self.final_count)), outputs

    def _advanced(self, fresh: Conditioning) -> Iterator[Outputs]:
        first, count = 0, fresh.valid.shape[1]
        while first < count:
            part, first = slice(first, min(first + self._due, count)), first + self._due
            self.append(fresh.frames(part))
            if (outputs := self._advance()) is not None:
                yield outputs

    @property
    def _due(self) -> int:
        """Number of new frames that are needed to go on."""
        return 1

    def _advance(self) -> Outputs | None:
        """Go on by the newest frame; returns the frame that became final, if any."""
        conditioning, full = self.frames, self.conveyor.push(self._noise(1)[:, 0])
        assert conditioning is not None
        frame = self.pipeline.model.features.canonical(conditioning.points)
        if self.pipeline.model.features.moves and full:
            # The conveyor's frames are re-expressed in the window's new canonical frame.
            assert self._frame is not None
            change = frame.inverse() @ self._frame
            self.conveyor.x = self._reexpressed(self.conveyor.x, change, self.conveyor.level, conditioning)
        self._frame = frame
        count = len(self.conveyor.age)
        noise = self._noise(self.rolling.per_frame * count).unflatten(1, (self.rolling.per_frame, count))
        observation = self._observation(conditioning, frame)
        denoise, corrections = self.pipeline.denoiser(self, conditioning, frame)
        correct = self._corrected(corrections, conditioning, observation)
        self.conveyor.run(denoise, observation, noise.transpose(0, 1), correct)
        part = self.finalize(self.rolling.ramp - 1)
        return self._decoded(self.conveyor.x, part, frame) if part.stop > part.start else None

    @torch.no_grad()
    def run(self, whole: Conditioning) -> Outputs:
        """Outputs of all frames of a batch."""
        count, out, final = whole.valid.shape[1], None, 0
        for outputs in chain(self._advanced(whole), self._rest()):
            if out is None:  # allocate once: keeping small per-frame tensors fragments memory
                out = Outputs(*(field.new_empty(len(field), count, *field.shape[2:]) for field in outputs))
            stop = min(final + outputs.t_world_root.shape[1], count)
            for all_frames, field in zip(out, outputs):
                all_frames[:, final:stop] = field[:, : stop - final]
            final = stop
        assert out is not None
        return out

    def _rest(self) -> Iterator[Outputs]:
        """Outputs of the frames that are left, once padding follows them."""
        while self.pending:
            self._padded += 1
            yield from self._advanced(self._padding())

    def _padding(self) -> Conditioning:
        """A padding frame for all batch items: the last frame repeated as not valid."""
        assert self.frames is not None
        last = self.frames.frames(slice(-1, None))
        return last._replace(valid=torch.zeros_like(last.valid), is_observed=torch.zeros_like(last.is_observed))

    def _noise(self, rows: int) -> Float[Tensor, "batch row feature"]:
        width = sum(self.pipeline.model.net.sizes)
        return torch.stack([torch.randn(rows, width, generator=random) for random in self._random])

    def _observation(self, conditioning: Conditioning, frame: Rigid) -> Observation:
        """Observed values in normalised space; absent modalities stay noise."""
        observed = torch.zeros(*conditioning.valid.shape, sum(self.pipeline.model.net.sizes))
        if conditioning.is_observed.any():
            features = self.pipeline.model.features
            body = features.encode_body(Body(conditioning.R_parent_joint, conditioning.t_world_root), frame)
            T_world_object = Rigid(conditioning.R_world_object, conditioning.t_world_object)
            scene_object = features.encode_object(T_world_object, frame)
            raw = torch.cat([body, scene_object, 2 * conditioning.contact - 1], -1)
            observed = self.pipeline.model.net.motion_normalizer(raw.to(self.pipeline.device)).cpu()
        never = torch.zeros_like(conditioning.has_object)
        absent = [never, ~conditioning.has_object, never if self.pipeline.model.contacts else ~never]
        is_observed = conditioning.is_observed.clone()
        is_observed[..., 1] &= conditioning.has_object
        return Observation(observed, is_observed, torch.stack(absent, -1) & ~is_observed)

    def _corrected(
        self, corrections: Sequence[Correct], conditioning: Conditioning, observation: Observation
    ) -> Correct:
        """Spreads the residuals of observed frames, then applies the pipeline's corrections in turn."""
        frames, corrections = self.pipeline.sampling.observed_length_scale, list(corrections)
        if frames is not None and observation.is_observed.any():
            valid, number = conditioning.valid, torch.where(conditioning.has_object, conditioning.object_number, -1.0)
            together = valid[:, :, None] & valid[:, None]
            touching = together & (number[:, :, None] == number[:, None])
            alike = torch.stack([together, touching, touching], 1)
            weights = residual_weights(observation.is_observed.mT, alike, frames)
            sizes = self.pipeline.model.net.sizes
            corrections.insert(0, lambda x0_hat: with_residuals(x0_hat, observation.observed, weights, sizes))
        return lambda x0_hat: reduce(lambda value, correct: correct(value), corrections, x0_hat)

    def _reexpressed(
        self,
        x: Float[Tensor, "batch frame feature"],
        change: Rigid,
        level: Float[Tensor, "#batch #frame modality"],
        conditioning: Conditioning,
    ) -> Float[Tensor, "batch frame feature"]:
        """z' = A z + √ᾱ b at each modality's own level (exact: the channels of each vector share one scale)."""
        net, alpha_bar = self.pipeline.model.net, self.pipeline.model.schedule(level).sqrt()
        scale = net.motion_normalizer.scale.cpu()
        x = x.clone()
        for modality, at, present in ((0, 0, None), (1, net.sizes[0], conditioning.has_object[..., None])):
            shift = alpha_bar[..., modality, None] * (change.t / scale[at])
            shift = shift if present is None else shift * present
            x[..., at : at + 3] = self._turned(x[..., at : at + 3], change.R) + shift
            for column in (at + 3, at + 6):
                x[..., column : column + 3] = self._turned(x[..., column : column + 3], change.R)
        return x

    @staticmethod
    def _turned(value: Float[Tensor, "batch frame 3"], R: Float[Tensor, "batch 1 3 3"]) -> Tensor:
        return (R @ value[..., None])[..., 0]

    def _decoded(self, x: Float[Tensor, "batch frame feature"], part: slice, frame: Rigid) -> Outputs:
        """Some of a window's frames, converted from normalised space to world coordinates."""
        net, features = self.pipeline.model.net, self.pipeline.model.features
        raw = net.motion_normalizer.inverse(x[:, part].to(self.pipeline.device)).cpu()
        human, scene_object, contact = raw.split(net.sizes, -1)
        at = frame if frame.t.shape[1] == 1 else Rigid(frame.R[:, part], frame.t[:, part])
        body, T = features.decode_body(human, at), features.decode_object(scene_object, at)
        return Outputs(*body, T.R, T.t, ((contact + 1) / 2).clamp(0, 1))
