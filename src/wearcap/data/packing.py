"""Recordings packed for training: all values of a kind in one tensor, the recordings' rows one after another.

Rotations are quaternions of 16-bit numbers (off by less than 0.004 degrees). What a recording becomes is kept in a file
of the data set's cache, so that the next training starts at once.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int16, Int64
from torch import Tensor

from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.errors import WearcapError
from wearcap.geometry import rotation

KEPT = 4
"""Number of different packings of a data set, those that were used last, whose files are kept."""
_STEP = float(torch.iinfo(torch.int16).max)


def is_rotation(name: str) -> bool:
    """Whether values of a name are rotation matrices, by docs/conventions.md."""
    return name.startswith("R_")


def quantized(R: Float[Tensor, "row *joint 3 3"]) -> Int16[Tensor, "row 4 joint"]:
    """Rotations as quaternions (w, x, y, z) of 16-bit numbers."""
    quaternions = rotation.quat_wxyz_from_matrix(R.reshape(len(R), -1, 3, 3))
    return (_STEP * quaternions).round().to(torch.int16).mT.contiguous()


@dataclass(frozen=True)
class Track:
    """What is kept of one recording, by names."""

    values: dict[str, Tensor]
    """Values of each frame, "frame ...". Whole numbers with the name of a table are its rows (-1: none)."""
    constants: dict[str, Tensor] = field(default_factory=dict)
    """Values of the wearer."""
    tables: dict[str, Tensor] = field(default_factory=dict)
    """Values of what frames refer to, "row ...", such as pictures and objects."""

    def flat(self) -> dict[str, Tensor]:
        """All tensors, as a file has them."""
        return {
            f"{part.name}.{name}": value for part in fields(self) for name, value in getattr(self, part.name).items()
        }

    @classmethod
    def of(cls, tensors: dict[str, Tensor]) -> "Track":
        """The inverse of `flat`."""
        parts: dict[str, dict[str, Tensor]] = {part.name: {} for part in fields(cls)}
        for name, value in tensors.items():
            part, _, rest = name.partition(".")
            parts[part][rest] = value
        return cls(**parts)

    def packed(self) -> "Track":
        """With rotations as they are kept, and numbers of single precision."""
        values = {
            name: quantized(value) if is_rotation(name) else _single(value) for name, value in self.values.items()
        }
        return Track(values, {name: _single(value) for name, value in self.constants.items()}, self.tables)


def _single(value: Tensor) -> Tensor:
    return (value.float() if value.dtype == torch.float64 else value).contiguous()


class Packed:
    """Tracks of many recordings, each kind of value in one tensor."""

    def __init__(self, tracks: Sequence[Track], names: Sequence[str]):
        """`names` of the recordings, for messages. Raises WearcapError for tracks with other values than the first one."""
        lengths = torch.tensor([len(next(iter(track.values.values()))) for track in tracks])
        self.length: Int64[Tensor, "track"] = lengths
        self.first: Int64[Tensor, "track"] = lengths.cumsum(0) - lengths
        for track, name in zip(tracks, names):
            _require_alike(track, tracks[0], name)
        self.tables = {name: _joined([track.tables[name] for track in tracks], spare=1) for name in tracks[0].tables}
        self.values = {name: _joined([track.values[name] for track in tracks]) for name in tracks[0].values}
        self.constants = {
            name: torch.stack([track.constants[name] for track in tracks]) for name in tracks[0].constants
        }
        for name in self.tables:
            rows = torch.tensor([len(track.tables[name]) for track in tracks])
            before = (rows.cumsum(0) - rows).repeat_interleave(lengths).to(self.values[name].dtype)
            self.values[name] += before * (self.values[name] >= 0)  # -1 stays: the last row, of zeros

    @property
    def bytes(self) -> int:
        """Memory of all tensors."""
        return sum(value.nbytes for part in (self.tables, self.values, self.constants) for value in part.values())

    def to(self, device: torch.device) -> None:
        """Move all tensors to a device."""
        for part in (self.tables, self.values, self.constants):
            part.update({name: value.to(device) for name, value in part.items()})
        self.first, self.length = self.first.to(device), self.length.to(device)


def _require_alike(track: Track, first: Track, name: str) -> None:
    """Compiled loops read tracks without looking: all rows are there, of the same kind as those of the first recording."""
    lengths = {len(value) for value in track.values.values()}
    rotations = [value for key, value in track.values.items() if is_rotation(key)]
    rows = all(
        int(track.values[key].min()) >= -1 and int(track.values[key].max()) < len(track.tables[key])
        for key in track.tables
    )
    if len(lengths) > 1 or not rows or any(R.dtype != torch.int16 or R.shape[1:-1] != (4,) for R in rotations):
        fix = "Delete the data set's cache/windows-… folders: they are made again."
        raise WearcapError("a packed recording whose rows do not belong together", where=name, fix=fix)
    for part in fields(Track):
        found, expected = (_kinds(getattr(each, part.name), part.name) for each in (track, first))
        if found != expected:
            what = f"{part.name} of other kinds: {found}"
            fix = "Train on data sets of one skeleton."
            raise WearcapError(what, where=name, expected=f"those of the first recording, {expected}", fix=fix)


def _kinds(values: dict[str, Tensor], part: str) -> dict[str, tuple]:
    """Type and size of values, or of their rows."""
    return {key: (value.dtype, *value.shape[0 if part == "constants" else 1 :]) for key, value in values.items()}


def _joined(parts: list[Tensor], spare: int = 0) -> Tensor:
    """Rows of all parts, and further rows of zeros. Parts are let go one after another."""
    rows = torch.zeros(sum(map(len, parts)) + spare, *parts[0].shape[1:], dtype=parts[0].dtype)
    place = 0
    for part in parts:
        rows[place : place + len(part)] = part
        place += len(part)
    return rows


def kept_track(root: Path, key: str, name: str, make: Callable[[], Track]) -> Track:
    """The track of a recording from the cache of its data set, made if it is missing; damaged files are made anew."""
    path = root / "cache" / f"windows-{key}" / f"{name}.safetensors"
    if path.is_file():
        try:
            return Track.of(read_tensors(path, "packed recording")[1])
        except WearcapError:
            path.unlink(missing_ok=True)
    track = make().packed()
    with suppress(WearcapError):  # a data set that is only read, or a full disk: the training needs no file
        write_tensors(path, track.flat())
    return track


def forget_old(root: Path, key: str) -> None:
    """Remove the files of all but `KEPT` packings of a data set: the one of a key, and those that were used last."""
    with suppress(OSError):  # a data set that is only read
        os.utime(root / "cache" / f"windows-{key}")
    folders = sorted((root / "cache").glob("windows-*"), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for folder in folders[KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


def require_rows(values: dict[str, Any], where: str | Path) -> None:
    """Raise WearcapError unless all values have as many frames."""
    lengths = {name: len(value) for name, value in values.items()}
    if len(set(lengths.values())) > 1:
        what, fix = f"streams of different lengths: {lengths}", "Prepare the recording again."
        raise WearcapError(what, where=where, expected="all on one clock", fix=fix)
