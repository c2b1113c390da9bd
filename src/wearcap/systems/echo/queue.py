"""ECHO's queue of frames (ECHO §3.3): conditioning enters frame by frame, final outputs leave frame by frame; and
overlapping windows in place of the conveyor that are denoised from scratch, with inpainted overlap (ECHO Fig. 3, left) or
averaged (ours)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.skeleton import Skeleton
from wearcap.data.features import body_size
from wearcap.diffusion.conveyor import Conveyor, Correct, Denoise, Observation, RollingSchedule
from wearcap.diffusion.observed import spreading, with_residuals
from wearcap.diffusion.process import posterior_step, step_levels
from wearcap.diffusion.schedule import Schedule
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_rot6d, rot6d_from_matrix
from wearcap.models.point_encoder import PointNeXt
from wearcap.systems.echo.features import CONTACTS, Body, EchoFeatures, ThreePoints
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser


class Conditioning(NamedTuple):
    """Conditioning of frames of several batch items: three tracked points, the active object, and observed values of
    the outputs."""

    R_world_point: Float[Tensor, "batch frame point 3 3"]
    t_world_point: Float[Tensor, "batch frame point 3"]
    floor_height: Float[Tensor, "batch frame"]
    """World z of the floor (m)."""
    has_object: Bool[Tensor, "batch frame"]
    """Whether an object is active."""
    object_code: Float[Tensor, "batch frame code"]
    """Condition for the active object (`ObjectShape.code`)."""
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

    def frames(self, part: slice | Tensor) -> "Conditioning":
        """A selection of frames."""
        return Conditioning(*(field[:, part] for field in self))

    @property
    def points(self) -> ThreePoints:
        """The three tracked points."""
        return ThreePoints(self.R_world_point, self.t_world_point)


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


class _Sampling(Protocol):
    """The part of a pipeline's sampling that the queue uses."""

    @property
    def spread(self) -> float | None: ...


@runtime_checkable
class _Pipeline(Protocol):
    """The part of a pipeline that the queue uses."""

    model: EchoModel
    sampling: "_Sampling"
    device: str

    @property
    def rolling(self) -> RollingSchedule: ...

    def denoiser(
        self, queue: "EchoQueue", conditioning: Conditioning, frame: Rigid
    ) -> tuple[Denoise, list[Correct]]: ...


class EchoQueue:
    """Frames of several batch items, at most a window of them; each batch item's noise comes from its own seed."""

    def __init__(self, pipeline: _Pipeline, skeletons: Sequence[Skeleton], seeds: Sequence[int]):
        self.pipeline = pipeline
        self.size = torch.stack([body_size(skeleton) for skeleton in skeletons])
        self.t_parent_joint = torch.stack([skeleton.t_parent_joint for skeleton in skeletons])[:, None]
        model, self.rolling = pipeline.model, pipeline.rolling
        self.conveyor = Conveyor(self.rolling, model.schedule, model.net.sizes, len(seeds))
        self.conditioning: Conditioning | None = None
        self.guided: tuple[list, list] | None = None
        """Contact points of bodies and KD-trees of objects per batch item, for a pipeline with guidance."""
        self._random = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._frame: Rigid | None = None

    transient = ("guided",)

    def restored(self) -> None:
        """A saved queue comes back without the bodies and objects that guidance needs."""
        self.guided = None

    @torch.no_grad()
    def push(self, fresh: Conditioning) -> Outputs | None:
        """Add one frame of every batch item (padding after a batch item's end); returns the frames that became final, if
        any."""
        noise = self._noise(1)[:, 0]
        full = self.conveyor.push(noise)
        if self.conditioning is not None:
            fresh = Conditioning(*(torch.cat([a[:, int(full) :], b], 1) for a, b in zip(self.conditioning, fresh)))
        self.conditioning = fresh
        frame = self.pipeline.model.features.canonical(self.conditioning.points)
        if self.pipeline.model.features.moves and full:
            # The conveyor's frames are re-expressed in the window's new canonical frame.
            assert self._frame is not None
            change = frame.inverse() @ self._frame
            self.conveyor.x = self._reexpressed(self.conveyor.x, change, self.conveyor.level, self.conditioning)
        self._frame = frame
        count = len(self.conveyor.age)
        noise = self._noise(self.rolling.per_frame * count).unflatten(1, (self.rolling.per_frame, count))
        observation = self._observation(self.conditioning, frame)
        denoise, corrections = self.pipeline.denoiser(self, self.conditioning, frame)
        correct = self._corrected(corrections, self.conditioning, observation)
        self.conveyor.run(denoise, observation, noise.transpose(0, 1), correct)
        clean = self.conveyor.clean
        return self._decoded(self.conveyor.x, slice(clean - 1, clean), frame) if clean else None

    def run(self, whole: Conditioning) -> Outputs:
        """Outputs of all frames of a batch."""
        count, pushed, final = whole.valid.shape[1], 0, 0
        out = None
        while final < count:
            outputs = self.push(whole.frames(slice(pushed, pushed + 1)) if pushed < count else self.padding())
            pushed += 1
            if outputs is None:
                continue
            if out is None:  # allocate once: keeping small per-frame tensors fragments memory
                out = Outputs(*(field.new_empty(len(field), count, *field.shape[2:]) for field in outputs))
            stop = min(final + outputs.t_world_root.shape[1], count)
            for all_frames, field in zip(out, outputs):
                all_frames[:, final:stop] = field[:, : stop - final]
            final = stop
        assert out is not None
        return out

    def padding(self) -> Conditioning:
        """A padding frame for all batch items: the last frame repeated as not valid."""
        assert self.conditioning is not None
        last = self.conditioning.frames(slice(-1, None))
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
            raw = torch.cat([body, features.encode_object(T_world_object, frame), 2 * conditioning.contact - 1], -1)
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
        frames, corrections = self.pipeline.sampling.spread, list(corrections)
        if frames is not None and observation.is_observed.any():
            valid, number = conditioning.valid, torch.where(conditioning.has_object, conditioning.object_number, -1.0)
            together = valid[:, :, None] & valid[:, None]
            touching = together & (number[:, :, None] == number[:, None])
            alike = torch.stack([together, touching, touching], 1)
            weights = spreading(observation.is_observed.mT, alike, frames)
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


class Rewindow(EchoQueue):
    """Windows that advance by `stride` frames: the last final frames (at most the context) are inpainted, the next
    `stride` frames become final, and the rest is discarded.

    With the conveyor's context, a frame sees as much of the past and future as on the conveyor. `steps` (None: those of
    a frame on the conveyor) are a window's: as many network evaluations as the conveyor's are `per_frame` times `stride`.
    """

    def __init__(
        self, pipeline: _Pipeline, skeletons: Sequence, seeds: Sequence[int], stride: int = 10, steps: int | None = None
    ):
        super().__init__(pipeline, skeletons, seeds)
        self.stride, self.steps = stride, steps or self.rolling.steps

    @torch.no_grad()
    def window(
        self, conditioning: Conditioning, before: Float[Tensor, "batch observed feature"]
    ) -> Float[Tensor, "batch frame feature"]:
        """A sampled window in normalised space, whose first frames are inpainted with `before`."""
        frame = self.pipeline.model.features.canonical(conditioning.points)
        count, observed_frames = conditioning.valid.shape[1], before.shape[1]
        observation = self._observation(conditioning, frame)
        denoise, corrections = self.pipeline.denoiser(self, conditioning, frame)
        correct = self._corrected(corrections, conditioning, observation)
        levels = step_levels(self.steps, self.rolling.spacing)
        # Always a full window's noise: a batch item's noise must not depend on the length of the others.
        x = self._noise(self.rolling.window)[:, :count]
        observed = observation.observed.clone()
        observed[:, :observed_frames] = before
        is_observed = observation.is_observed.clone()
        is_observed[:, :observed_frames] = ~observation.is_absent[:, :observed_frames]
        wide = self.conveyor.wide
        for now, after in pairwise(levels):
            level, then = (
                torch.where(is_observed, 0.0, torch.where(observation.is_absent, 1.0, value)) for value in (now, after)
            )
            x = torch.where(wide(is_observed), observed, x)
            x0_hat = correct(denoise(x, level))
            noise = self._noise(self.rolling.window)[:, :count]
            x = posterior_step(
                x, x0_hat, wide(level), wide(then), noise, self.pipeline.model.schedule, self.rolling.eta
            )
        return x

    @torch.no_grad()
    def run(self, whole: Conditioning) -> Outputs:
        """Outputs of all frames of a batch."""
        context, count = self.rolling.context, whole.valid.shape[1]
        outputs: list[Outputs] = []
        before, start = torch.zeros(len(whole.valid), 0, sum(self.pipeline.model.net.sizes)), 0
        while start < count:
            first = max(0, start - context)
            conditioning = whole.frames(slice(first, min(first + self.rolling.window, count)))
            before = before[:, before.shape[1] - (start - first) :]
            frame = self.pipeline.model.features.canonical(conditioning.points)
            if self._frame is not None and self.pipeline.model.features.moves:
                change, observed = frame.inverse() @ self._frame, conditioning.frames(slice(0, start - first))
                before = self._reexpressed(before, change, torch.zeros(1, 1, len(MODALITIES)), observed)
            self._frame = frame
            x = self.window(conditioning, before)
            stop = min(start + self.stride, count)
            outputs.append(self._decoded(x, slice(start - first, stop - first), frame))
            final = x[:, : stop - first]
            before, start = final[:, -context:] if context else final[:, :0], stop
        return Outputs(*(torch.cat(parts, 1) for parts in zip(*outputs)))


class AveragedWindows(Rewindow):
    """Windows that advance by `stride` frames without knowing of each other; what they predict for a frame is averaged.

    In one step from noise (`steps` 1) each is the mean of the plausible motions. Predictions weigh by the square of the
    frame's distance from the window's ends, unless the capture begins or ends there. Frames become final at the same
    latency as on the conveyor, `stride` at a time.
    """

    def __init__(
        self, pipeline: _Pipeline, skeletons: Sequence, seeds: Sequence[int], stride: int = 10, steps: int | None = None
    ):
        super().__init__(pipeline, skeletons, seeds, stride, steps)
        self._sum = torch.zeros(len(seeds), 0, 0)
        """Weighted sums of the predictions for the frames of `conditioning` (`_flat`), and sums of weights."""
        self._given = torch.zeros(len(seeds), 0, _GIVEN)
        """What these predictions were for (`_given`)."""
        self._pushed, self._final = 0, 0
        """Numbers of frames that were taken in, and that are final."""

    @torch.no_grad()
    def push(self, fresh: Conditioning) -> Outputs | None:
        """Add one frame of every batch item (padding after its end); returns the frames that became final, if any."""
        full = self.conditioning is not None and self.conditioning.valid.shape[1] == self.rolling.window
        if self.conditioning is not None:
            fresh = Conditioning(*(torch.cat([a[:, int(full) :], b], 1) for a, b in zip(self.conditioning, fresh)))
        self.conditioning = fresh
        self._pushed += 1
        self._sum, self._given = (F.pad(part[:, int(full) :], (0, 0, 0, 1)) for part in (self._sum, self._given))
        if self._pushed % self.stride:
            return None
        self._predict(self.conditioning)
        return self._finalized()

    def _predict(self, conditioning: Conditioning) -> None:
        """Add the window's prediction to the sums; a frame with another object, observation or pose of a tracked point than
        in the last window starts anew."""
        given = _given(conditioning)
        same, self._given = ((given - self._given).abs() < _ALIKE).all(-1, keepdim=True), given
        frame = self.pipeline.model.features.canonical(conditioning.points)
        x = self.window(conditioning, self._sum.new_zeros(len(given), 0, sum(self.pipeline.model.net.sizes)))
        flat = _flat(self._decoded(x, slice(None), frame))
        flat = torch.cat([flat, torch.ones_like(flat[..., :1])], -1)
        before = self._sum if self._sum.shape[-1] else torch.zeros_like(flat)
        self._sum = before * same + flat * self._weight(conditioning.valid)[..., None]

    def _weight(self, valid: Bool[Tensor, "batch frame"]) -> Float[Tensor, "batch frame"]:
        count, window = valid.shape[1], self.rolling.window
        place = torch.arange(1, count + 1).expand_as(valid)
        begins, ended = self._pushed <= window, ~valid[:, -1:]
        behind = torch.full_like(place, window) if begins else place
        ahead = torch.where(ended, window, count + 1 - place)
        return torch.minimum(behind, ahead).clamp_max(window // 2).square().float()

    def _finalized(self) -> Outputs | None:
        """The frames that are old enough; what later windows predict for them is not used."""
        count, lookahead = self._sum.shape[1], self.rolling.ramp - self.stride
        stop, start = count - lookahead, count - (self._pushed - self._final)
        if stop <= start:
            return None
        self._final += stop - start
        rows = self._sum[:, start:stop]
        return _unflat(rows[..., :-1] / rows[..., -1:], self.t_parent_joint.shape[-2])

    def run(self, whole: Conditioning) -> Outputs:
        return EchoQueue.run(self, whole)


_GIVEN, _ALIKE = 1 + len(MODALITIES) + 3 * 12 + 12, 1e-4
"""Values of `_given`, and the difference up to which they are the same."""


def _given(conditioning: Conditioning) -> Float[Tensor, "batch frame value"]:
    """What a stream may change in a frame that windows have predicted: the active object, what is observed, tracked points
    whose poses are corrected after a loss, and the observed pose of the object."""
    observed = conditioning.is_observed
    points = conditioning.R_world_point.flatten(2), conditioning.t_world_point.flatten(2)
    pose = torch.cat([conditioning.R_world_object.flatten(2), conditioning.t_world_object], -1)
    pose = torch.where(observed[..., 1:2], pose, 0.0)
    return torch.cat([conditioning.object_number[..., None], observed.float(), *points, pose], -1)


def _flat(outputs: Outputs) -> Float[Tensor, "batch frame value"]:
    """Outputs as values that may be averaged, rotations in 6D."""
    R = torch.cat([outputs.R_parent_joint, outputs.R_world_object[:, :, None]], 2)
    return torch.cat(
        [rot6d_from_matrix(R).flatten(-2), outputs.t_world_root, outputs.t_world_object, outputs.contact_prob], -1
    )


def _unflat(values: Float[Tensor, "batch frame value"], joints: int) -> Outputs:
    """The inverse of `_flat`."""
    rotations, root, scene_object, contact = values.split([6 * (joints + 1), 3, 3, CONTACTS], -1)
    R = matrix_from_rot6d(rotations.unflatten(-1, (-1, 6)))
    return Outputs(R[:, :, :-1], root, R[:, :, -1], scene_object, contact)
