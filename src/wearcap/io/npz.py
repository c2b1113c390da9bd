"""Arrays from .npz files of strangers: no pickles, no sizes that the file cannot hold."""

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from wearcap.errors import WearcapError

MAX_BYTES = 1 << 32
"""Largest array that is read (4 GiB)."""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, ValueError, OSError,
           NotImplementedError, RuntimeError, SyntaxError, tokenize.TokenError, KeyError, TypeError,
           OverflowError)  # fmt: skip
"""What zipfile and numpy raise on files that are cut short or tampered with."""


def read_npz(path: str | Path, keys: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, of those named in `keys` the ones that are there (None: all).

    Raises WearcapError for a missing or damaged file, and for an array of Python objects.
    """
    path = Path(path)
    if not path.is_file():
        raise WearcapError("no such file", where=path)
    name = ""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            arrays = {}
            for name in members if keys is None else [key for key in keys if key in members]:
                arrays[name] = _read_member(archive, members[name], path, name)
            return arrays
    except _DAMAGE as error:
        where = f"{path}, array {name!r}" if name else path
        raise WearcapError(f"not a readable .npz file ({error})", where=where, expected="arrays saved by NumPy",
                           fix="Fetch the file again.") from error  # fmt: skip


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path, name: str) -> np.ndarray:
    with archive.open(info) as file:
        version = npy.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"array format {version}")
        shape, fortran, dtype = _HEADERS[version](file)
        if dtype.hasobject:
            raise WearcapError(f"array {name!r} holds Python objects", where=path, expected="plain numbers or text",
                               fix="Such arrays can run code when they are loaded and are never read.")  # fmt: skip
        size = math.prod(shape) * dtype.itemsize
        if any(length < 0 for length in shape) or size > MAX_BYTES or size != info.file_size - file.tell():
            raise ValueError(f"an array of shape {shape} in {info.file_size} bytes")
        content = file.read(size)
    if len(content) != size:
        raise ValueError("its data ends too early")
    array = np.frombuffer(content, dtype)
    return array.reshape(shape, order="F" if fortran else "C").copy(order="C")


def require(
    arrays: dict[str, np.ndarray], path: str | Path, **shapes: tuple[int | str, ...]
) -> dict[str, int]:
    """Check that arrays are there, finite numbers, and of one consistent shape; returns the named sizes.

    `require(arrays, path, trans=("time", 3))` demands three columns and gives {"time": rows}.
    """
    sizes: dict[str, int] = {}
    for key, shape in shapes.items():
        if key not in arrays:
            raise WearcapError(f"no array {key!r}", where=path, expected=f"{', '.join(shapes)} in this file")
        array = arrays[key]
        fits = array.ndim == len(shape) and all(
            length == (sizes.setdefault(axis, length) if isinstance(axis, str) else axis)
            for length, axis in zip(array.shape, shape)
        )
        if not fits:
            words = ", ".join(f"{axis}={sizes[axis]}" if axis in sizes else str(axis) for axis in shape)
            raise WearcapError(f"array {key!r} has shape {array.shape}", where=path, expected=f"({words})")
        if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise WearcapError(f"array {key!r} is of type {array.dtype}", where=path, expected="real numbers")
        if not np.isfinite(array).all():
            row = np.argwhere(~np.isfinite(array))[0].tolist()
            raise WearcapError(f"array {key!r} holds NaN or infinity, first at {row}", where=path, expected="finite numbers")  # fmt: skip
    return sizes
