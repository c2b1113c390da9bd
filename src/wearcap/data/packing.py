"""Recordings packed for training: all values of a kind in one tensor, the recordings' rows one after another.

Rotations are quaternions of 16-bit numbers (off by less than 0.004 degrees). What a recording becomes is kept in a file
of the data set's cache, so that a data set that grew, or was packed in part, is not packed anew. What they all become is
kept there once more, in files that the next training maps to memory: it starts at once, and reads what it draws.
"""

import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, BinaryIO

import torch
from jaxtyping import Float, Int16, Int64
from torch import Tensor

from wearcap.boundary.opening import path_inside, understood
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.boundary.texts import read_json, require_layout
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.geometry import rotation

KEPT = 4
"""Number of different packings of a data set, those that were used last, whose files are kept; of each, of joined sets."""
_INDEX = "index.safetensors"
"""Of a joined set: "length" of each track, and of each other file's rows the kind, "0 row ...", which takes no space."""
_APART = "a packed recording whose rows do not belong together"
_KNOWN = "recordings.json"
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

    def __init__(self, tracks: Iterable[Track], names: Sequence[str]):
        """`names` of the recordings, for messages. Raises WearcapError for tracks with other values than the first one."""
        parts: dict[str, list[Tensor]] = {}
        for rows in _numbered(tracks, names):
            for key, value in rows.items():
                parts.setdefault(key, []).append(value)
        self._take({key: torch.cat(value) for key, value in parts.items()})

    def _take(self, tensors: dict[str, Tensor]) -> None:
        self.length: Int64[Tensor, "track"] = tensors.pop("length")
        self.first: Int64[Tensor, "track"] = self.length.cumsum(0) - self.length
        joined = Track.of(tensors)
        self.values, self.constants, self.tables = joined.values, joined.constants, joined.tables

    @classmethod
    def kept(cls, folder: Path, tracks: Callable[[], Iterable[Track]], names: Sequence[str]) -> "Packed":
        """As of the tracks, mapped from a folder's files, which are made if they are missing.

        Tracks are held in memory only where nothing can be written. Raises WearcapError for damaged files, too.
        """
        if not (folder / _INDEX).is_file():
            try:
                _write(folder, tracks(), names)
            except WearcapError:  # a data set that is only read, or a full disk; or what the tracks are refused for
                return cls(tracks(), names)
        packed = cls.__new__(cls)
        packed._take(_mapped(folder, len(names)))
        return packed

    def twins(self, orders: dict[str, list[int]]) -> dict[str, Int64[Tensor, "place"]]:
        """What a mirror exchanges, by names of values. Raises WearcapError for what compiled loops would read beyond."""
        for name, order in orders.items():
            rotations = len(self.values[name][0, 0]) if is_rotation(name) and name in self.values else len(order)
            if sorted(order) != list(range(rotations)):
                raise WearcapError("a mirror that exchanges what is not there", name, f"each of {rotations} once", _FIX)
        return {name: torch.tensor(order) for name, order in orders.items()}

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
        raise WearcapError(_APART, where=name, fix=_FIX)
    for part in fields(Track):
        found, expected = (_kinds(getattr(each, part.name), part.name) for each in (track, first))
        if found != expected:
            what = f"{part.name} of other kinds: {found}"
            fix = "Train on data sets of one skeleton."
            raise WearcapError(what, where=name, expected=f"those of the first recording, {expected}", fix=fix)


def _kinds(values: dict[str, Tensor], part: str) -> dict[str, tuple]:
    """Type and size of values, or of their rows."""
    return {key: (value.dtype, *value.shape[0 if part == "constants" else 1 :]) for key, value in values.items()}


def _numbered(tracks: Iterable[Track], names: Sequence[str]) -> Iterator[dict[str, Tensor]]:
    """Rows that tracks add to what is joined, as `Track.flat` and "length", with the tables' rows counted through all tracks.

    Each table ends with a row of zeros, which those who refer to none (-1) refer to. Raises as `_require_alike`.
    """
    first, before = None, Counter[str]()
    for track, name in zip(tracks, names, strict=True):
        first = first or track
        _require_alike(track, first, name)
        values, constants = dict(track.values), {key: value[None] for key, value in track.constants.items()}
        for key, table in track.tables.items():
            values[key] = torch.where(values[key] >= 0, values[key] + before[key], values[key])
            before[key] += len(table)
        length = torch.tensor([len(next(iter(values.values())))])
        yield Track(values, constants, track.tables).flat() | {"length": length}
    if first is not None:
        yield {f"tables.{key}": table.new_zeros(1, *table.shape[1:]) for key, table in first.tables.items()}


def _write(folder: Path, tracks: Iterable[Track], names: Sequence[str]) -> None:
    """Write what tracks become, part by part; the index last."""
    lengths, counts, kinds = list[Tensor](), Counter[str](), dict[str, Tensor]()
    with ExitStack() as stack:
        files: dict[str, BinaryIO] = {}
        for rows in _numbered(tracks, names):
            lengths += [rows.pop("length")] if "length" in rows else []
            for key, value in rows.items():
                if key not in files:
                    path = stack.enter_context(atomic_path(folder / key))
                    files[key], kinds[key] = stack.enter_context(open(path, "wb")), value[:0]
                files[key].write(value.reshape(-1).view(torch.uint8).numpy())
                counts[key] += len(value)
    index = {key: kind.new_empty(0, counts[key], *kind.shape[1:]) for key, kind in kinds.items()}
    write_tensors(folder / _INDEX, index | {"length": torch.cat(lengths)})


def _mapped(folder: Path, count: int) -> dict[str, Tensor]:
    """What was written of `count` tracks, not read yet. Raises WearcapError where compiled loops would read beyond it."""
    index = read_tensors(folder / _INDEX, "packed data set", _FIX)[1]
    with understood(_APART, folder, fix=_FIX, errors=(OSError, LookupError, RuntimeError, TypeError, ValueError)):
        lengths, found = index.pop("length").long(), dict[str, Tensor]()
        rows = {"values": sum(lengths.tolist()), "constants": count}
        for key, kind in index.items():
            path, shape = path_inside(folder, key, folder), kind.shape[1:]
            size, expected = math.prod(shape), rows.get(key.split(".")[0], shape[0])
            if (shape[0], path.stat().st_size) != (expected, size * kind.itemsize):
                raise ValueError(f"{key} is not of {expected} rows")
            found[key] = torch.from_file(str(path), shared=False, size=size, dtype=kind.dtype).reshape(shape)
        joined = Track.of(found)
        if lengths.shape != (count,) or int(lengths.min()) < 1:
            raise ValueError(f"not of {count} recordings")
        _require_alike(joined, joined, str(folder))
    return found | {"length": lengths}


def kept_track(path: Path, make: Callable[[], Track]) -> Track:
    """The track of a recording from a file of its data set's cache, made if it is missing; damaged ones are made anew."""
    if path.is_file():
        try:
            return Track.of(read_tensors(path, "packed recording")[1])
        except WearcapError:
            path.unlink(missing_ok=True)
    track = make().packed()
    with suppress(WearcapError):  # a data set that is only read, or a full disk: the training needs no file
        write_tensors(path, track.flat())
    return track


def forget_old(used: Path) -> None:
    """Remove all but `KEPT` folders of a kind ("windows-…"): the one in use, and those beside it that were used last."""
    with suppress(OSError):  # a data set that is only read, or another process that removes them
        os.utime(used)
        kind = used.name.split("-")[0]
        folders = sorted(used.parent.glob(f"{kind}-*"), key=lambda folder: folder.stat().st_mtime, reverse=True)
        for folder in folders[KEPT:]:
            shutil.rmtree(folder, ignore_errors=True)


@dataclass
class Known:
    """What is known of a data set's recordings without their frames, by their checksums."""

    facts: dict[str, tuple[bool, bool]] = field(default_factory=dict)
    twins: dict[str, dict[str, list[int]]] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path) -> "Known":
        """As a folder of the cache has it; nothing where its file is missing or damaged."""
        with suppress(WearcapError):
            return require_layout(read_json(folder / _KNOWN), cls, folder)
        return cls()

    def keep(self, folder: Path) -> None:
        """Write what the folder does not have."""
        if self != Known.of(folder):
            with suppress(WearcapError):  # a data set that is only read
                write_text(folder / _KNOWN, json.dumps(asdict(self)))


def require_rows(values: dict[str, Any], where: str | Path) -> None:
    """Raise WearcapError unless all values have as many frames."""
    lengths = {name: len(value) for name, value in values.items()}
    if len(set(lengths.values())) > 1:
        what, fix = f"streams of different lengths: {lengths}", "Prepare the recording again."
        raise WearcapError(what, where=where, expected="all on one clock", fix=fix)
