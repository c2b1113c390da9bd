"""ECHO's queue of frames (ECHO §3.3): what is told of them comes in one by one, what is said of them goes out."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.data.features import body_size
from wearcap.diffusion.conveyor import Belt, Conveyor, Denoise, Held
from wearcap.diffusion.schedule import Schedule
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import Body, EchoFeatures, ThreePoints
from wearcap.systems.echo.model import EchoDenoiser


class Told(NamedTuple):
    """Frames of several lanes, as they are sensed: three tracked points, and which object is active; and what of the
    truth is observed."""

    R_world_point: Float[Tensor, "lane frame point 3 3"]
    t_world_point: Float[Tensor, "lane frame point 3"]
    floor_height: Float[Tensor, "lane frame"]
    has_object: Bool[Tensor, "lane frame"]
    object_code: Float[Tensor, "lane frame code"]
    object_number: Float[Tensor, "lane frame"]
    """Which of the lane's objects it is."""
    valid: Bool[Tensor, "lane frame"]
    R_parent_joint: Float[Tensor, "lane frame joint 3 3"]
    t_world_root: Float[Tensor, "lane frame 3"]
    R_world_object: Float[Tensor, "lane frame 3 3"]
    t_world_object: Float[Tensor, "lane frame 3"]
    contact: Float[Tensor, "lane frame contact"]
    """Observations, any numbers where they are none."""
    is_known: Bool[Tensor, "lane frame modality"]

    def frames(self, part: slice | Tensor) -> "Told":
        return Told(*(field[:, part] for field in self))

    @property
    def points(self) -> ThreePoints:
        return ThreePoints(self.R_world_point, self.t_world_point)


class Said(NamedTuple):
    """What is final, in the world."""

    R_parent_joint: Float[Tensor, "lane frame joint 3 3"]
    t_world_root: Float[Tensor, "lane frame 3"]
    R_world_object: Float[Tensor, "lane frame 3 3"]
    """Of the active object's middle; means nothing where none is active."""
    t_world_object: Float[Tensor, "lane frame 3"]
    contact_prob: Float[Tensor, "lane frame contact"]
    """64 body points on the object, then `FOOT_PATCHES` on the floor."""


@runtime_checkable
class Amend(Protocol):
    """Changes x̂0 as guidance wants it."""

    def __call__(self, x0_hat: Float[Tensor, "lane frame feature"]) -> Float[Tensor, "lane frame feature"]: ...  # fmt: skip


@runtime_checkable
class Model(Protocol):
    """What of a pipeline the queue needs."""

    net: EchoDenoiser
    features: EchoFeatures
    schedule: Schedule
    contacts: bool
    device: str

    @property
    def belt(self) -> Belt: ...

    def denoiser(self, queue: "EchoQueue", told: Told, frame: Rigid) -> tuple[Denoise, Amend | None]: ...


class EchoQueue:
    """Several lanes' frames, a window of them at most; every frame has noise of its lane's own seed."""

    def __init__(self, pipeline: Model, skeletons: Sequence[Skeleton], seeds: Sequence[int]):
        self.pipeline = pipeline
        self.size = torch.stack([body_size(skeleton) for skeleton in skeletons])
        net = pipeline.net
        self.belt = pipeline.belt
        self.conveyor = Conveyor(self.belt, pipeline.schedule, net.sizes, len(seeds))
        self.told: Told | None = None
        self.guided: tuple[list, list] | None = None
        """Bodies' contact points and objects per lane, for a pipeline with guidance."""
        self._random = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._frame: Rigid | None = None

    @torch.no_grad()
    def push(self, fresh: Told) -> Said | None:
        """Take one more frame of every lane in (padding behind a lane's end); the frame that has become final, if one has."""
        noise = self._noise(1)[:, 0]
        full = self.conveyor.push(noise)
        self.told = (
            fresh
            if self.told is None
            else Told(*(torch.cat([a[:, int(full) :], b], 1) for a, b in zip(self.told, fresh)))
        )
        frame = self.pipeline.features.canonical(self.told.points)
        if self.pipeline.features.moves and full:
            self._move(frame)
        self._frame = frame
        count = len(self.conveyor.age)
        noise = self._noise(self.belt.per_frame * count).unflatten(1, (self.belt.per_frame, count))
        held = self._held(self.told, frame)
        denoise, amend = self.pipeline.denoiser(self, self.told, frame)
        self.conveyor.run(denoise, held, noise.transpose(0, 1), amend)
        clean = self.conveyor.clean
        return self._said(clean - 1, frame) if clean else None

    def run(self, whole: Told) -> Said:
        """All frames of some lanes, to the end."""
        count, first = whole.valid.shape[1], self.belt.ramp - 1
        out = None
        for frame in range(count + first):
            said = self.push(whole.frames(slice(frame, frame + 1)) if frame < count else self.padding())
            if said is None:
                continue
            if out is None:  # room for all: small pieces that stay scatter the memory between them
                out = Said(*(field.new_empty(len(field), count, *field.shape[2:]) for field in said))
            for kept, field in zip(out, said):
                kept[:, frame - first] = field[:, 0]
        assert out is not None
        return out

    def padding(self) -> Told:
        """A frame behind the end of all lanes: the last one again, not valid."""
        assert self.told is not None
        last = self.told.frames(slice(-1, None))
        return last._replace(valid=torch.zeros_like(last.valid), is_known=torch.zeros_like(last.is_known))

    def _noise(self, rows: int) -> Float[Tensor, "lane row feature"]:
        width = sum(self.pipeline.net.sizes)
        return torch.stack([torch.randn(rows, width, generator=random) for random in self._random])

    def _held(self, told: Told, frame: Rigid) -> Held:
        """What is observed, in normalised space; what is not there stays noise."""
        known = torch.zeros(*told.valid.shape, sum(self.pipeline.net.sizes))
        if told.is_known.any():
            features = self.pipeline.features
            body = features.encode_body(Body(told.R_parent_joint, told.t_world_root), frame)
            thing = features.encode_object(Rigid(told.R_world_object, told.t_world_object), frame)
            raw = torch.cat([body, thing, 2 * told.contact - 1], -1)
            known = self.pipeline.net.motion_normalizer(raw.to(self.pipeline.device)).cpu()
        always = torch.zeros_like(told.has_object)
        absent = [always, ~told.has_object, always if self.pipeline.contacts else ~always]
        is_known = told.is_known.clone()
        is_known[..., 1] &= told.has_object
        return Held(known, is_known, torch.stack(absent, -1) & ~is_known)

    def _move(self, frame: Rigid) -> None:
        """Re-express what is on the conveyor where the window's frame has moved."""
        assert self._frame is not None
        assert self.told is not None
        change = frame.inverse() @ self._frame
        self.conveyor.x = self._reexpressed(self.conveyor.x, change, self.conveyor.level, self.told)

    def _reexpressed(
        self,
        x: Float[Tensor, "lane frame feature"],
        change: Rigid,
        level: Float[Tensor, "#lane #frame modality"],
        told: Told,
    ) -> Float[Tensor, "lane frame feature"]:
        """z' = A z + √ᾱ b at each modality's own level (exact: the channels of each vector share one scale)."""
        net, alpha_bar = self.pipeline.net, self.pipeline.schedule(level).sqrt()
        scale = net.motion_normalizer.scale.cpu()
        x = x.clone()
        for modality, at, there in ((0, 0, None), (1, net.sizes[0], told.has_object[..., None])):
            shift = alpha_bar[..., modality, None] * (change.t / scale[at])
            shift = shift if there is None else shift * there
            x[..., at : at + 3] = self._turned(x[..., at : at + 3], change.R) + shift
            for column in (at + 3, at + 6):
                x[..., column : column + 3] = self._turned(x[..., column : column + 3], change.R)
        return x

    @staticmethod
    def _turned(value: Float[Tensor, "lane frame 3"], R: Float[Tensor, "lane 1 3 3"]) -> Tensor:
        return (R @ value[..., None])[..., 0]

    def _said(self, number: int, frame: Rigid) -> Said:
        """One frame that is final."""
        return self._decoded(self.conveyor.x, slice(number, number + 1), frame)

    def _decoded(self, x: Float[Tensor, "lane frame feature"], part: slice, frame: Rigid) -> Said:
        """Some of a window's frames, out of normalised space and in the world."""
        net, features = self.pipeline.net, self.pipeline.features
        human, thing, contact = (
            net.motion_normalizer.inverse(x[:, part].to(self.pipeline.device)).cpu().split(net.sizes, -1)
        )
        at = frame if frame.t.shape[1] == 1 else Rigid(frame.R[:, part], frame.t[:, part])
        body, T = features.decode_body(human, at), features.decode_object(thing, at)
        return Said(*body, T.R, T.t, ((contact + 1) / 2).clamp(0, 1))
