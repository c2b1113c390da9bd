"""Reading untrusted text files: plain, .gz or .xz, of bounded size, with errors that name the line."""

import codecs
import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from wearcap.errors import WearcapError
from wearcap.io.formats.bounded import open_bytes, read_bytes

MAX_BYTES = 1 << 29
"""Largest text that is taken into memory as a whole (512 MiB: over an hour of 120 Hz motion)."""
MAX_STREAMED_BYTES = 1 << 32
"""Largest text that is read line by line (4 GiB)."""
MAX_LINE = 1 << 24
"""Longest line (characters): COLMAP lists all points of a picture in one line."""


def _as_latin1(error: UnicodeError) -> tuple[str, int]:
    """Error handler of decoding that reads bytes that are no UTF-8 as Latin-1."""
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("latin-1"), error.end


codecs.register_error("wearcap.latin1", _as_latin1)


def read_text(path: str | Path, max_bytes: int | None = None, usual: int = MAX_BYTES) -> str:
    """Text of a file (UTF-8, else Latin-1). Raises WearcapError as `read_bytes` does, and for binary content."""
    content = read_bytes(path, max_bytes, usual)
    if b"\0" in content:
        raise WearcapError("binary content", where=path, expected="a text file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


@contextmanager
def open_lines(path: str | Path, usual: int = MAX_STREAMED_BYTES) -> Iterator[Iterator[str]]:
    """A text's lines one after another (UTF-8; other bytes are taken as Latin-1).

    Raises WearcapError as `open_bytes` does, while opening or inside the `with` block, for binary content and for
    lines longer than `MAX_LINE`.
    """
    with open_bytes(path, usual=usual) as file:
        yield _lines(io.TextIOWrapper(file, "utf-8-sig", errors="wearcap.latin1"), path)


def _lines(file: io.TextIOWrapper, path: str | Path) -> Iterator[str]:
    number = 0
    while line := file.readline(MAX_LINE):
        number += 1
        if "\0" in line:
            raise WearcapError("binary content", where=at_line(path, number), expected="a text file")
        if len(line) == MAX_LINE and not line.endswith("\n"):
            raise WearcapError(
                f"a line longer than {MAX_LINE} characters", where=at_line(path, number), expected="a text file"
            )
        yield line
    if not number:
        raise WearcapError("the file is empty", where=path)


def numbered_lines(path: str | Path, usual: int = MAX_STREAMED_BYTES) -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, counted from 1. Raises WearcapError as `open_lines` does."""
    with open_lines(path, usual) as lines:
        yield from enumerate(lines, 1)


def at_line(path: str | Path, line: int) -> str:
    """Position of an error: file and line, counted from 1."""
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
