"""Overlapping windows of a network over frames that arrive: the newest frames, which of them are final, batches.

Whole recordings are pushed at once, streams piece by piece; every system's windows are these, so that both give the same.
Frames are a named tuple of tensors "batch time ...".
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion
from wearcap.tracking.head_path import HeadPath
from wearcap.tracking.refinement import Measured

Frames = TypeVar("Frames", bound=tuple[Tensor, ...])


def frames_of(like: Frames, parts: Iterable[Tensor]) -> Frames:
    """Fields as a named tuple of the same kind."""
    kind: Any = type(like)
    return kind(*parts)


def cut(frames: Frames, part: slice | Tensor) -> Frames:
    """A selection of frames."""
    return frames_of(frames, (field[:, part] for field in frames))


def appended(before: Frames | None, fresh: Frames, first: int = 0) -> Frames:
    """Frames without those before number `first`, followed by new ones; None: there are none before."""
    if before is None:
        return fresh
    return frames_of(fresh, (torch.cat([old[:, first:], new], 1) for old, new in zip(before, fresh)))


def batched(items: Sequence[Frames], count: int) -> Frames:
    """Several batch items as one batch; the last frame of each is repeated up to `count` frames."""
    numbers = [torch.arange(count).clamp_max(item[0].shape[1] - 1) for item in items]
    parts = (torch.cat([field[:, number] for field, number in zip(each, numbers)]) for each in zip(*items))
    return frames_of(items[0], parts)


class Window(Generic[Frames]):
    """The newest frames of a batch, at most `length`, and how many of the frames so far are final."""

    def __init__(self, length: int):
        self.length = length
        self.frames: Frames | None = None
        self.taken, self.final = 0, 0
        """Numbers of frames that were appended, and that are final."""

    @property
    def count(self) -> int:
        """Number of frames in the window."""
        return 0 if self.frames is None else self.frames[0].shape[1]

    def append(self, fresh: Frames) -> int:
        """Append new frames; returns how many of the oldest were dropped for them."""
        new = fresh[0].shape[1]
        dropped = max(0, self.count + new - self.length)
        self.frames, self.taken = appended(self.frames, fresh, dropped), self.taken + new
        return dropped

    def finalize(self, lookahead: int) -> slice:
        """The window's frames that are final from now on: all but the last `lookahead` and those that were before."""
        start, self.final = self.final, max(self.final, self.taken - lookahead)
        before = self.taken - self.count
        return slice(start - before, self.final - before)

    @property
    def final_count(self) -> int:
        """Number of the window's frames that are final."""
        return self.final - self.taken + self.count


class FinalPoses(NamedTuple):
    """Frames that later windows no longer change: where head and floor were measured, and the predicted pose."""

    timestamps: Float64[Tensor, "time"]
    R_world_head: Float[Tensor, "time 3 3"]
    t_world_head: Float[Tensor, "time 3"]
    floor_height: Float[Tensor, "time"]
    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    contact_prob: Float[Tensor, "time foot"]
    joint_std: Float[Tensor, "time deviation"]
    """As of a `Motion`; no columns of systems that do not say how sure they are."""

    @property
    def T_world_head(self) -> Rigid:
        """Measured head poses."""
        return Rigid(self.R_world_head, self.t_world_head)

    @property
    def measured(self) -> Measured:
        """What refinement knows of these frames."""
        return Measured.of(self.T_world_head, self.floor_height)

    def motion(self, skeleton: Skeleton, provenance: dict[str, str], contacts: bool = True) -> Motion:
        """The poses as a motion; `contacts`: whether contacts were predicted, of both patches of a foot alike."""
        contact_prob = self.contact_prob.repeat_interleave(2, -1) if contacts else None
        poses, joint_std = (self.R_parent_joint, self.t_world_root, contact_prob), self.joint_std
        known = joint_std if joint_std.shape[1] else None
        return Motion(self.timestamps, skeleton, *poses, joint_std=known, provenance=provenance)


class StretchWindows(Window[Frames], ABC):
    """Windows over one uninterrupted stretch of a recording, as a batch of one: frames go in, final ones come out.

    Frames have the fields `timestamps`, `R_world_head`, `t_world_head` and `floor_height`.
    """

    def __init__(self, length: int):
        super().__init__(length)
        self._final: list[FinalPoses] = []

    @abstractmethod
    def _poses(self, part: slice) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Predicted rotations, root, contacts and deviations of some of the window's frames, as in `FinalPoses`."""

    def emit(self, lookahead: int) -> None:
        """Put out the frames that are final from now on: all but the last `lookahead`."""
        part, frames = self.finalize(lookahead), cast(Any, self.frames)
        if part.stop > part.start:
            measured = frames.timestamps, frames.R_world_head, frames.t_world_head, frames.floor_height
            fields = *(field[0, part] for field in measured), *self._poses(part)
            self._final.append(FinalPoses(*(field.clone() for field in fields)))  # which lets go of the window

    def take(self, ended: bool = False) -> FinalPoses | None:
        """Frames that were put out since the last call, or None; `ended`: with all others, as none will follow."""
        if ended:
            self.emit(0)
        parts, self._final = self._final, []
        return FinalPoses(*(torch.cat(fields) for fields in zip(*parts))) if parts else None

    def correct(self, T_world_head: Rigid) -> None:
        """Replace the latest head poses, which repeated an earlier pose while tracking was lost."""
        frames, kept = cast(Any, self.frames), slice(-len(T_world_head.t))
        R, t = frames.R_world_head[:, kept], frames.t_world_head[:, kept]
        R, t = torch.cat([R, T_world_head.R[None]], 1), torch.cat([t, T_world_head.t[None]], 1)
        self.frames = frames._replace(R_world_head=R, t_world_head=t)


def over_path(path: HeadPath, stretches: Sequence[StretchWindows[Any]]) -> FinalPoses:
    """All stretches of a path, once all their frames were pushed; in the gaps between them the last pose goes on, at the
    interpolated head."""
    parts = [part for stretch in stretches if (part := stretch.take(ended=True)) is not None]
    whole = FinalPoses(*(torch.cat(fields)[path.held_frames] for fields in zip(*parts)))
    head = path.T_world_head
    return whole._replace(timestamps=path.timestamps, R_world_head=head.R, t_world_head=head.t)


def moved_on(sums: Float[Tensor, "batch before value"], fresh: int, count: int) -> Float[Tensor, "batch time value"]:
    """Values per frame of the last window for the next one, with zeros for its `fresh` new frames; `count`: its length."""
    return F.pad(sums, (0, 0, 0, fresh))[:, -count:]
