"""Reading text files that strangers wrote: plain, .gz or .xz, of bounded size, with errors that name the line."""

import gzip
import lzma
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError

MAX_BYTES = 1 << 29
"""Largest unpacked size that is read (512 MiB: over an hour of 120 Hz motion as text)."""


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Content of a file, unpacked when its name ends in .gz or .xz.

    Raises WearcapError when it is missing, empty, larger than `max_bytes` once unpacked, or not what its name says.
    """
    path = Path(path)
    opener = {".gz": gzip.open, ".xz": lzma.open}.get(path.suffix, open)
    try:
        with opener(path, "rb") as file:
            content = file.read(max_bytes + 1)
    except FileNotFoundError as error:
        raise WearcapError("no such file", where=path) from error
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise WearcapError(
            f"not a complete {path.suffix} file ({error})", where=path, fix="Fetch it again."
        ) from error
    except OSError as error:
        raise WearcapError(f"cannot be read ({error.strerror or error})", where=path) from error
    if len(content) > max_bytes:
        raise WearcapError(f"unpacks to more than {max_bytes} bytes", where=path, expected="a smaller file")
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
