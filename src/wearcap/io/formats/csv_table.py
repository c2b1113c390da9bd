"""Columns of numbers from a CSV file with a header line, plain or compressed (.gz, .xz).

Semicolons and tabs separate fields, too, then with decimal points or commas; lines about the recording may stand above
the header ("// Update Rate: 100.0Hz", "sep=;", "DeviceTag:,DOT 1").
"""

import csv
import difflib
import io
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.boundary.opening import open_bytes, understood
from wearcap.boundary.texts import bounded_lines
from wearcap.errors import WearcapError

_ABOUT = re.compile(r'\s*(//|sep=|©|"?[\w ]+"?:[\s,;]|$)')
"""Beginnings of lines that stand above a header, of which there are at most `_MAX_ABOUT`."""
_MAX_ABOUT = 64


@contextmanager
def open_text(path: str | Path, kind: str = "table") -> Iterator[Iterator[str]]:
    """Lines of a text file (UTF-8), unpacked by its suffix.

    Raises WearcapError as `open_bytes` does, for what is no text and for lines that are too long; errors that show
    only while reading inside the `with` block are named too.
    """
    with understood("not a text file", path, "UTF-8 text", errors=UnicodeDecodeError), open_bytes(path, kind) as file:
        lines = bounded_lines(io.TextIOWrapper(file, "utf-8-sig", newline=""), path, kind)
        yield (line for _, line in lines)


def load_rows(lines: Iterable[str], what: str, where: str | Path, expected: str = "", **options: Any) -> np.ndarray:
    """`numpy.loadtxt` of lines, of which there may be none; its errors become WearcapError."""
    with warnings.catch_warnings(), understood(what, where, expected, errors=(ValueError, OverflowError)):
        warnings.simplefilter("ignore", UserWarning)  # numpy warns about an empty file
        return np.loadtxt(lines, **options)


def read_layout(path: str | Path) -> tuple[list[str], list[str], str]:
    """(lines above the header, column names, delimiter). Raises WearcapError for an empty file, and commas of two kinds."""
    about, header, row, delimiter = list[str](), list[str](), list[str](), ","
    with open_text(path) as file:
        for line in file:
            if len(about) < _MAX_ABOUT and _ABOUT.match(line):
                about.append(line.strip())
                continue
            delimiter = max(",;\t", key=line.count)
            header, row = (next(csv.reader([text], delimiter=delimiter), []) for text in (line, next(file, "")))
            break
    if not any(header):
        raise WearcapError("the file is empty", path, "a header line with column names")
    if delimiter == "," and len(row) > len(header) and all(row[: 2 * len(header)]):
        what = f"{len(row)} fields below a header of {len(header)}"
        fix = "Are decimal commas written between commas? Export with decimal points, or semicolons between fields."
        raise WearcapError(what, path, "a field for each column", fix)
    return about, [name.strip() for name in header], delimiter


def read_header(path: str | Path) -> list[str]:
    """Column names. Raises WearcapError as `read_layout` does."""
    return read_layout(path)[1]


def read_columns(
    path: str | Path, columns: Sequence[str], *, text: Sequence[str] = (), integers: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Named columns as float64 arrays, those in `text` as byte strings (at most 64 characters), in `integers` as int64.

    Raises WearcapError for a missing column (with the nearest name that is there), a field that is no number
    (with its line), or a file without rows.
    """
    return next(iter_columns(path, columns, text=text, integers=integers, rows=None))


def iter_columns(
    path: str | Path,
    columns: Sequence[str],
    *,
    text: Sequence[str] = (),
    integers: Sequence[str] = (),
    rows: int | None = 1_000_000,
) -> Iterator[dict[str, np.ndarray]]:
    """As `read_columns`, but at most `rows` lines at a time, for files larger than memory."""
    about, header, delimiter = read_layout(path)
    wanted = [*columns, *text, *integers]
    for name in wanted:
        if name not in header:
            near = difflib.get_close_matches(name, header, n=1)
            fix = f"The nearest is {near[0]!r}." if near else ""
            raise WearcapError(f"no column {name!r}", path, f"the columns {', '.join(wanted)}", fix)
    kinds = dict.fromkeys(columns, "f8") | dict.fromkeys(text, "S64") | dict.fromkeys(integers, "i8")
    done = 0
    with open_text(path, "table" if rows is None else "streamed table") as file:
        lines = islice(file, len(about) + 1, None)
        if delimiter != ",":
            lines = (_plain(line, delimiter) for line in lines)
        while True:
            table = load_rows(
                lines,
                f"not a table of numbers; rows count from {f'row {done}' if done else 'after the header'}",
                path,
                f"{len(header)} fields with {delimiter!r} between in every line",
                dtype=np.dtype(list(kinds.items())),
                delimiter=delimiter,
                usecols=[header.index(name) for name in kinds],
                comments=None,
                ndmin=1,
                max_rows=rows,
            )
            if not len(table) and not done:
                raise WearcapError("a header line, but no rows", path)
            if len(table):
                yield {name: table[name] for name in wanted}
            done += len(table)
            if rows is None or len(table) < rows:
                return


def _plain(line: str, delimiter: str) -> str:
    """A line of a table without commas between its fields: with decimal points, and NaN where a field is empty."""
    fields = line.rstrip("\r\n").replace(",", ".").split(delimiter)
    return delimiter.join(field.strip() or "nan" for field in fields)
