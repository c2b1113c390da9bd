"""Reading text files that strangers wrote: plain, .gz or .xz, of bounded size, with errors that name the line."""

import gzip
import lzma
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError

MAX_BYTES = 1 << 29
"""Largest unpacked size that is read (512 MiB: over an hour of 120 Hz motion as text)."""


@contextmanager
def open_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> Iterator["BoundedReader"]:
    """Open a file for reading bytes, unpacked when its name ends in .gz or .xz.

    Raises WearcapError, while opening or while reading inside the `with` block, when the file is missing, larger than
    `max_bytes` once unpacked, or not what its name says.
    """
    path = Path(path)
    opener = {".gz": gzip.open, ".xz": lzma.open}.get(path.suffix, open)
    try:
        with opener(path, "rb") as file:
            yield BoundedReader(file, path, max_bytes)
    except FileNotFoundError as error:
        raise WearcapError("no such file", where=path) from error
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise WearcapError(
            f"not a complete {path.suffix} file ({error})", where=path, fix="Fetch it again."
        ) from error
    except OSError as error:
        raise WearcapError(f"cannot be read ({error.strerror or error})", where=path) from error


class BoundedReader:
    """A file's `read` that stops where a small packed file would fill the memory."""

    def __init__(self, file, path: Path, max_bytes: int):
        self._file, self._path, self._left, self._max = file, path, max_bytes, max_bytes

    def read(self, size: int = -1) -> bytes:
        content = self._file.read(self._left + 1 if size < 0 else size)
        self._left -= len(content)
        if self._left < 0:
            raise WearcapError(
                f"unpacks to more than {self._max} bytes", where=self._path, expected="a smaller file"
            )
        return content


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Content of a file. Raises WearcapError as `open_bytes` does, and when it is empty."""
    with open_bytes(path, max_bytes) as file:
        content = file.read()
    if not content:
        raise WearcapError("the file is empty", where=path)
    return content


def read_text(path: str | Path) -> str:
    """Text of a file (UTF-8, else Latin-1). Raises WearcapError as `read_bytes` does, and for binary content."""
    content = read_bytes(path)
    if b"\0" in content:
        raise WearcapError("binary content", where=path, expected="a text file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def at_line(path: str | Path, line: int) -> str:
    """Where an error sits: file and line, counted from 1."""
    return f"{path}, line {line}"


def finite_floats(tokens: Iterable[str]) -> np.ndarray:
    """All tokens as float64. Raises ValueError when one is no finite number."""
    values = np.fromiter(map(float, tokens), np.float64)
    if not np.isfinite(values).all():
        raise ValueError("not finite")
    return values


def is_finite_number(token: str) -> bool:
    try:
        return bool(np.isfinite(float(token)))
    except ValueError:
        return False
