"""Arrays from untrusted .npz and .npy files: no pickles, no sizes that the file cannot hold."""

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

import numpy as np
from numpy.lib import format as npy

from wearcap.errors import WearcapError
from wearcap.io.formats.bounded import Budget, file_size, read_bytes, understood

MAX_BYTES = 1 << 32
"""Largest total size of the arrays that are read from one file (4 GiB)."""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_MAX_HEADER = 1 << 14
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, MemoryError),
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError),
    *(NotImplementedError, RuntimeError, SyntaxError, tokenize.TokenError),
)
"""Exceptions that zipfile and numpy raise on truncated or damaged files."""


def read_npz(
    path: str | Path, keys: Iterable[str] | None = None, max_bytes: int | None = None
) -> dict[str, np.ndarray]:
    """Arrays of an .npz file: those named in `keys` that exist (None: all).

    Raises WearcapError for a missing or damaged file, for an array of Python objects, and where the requested
    arrays exceed `max_bytes` together.
    """
    path = Path(path)
    budget = Budget(path, file_size(path), MAX_BYTES, max_bytes)
    with readable(".npz", path, "arrays saved by NumPy"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        arrays = {}
        for name in members if keys is None else [key for key in keys if key in members]:
            where = f"{path}, array {name!r}"
            with readable(".npz", where, "arrays saved by NumPy"), archive.open(members[name]) as file:
                arrays[name] = _read_array(file, members[name].file_size, where, budget)
        return arrays


def read_npy(path: str | Path, max_bytes: int | None = None) -> np.ndarray:
    """The array of an .npy file. Raises WearcapError as `read_npz` does."""
    content = read_bytes(path, max_bytes, MAX_BYTES)
    with readable(".npy", path, "an array saved by NumPy"):
        return _read_array(io.BytesIO(content), len(content), str(path), Budget(path, len(content)))


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
