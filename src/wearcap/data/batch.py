"""A batch of training windows: which frames of which recordings, and the values that are read of them."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int16, Int64
from torch import Tensor

from wearcap.body.skeleton import MIRROR
from wearcap.data import kernels
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, is_rotation
from wearcap.geometry import rotation

_RATES = {"vel": 1, "acc": 2}
"""Power of the playback speed by which values of a kind grow, by the beginning of their names."""
_BETWEEN = ("R", "t", "vel", "acc", "floor")
"""Beginnings of names of values that are interpolated between frames; others are taken from the nearest frame."""
_SIDED = ("t", "vel", "acc")
"""Beginnings of names of vectors, whose y axis points to the left."""


class Rows(NamedTuple):
    """Rows of the packed values before and after each frame of a window, and its share of the way between them."""

    low: Int64[Tensor, "batch time"]
    high: Int64[Tensor, "batch time"]
    share: Float[Tensor, "batch time"]

    @property
    def nearest(self) -> Int64[Tensor, "batch time"]:
        return torch.where(self.share > 0.5, self.high, self.low)


@dataclass(frozen=True)
class Batch:
    """Windows of a batch: first the frames that they consist of, then (`read`) their values."""

    packed: Packed
    draws: Draws
    track: Int64[Tensor, "batch"]
    start: Int64[Tensor, "batch"]
    """First frame of each window in its track."""
    count: int
    """Number of a window's frames."""
    fps: float
    """Frames of a window per second."""
    stride: int = 1
    """Frames of the track between successive windows."""
    step: int = 1
    """Frames of the track per frame of a window."""
    twins: dict[str, Int64[Tensor, "place"]] = field(default_factory=dict)
    """What a mirror exchanges: the order of joints, wrists, feet … of the mirrored values, by their names."""
    sensed: frozenset[str] = frozenset()
    """Names of the values that suffer from dropped frames."""
    jumps: dict[str, str] = field(default_factory=dict)
    """Names of values that are not interpolated where the row of a table changes, with the table."""
    later: Int64[Tensor, "batch"] | Float64[Tensor, "batch"] | None = None
    """Frames by which windows start later; a window does not start so late that it would end after its track."""
    speed: Float[Tensor, "batch"] | None = None
    stretch: float = 1.0
    """Largest speed."""
    begin: Int64[Tensor, "batch"] | None = None
    """Frame of the window that all earlier ones repeat."""
    end: Int64[Tensor, "batch"] | None = None
    """Number of frames before the padding, which repeats the last of them."""
    kept: Bool[Tensor, "batch section"] | None = None
    """Which of the track's frames from the start on were not dropped; sensed values are interpolated between them."""
    mirrored: Bool[Tensor, "batch"] | None = None
    """Which windows are mirrored left to right."""
    varied: Bool[Tensor, "batch"] | None = None
    """Whether other people may do the motion."""
    versions: Int64[Tensor, "batch version"] | None = None
    """Tracks of the same recording with other arms; the track itself where there are none."""
    parts: frozenset[str] = frozenset()
    """Names of values that are packed in the body's parts, "... part value"."""
    others: Bool[Tensor, "batch"] | None = None
    """Whether somebody else does the motion."""
    bones: Float[Tensor, "batch part"] | None = None
    """Factors of the body's parts (`bodies.PARTS`) by which somebody else does the motion; None: nobody else does any."""
    scale: Float[Tensor, "batch"] | None = None
    """Factor of all lengths."""
    values: dict[str, Tensor] = field(default_factory=dict)
    """Values by their names, "batch time ..." each or of the wearer, "batch ..."."""

    def changed(self, **values: Tensor) -> "Batch":
        """The batch with other values."""
        return replace(self, values=self.values | values)

    @property
    def device(self) -> torch.device:
        return self.track.device

    @property
    def section(self) -> int:
        """Number of the track's frames, from the start on, that a window may reach."""
        return int(self.count * self.step * self.stretch) + 2

    @cached_property
    def _first(self) -> tuple[Int64[Tensor, "batch"], Tensor]:
        """The frame at which each window starts or before it, and the share of a frame from there."""
        reach = (self.count - 1) * self.step * (1 if self.speed is None else self.speed.double())
        latest = (self.packed.length[self.track] - 1 - reach).clamp_min(0)
        later = 0 if self.later is None else self.later
        start = torch.minimum(self.start + later, latest)
        if not start.is_floating_point():
            return start, torch.zeros_like(start)
        first = start.floor().long()
        return first, (start - first).float()

    @cached_property
    def _places(self) -> Tensor:
        """Place of each frame from `_first` on, within the track or not: whole, or a float where frames are interpolated."""
        share = self._first[1][:, None]
        steps = self.step * torch.arange(self.count, device=self.device)
        return share + steps if self.speed is None else share + self.speed[:, None] * steps

    @property
    def _last(self) -> Int64[Tensor, "batch 1"]:
        """Place of the track's last frame."""
        return (self.packed.length[self.track] - 1 - self._first[0])[:, None]

    @cached_property
    def _shown(self) -> Tensor:
        """Place of the frame that each one shows."""
        place = self._places
        if self.begin is not None:
            place = place.maximum(place.gather(1, self.begin[:, None]))
        if self.end is not None:
            place = place.minimum(place.gather(1, self.end[:, None] - 1))
        return place.minimum(self._last.to(place.dtype))

    @property
    def valid(self) -> Bool[Tensor, "batch time"]:
        """False for padding: frames after those that are shown, or after the recording's end."""
        within = self._places <= self._last
        if self.end is None:
            return within
        return within & (torch.arange(self.count, device=self.device) < self.end[:, None])

    def rows(self, sensed: bool = False) -> Rows:
        """Between which rows each frame lies; for `sensed` values, between which that were not dropped."""
        place, last = self._shown, self._last
        low = place.long()
        high = (low + 1).minimum(last)
        if sensed and self.kept is not None:
            # The last kept frame up to each one, and the first one from each on.
            frames = torch.arange(self.section, device=self.device)
            before = torch.where(self.kept, frames, 0).cummax(1).values
            after = torch.where(self.kept, frames, self.section - 1).flip(1).cummin(1).values.flip(1)
            low, high = before.gather(1, low).minimum(last), after.gather(1, low + 1).minimum(last)
        share = ((place - low) / (high - low).clamp_min(1)).clamp(0, 1).float()
        first = (self.packed.first[self.track] + self._first[0])[:, None]
        return Rows(first + low, first + high, share)

    def read(self) -> "Batch":
        """The batch with the values of its frames and wearers.

        Rotations, positions, rates and floor heights are interpolated, others are those of the nearest frame.
        """
        true, sensed = self.rows(), self.rows(sensed=True) if self.kept is not None else None
        values = {
            name: self._taken(name, part, sensed if sensed is not None and name in self.sensed else true)
            for name, part in self.packed.values.items()
        }
        values |= {name: self._mirrored(name, part[self.track], 1) for name, part in self.packed.constants.items()}
        return replace(self, values=values)

    def _taken(self, name: str, part: Tensor, rows: Rows) -> Tensor:
        """The windows' values of a name."""
        if (table := self.jumps.get(name)) is not None:
            row = self.packed.values[table]
            jumps = row[rows.low] != row[rows.high]
            rows = rows._replace(share=torch.where(jumps, (rows.share > 0.5).float(), rows.share))
        if is_rotation(name):
            joints = part.shape[-1]
            R = matrices(part, rows, self.twins.get(name), self.mirrored)
            return R[:, :, 0] if joints == 1 else R
        kind = name.split("_")[0]
        if kind not in _BETWEEN:
            value = part[rows.nearest]
        else:
            value = between(part, rows)
        if self.speed is not None and (power := _RATES.get(kind)):
            value = value * self.speed.pow(power).reshape(-1, *[1] * (value.ndim - 1))
        return self._mirrored(name, value, 2)

    def _mirrored(self, name: str, value: Tensor, axis: int) -> Tensor:
        """Values of which those of mirrored windows are mirrored; `axis`: of what a mirror exchanges."""
        if self.mirrored is None:
            return value
        which = self.mirrored.reshape(-1, *[1] * (value.ndim - 1))
        if (twins := self.twins.get(name)) is not None:
            value = torch.where(which, value.index_select(axis, twins), value)
        if name.split("_")[0] in _SIDED:
            value = value * torch.where(which, _sides(MIRROR, self.device), 1.0)
        return value


def between(values: Float[Tensor, "row *value"], rows: Rows) -> Float[Tensor, "batch time *value"]:
    """Values of frames between rows."""
    if values.device.type == "cpu" and values.dtype == torch.float32:
        found = torch.empty(*rows.low.shape, *values.shape[1:])
        flat = (each.flatten().numpy() for each in rows)
        kernels.between(values.reshape(len(values), -1).numpy(), *flat, found.reshape(rows.low.numel(), -1).numpy())
        return found
    share = rows.share.reshape(*rows.share.shape, *[1] * (values.ndim - 1)).to(values.dtype)
    return torch.lerp(values[rows.low], values[rows.high], share)


def matrices(
    quaternions: Int16[Tensor, "row 4 joint"],
    rows: Rows,
    twins: Int64[Tensor, "joint"] | None,
    mirrored: Bool[Tensor, "batch"] | None,
) -> Float[Tensor, "batch time joint 3 3"]:
    """Rotation matrices of frames between rows; those of mirrored windows are their twins', mirrored left to right."""
    device, shape, joints = rows.low.device, rows.low.shape, quaternions.shape[-1]
    twins = torch.arange(joints, device=device) if twins is None else twins
    if device.type == "cpu":
        flip = torch.zeros(len(rows.low), dtype=torch.bool) if mirrored is None else mirrored
        found = torch.empty(*shape, joints, 9)
        kernels.matrices(*(array.numpy() for array in (quaternions, *rows, twins, flip, found)))
        return found.unflatten(-1, (3, 3))
    low, high = quaternions[rows.low].float(), quaternions[rows.high].float()
    share = rows.share[..., None, None] * torch.where((low * high).sum(-2, keepdim=True) < 0, -1.0, 1.0)
    quaternion = ((1 - share.abs()) * low + share * high).mT
    if mirrored is not None:
        twin = quaternion.index_select(2, twins) * _sides((1.0, -1.0, 1.0, -1.0), device)
        quaternion = torch.where(mirrored[:, None, None, None], twin, quaternion)
    return rotation.matrix_from_quat_wxyz(quaternion)


@cache
def _sides(signs: tuple[float, ...], device: torch.device) -> Float[Tensor, "axis"]:
    return torch.tensor(signs, device=device)


Transform = Callable[[Batch], Batch]
"""Changes the values of a batch."""
