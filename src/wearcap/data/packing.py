"""Recordings packed for training: all values of a kind in one tensor, the recordings' rows one after another.

Rotations are quaternions of 16-bit numbers (off by less than 0.004 degrees). What a recording becomes is kept in a file of
the data set's cache, and what all become in files that the next training maps to memory: it starts at once.
"""

import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, BinaryIO

import torch
from jaxtyping import Float, Int16, Int64
from torch import Tensor

from wearcap.boundary.opening import path_inside, understood
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import rotation

KEPT = 4
"""Number of different packings of a data set, those that were used last, whose files are kept; of each, of joined sets."""
_INDEX = "index.safetensors"
"""Of the files of a joined set: kind and number of their rows, as tensors "0 row ..." without content."""
_APART = "a packed recording whose rows do not belong together"
_FIX = "Delete the data set's cache/windows-… folders: they are made again."
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
    twins: dict[str, Tensor] = field(default_factory=dict)
    """What a mirror exchanges: the order of the places of values, "place"."""

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
        return Track(values, {name: _single(value) for name, value in self.constants.items()}, self.tables, self.twins)


def _single(value: Tensor) -> Tensor:
    return (value.float() if value.dtype == torch.float64 else value).contiguous()


class Packed:
    """Tracks of many recordings, each kind of value in one tensor."""

    def __init__(self, whole: Track, length: Int64[Tensor, "track"]):
        """Of what `joined` or `kept` gives. Raises WearcapError for a mirror by which compiled loops would write beyond."""
        self.length, self.first = length, length.cumsum(0) - length
        self.values, self.constants, self.tables = whole.values, whole.constants, whole.tables
        self.twins = {name: order[0] for name, order in whole.twins.items()}
        for name, order in self.twins.items():
            places = self.values[name].shape[-1] if is_rotation(name) else len(order)
            if sorted(order.tolist()) != list(range(places)):
                raise WearcapError("a mirror that exchanges what is not there", name, f"each of {places} once", _FIX)

    @property
    def bytes(self) -> int:
        """Memory of all tensors."""
        return sum(value.nbytes for part in (self.tables, self.values, self.constants) for value in part.values())

    def to(self, device: torch.device) -> None:
        """Move all tensors to a device."""
        for part in (self.tables, self.values, self.constants, self.twins):
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
        raise WearcapError(_APART, where=name, fix=_FIX)
    for part in fields(Track):
        found, expected = (_kinds(getattr(each, part.name), part.name) for each in (track, first))
        if found != expected:
            what = f"{part.name} of other kinds: {found}"
            fix = "Train on data sets of one skeleton."
            raise WearcapError(what, where=name, expected=f"those of the first recording, {expected}", fix=fix)


def _kinds(values: dict[str, Tensor], part: str) -> dict[str, tuple]:
    """Type and size of values, or of their rows."""
    return {key: (value.dtype, *value.shape[part in ("values", "tables") :]) for key, value in values.items()}


def _numbered(tracks: Iterable[Track], names: Sequence[str]) -> Iterator[dict[str, Tensor]]:
    """Rows that tracks add to what is joined; each table ends with one of zeros, to which -1 refers."""
    first, before = None, Counter[str]()
    for track, name in zip(tracks, names, strict=True):
        first = first or track
        _require_alike(track, first, name)
        values = dict(track.values)
        for key, table in track.tables.items():
            values[key] = torch.where(values[key] >= 0, values[key] + before[key], values[key])
            before[key] += len(table)
        constants, twins = ({key: each[None] for key, each in part.items()} for part in (track.constants, track.twins))
        length = torch.tensor([len(next(iter(values.values())))])
        yield Track(values, constants, track.tables, twins).flat() | {"length": length}
    if first is not None:
        yield {f"tables.{key}": table.new_zeros(1, *table.shape[1:]) for key, table in first.tables.items()}


def joined(tracks: Iterable[Track], names: Sequence[str]) -> tuple[Track, Int64[Tensor, "track"]]:
    """Rows of all tracks, in memory, and the tracks' lengths. Raises WearcapError for tracks of other kinds than the first."""
    parts = [*_numbered(tracks, names)]
    whole = {key: torch.cat([rows[key] for rows in parts if key in rows]) for key in parts[0]}
    length = whole.pop("length")
    return Track.of(whole), length


def kept(folder: Path, tracks: Callable[[], Iterable[Track]], names: Sequence[str]) -> tuple[Track, Tensor]:
    """As `joined`, mapped from a folder's files. They are written if they are missing, part by part, the index last.

    Raises WearcapError, too, for damaged files, beyond which compiled loops would read.
    """
    if not (folder / _INDEX).is_file():
        try:
            _write(folder, _numbered(tracks(), names))
        except WearcapError:  # a data set that is only read, or a full disk; or what the tracks are refused for
            return joined(tracks(), names)
    found: dict[str, Tensor] = {}
    with understood(_APART, folder, fix=_FIX, errors=(OSError, LookupError, RuntimeError, TypeError, ValueError)):
        for key, kind in read_tensors(folder / _INDEX, "packed data set", _FIX)[1].items():
            path, shape = path_inside(folder, key, folder), kind.shape[1:]
            if path.stat().st_size != (size := math.prod(shape)) * kind.itemsize:
                raise ValueError(f"{key} is not of {shape[0]} rows")
            found[key] = torch.from_file(str(path), shared=False, size=size, dtype=kind.dtype).reshape(shape)
        length = found.pop("length")
        whole, rows = Track.of(found), length.tolist()
        if {len(value) for value in whole.values.values()} != {sum(rows)} or min(rows) < 1 or len(rows) != len(names):
            raise ValueError(f"not of {len(names)} recordings")
        _require_alike(whole, whole, str(folder))
    return whole, length


def _write(folder: Path, parts: Iterator[dict[str, Tensor]]) -> None:
    """Write rows to a file of each kind as they come, and the index once all are there."""
    index, files = dict[str, Tensor](), dict[str, BinaryIO]()
    with ExitStack() as stack:
        for key, value in (item for rows in parts for item in rows.items()):
            if key not in files:
                path = stack.enter_context(atomic_path(folder / key))
                files[key], index[key] = stack.enter_context(open(path, "wb")), value[None, :0]
            files[key].write(value.reshape(-1).view(torch.uint8).numpy())
            index[key] = value.new_empty(0, index[key].shape[1] + len(value), *value.shape[1:])
    write_tensors(folder / _INDEX, index)


def kept_track(path: Path, make: Callable[[], Track]) -> Track:
    """The track of a recording from a file of its data set's cache, made if it is missing; damaged ones are made anew."""
    with suppress(WearcapError):
        return Track.of(read_tensors(path, "packed recording")[1])
    track = make().packed()
    with suppress(WearcapError):  # a data set that is only read, or a full disk: the training needs no file
        write_tensors(path, track.flat())
    return track


def forget_old(used: Path) -> None:
    """Remove all but `KEPT` folders of a kind ("windows-…"): the one in use, and those beside it that were used last."""
    with suppress(OSError):  # a data set that is only read, or another process that removes them
        os.utime(used)
        folders = used.parent.glob(used.name.split("-")[0] + "-*")
        for folder in sorted(folders, key=lambda folder: folder.stat().st_mtime, reverse=True)[KEPT:]:
            shutil.rmtree(folder, ignore_errors=True)


def require_rows(values: dict[str, Any], where: str | Path) -> None:
    """Raise WearcapError unless all values have as many frames."""
    lengths = {name: len(value) for name, value in values.items()}
    if len(set(lengths.values())) > 1:
        what, fix = f"streams of different lengths: {lengths}", "Prepare the recording again."
        raise WearcapError(what, where=where, expected="all on one clock", fix=fix)
