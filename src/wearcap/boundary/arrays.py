"""Arrays of .npz and .npy files, and JSON in .zip files: no pickles, no sizes that the file cannot hold."""

import io
import lzma
import math
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from wearcap.boundary.limits import Budget
from wearcap.boundary.opening import counted, file_size, read_bytes, understood
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_MAX_HEADER = 1 << 14
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, MemoryError),
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError),
    *(NotImplementedError, RuntimeError, SyntaxError, tokenize.TokenError),
)
"""Exceptions that zipfile and numpy raise on truncated or damaged files."""


@contextmanager
def open_archive(path: str | Path, kind: str, expected: str) -> Iterator[tuple[zipfile.ZipFile, Budget]]:
    """A zip archive and the budget that its unpacked parts share. Raises WearcapError for a damaged one, too."""
    budget = Budget(path, kind, file_size(path))
    with readable("".join(Path(path).suffixes[-2:]), path, expected), zipfile.ZipFile(path) as archive:
        budget.count(len(archive.infolist()), "parts")
        yield archive, budget


def read_npz(path: str | Path, keys: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an .npz file: those named in `keys` that exist (None: all).

    Raises WearcapError for a missing or damaged file, for an array of Python objects, and where the requested
    arrays exceed the limit together.
    """
    with open_archive(path, "arrays", "arrays saved by NumPy") as (archive, budget):
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        arrays = {}
        for name in members if keys is None else [key for key in keys if key in members]:
            where = f"{path}, array {name!r}"
            with readable(".npz", where, "arrays saved by NumPy"), archive.open(members[name]) as file:
                arrays[name] = _read_array(file, members[name].file_size, where, budget)
        return arrays


def read_packed_json(path: str | Path, expected: str) -> Any:
    """Content of the one JSON file in a zip archive. Raises WearcapError as `open_archive` and `parse_json` do."""
    with open_archive(path, "json", expected) as (archive, budget):
        members = [entry for entry in archive.infolist() if not entry.is_dir() and "__MACOSX" not in entry.filename]
        if len(members) != 1:
            raise WearcapError(f"an archive of {len(members)} files", path, "one JSON file")
        with archive.open(members[0]) as file, counted(file, budget) as reader:
            return parse_json(reader.read(), path)


def read_npy(path: str | Path) -> np.ndarray:
    """The array of an .npy file. Raises WearcapError as `read_npz` does."""
    content = read_bytes(path, "arrays")
    with readable(".npy", path, "an array saved by NumPy"):
        return _read_array(io.BytesIO(content), len(content), str(path), Budget(path, "arrays"))


@contextmanager
def readable(kind: str, where: str | Path, expected: str) -> Iterator[None]:
    """Turn what zipfile and NumPy raise on damaged files into WearcapError."""
    with understood(f"not a readable {kind} file", where, expected, "Fetch the file again.", errors=_DAMAGE):
        yield


def _read_array(file: io.BufferedIOBase, file_bytes: int, where: str, budget: Budget) -> np.ndarray:
    """An archive's array, whose header is checked before memory is taken."""
    head = io.BytesIO(file.read(_MAX_HEADER))
    version = npy.read_magic(head)
    if version not in _HEADERS:
        raise ValueError(f"array format {version}")
    shape, fortran, dtype = _HEADERS[version](head)
    if dtype.hasobject:
        fix = "Such arrays can run code when they are loaded and are never read."
        raise WearcapError("it holds Python objects", where, "plain numbers or text", fix)
    if dtype.kind not in "biufcSU":
        raise WearcapError(f"an array of {dtype}"[:100], where, "plain numbers or text")
    if any(length < 0 for length in shape):
        raise ValueError(f"an array of shape {shape}")
    size = math.prod(shape) * dtype.itemsize
    if size != file_bytes - head.tell():
        raise ValueError(f"an array of shape {shape} in {file_bytes} bytes")
    budget.spend(size)
    file.seek(0)
    array = npy.read_array(file, allow_pickle=False)
    array = array.copy(order="C") if fortran else array
    points = np.dtype("u4").newbyteorder(dtype.byteorder)
    if dtype.kind == "U" and size and (array.reshape(-1).view(points) > sys.maxunicode).any():
        raise ValueError("text with characters that are none")
    return array


def array_of(value: Any, where: str | Path) -> np.ndarray:
    """An array, or one of lists of numbers. Raises WearcapError for rows of several lengths, and for anything else."""
    if isinstance(value, np.ndarray):
        return value
    with understood("no array of numbers", where, errors=(ValueError, TypeError, OverflowError)):
        return np.asarray(value, np.float64)  # of texts NumPy makes an array in which each is as long as the longest


def require(arrays: dict[str, np.ndarray], path: str | Path, **shapes: tuple[int | str, ...]) -> dict[str, int]:
    """Check that arrays are there, finite numbers, and of one consistent shape; returns the named sizes.

    `require(arrays, path, trans=("time", 3))` demands three columns and gives {"time": rows}.
    """
    sizes: dict[str, int] = {}
    for key, shape in shapes.items():
        if key not in arrays:
            raise WearcapError(f"no array {key!r}", path, f"{', '.join(shapes)} in this file")
        array = arrays[key]
        fits = array.ndim == len(shape) and all(
            length == (sizes.setdefault(axis, length) if isinstance(axis, str) else axis)
            for length, axis in zip(array.shape, shape)
        )
        if not fits:
            words = ", ".join(f"{axis}={sizes[axis]}" if axis in sizes else str(axis) for axis in shape)
            raise WearcapError(f"array {key!r} has shape {array.shape}", path, f"({words})")
        if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise WearcapError(f"array {key!r} is of type {array.dtype}", path, "real numbers")
        if not np.isfinite(array).all():
            row = np.argwhere(~np.isfinite(array))[0].tolist()
            raise WearcapError(f"array {key!r} holds NaN or infinity, first at {row}", path, "finite numbers")
    return sizes
