"""Columns of numbers from a CSV file with a header line, plain or compressed (.gz, .xz)."""

import csv
import difflib
import gzip
import lzma
import warnings
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from wearcap.errors import WearcapError

_OPENERS = {".gz": gzip.open, ".xz": lzma.open}


@contextmanager
def open_text(path: str | Path) -> Iterator[IO[str]]:
    """Open a text file for reading, decompressing by its suffix.

    Raises WearcapError when it is missing, not text, or its compressed data is damaged or cut short; errors of
    this kind that show only while reading inside the `with` block are named too.
    """
    path = Path(path)
    try:
        with _OPENERS.get(path.suffix, open)(path, "rt", encoding="utf-8", newline="") as file:
            yield file
    except FileNotFoundError as error:
        raise WearcapError("no such file", where=path) from error
    except UnicodeDecodeError as error:
        raise WearcapError("not a text file", where=path, expected="UTF-8 text") from error
    except (EOFError, gzip.BadGzipFile, lzma.LZMAError, zlib.error) as error:
        raise WearcapError(f"its compressed data is damaged or cut short ({error})", where=path,
                           fix="Copy or download the file again.") from error  # fmt: skip
    except OSError as error:
        raise WearcapError(f"cannot be read ({error.strerror or error})", where=path) from error


def read_header(path: str | Path) -> list[str]:
    """Column names of the first line. Raises WearcapError when the file is empty."""
    with open_text(path) as file:
        header = [name.strip() for name in next(csv.reader(file), [])]
    if not any(header):
        raise WearcapError("the file is empty", where=path, expected="a header line with column names")
    return header


def read_columns(
    path: str | Path, columns: Sequence[str], *, text: Sequence[str] = (), whole: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Named columns as float64 arrays, those in `text` as byte strings (at most 64 characters), in `whole` as int64.

    Raises WearcapError for a missing column (with the nearest name that is there), a field that is no number
    (with its line), or a file without rows.
    """
    return next(iter_columns(path, columns, text=text, whole=whole, rows=None))


def iter_columns(
    path: str | Path,
    columns: Sequence[str],
    *,
    text: Sequence[str] = (),
    whole: Sequence[str] = (),
    rows: int | None = 1_000_000,
) -> Iterator[dict[str, np.ndarray]]:
    """As `read_columns`, but at most `rows` lines at a time, for files larger than memory."""
    header = read_header(path)
    wanted = [*columns, *text, *whole]
    for name in wanted:
        if name not in header:
            near = difflib.get_close_matches(name, header, n=1)
            raise WearcapError(f"no column {name!r}", where=path,
                               expected=f"the columns {', '.join(wanted)}",
                               fix=f"The nearest is {near[0]!r}." if near else "")  # fmt: skip
    kinds = dict.fromkeys(columns, "f8") | dict.fromkeys(text, "S64") | dict.fromkeys(whole, "i8")
    done = 0
    with open_text(path) as file:
        next(file)
        while True:
            table = _read_rows(file, path, header, kinds, rows, done)
            if not len(table) and not done:
                raise WearcapError("a header line, but no rows", where=path)
            if len(table):
                yield {name: table[name] for name in wanted}
            done += len(table)
            if rows is None or len(table) < rows:
                return


def _read_rows(
    file: Iterable[str],
    path: str | Path,
    header: list[str],
    kinds: dict[str, str],
    rows: int | None,
    done: int,
) -> np.ndarray:
    """The next rows of an open file as a structured array; `done` were read before."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # numpy's own word on an empty file; ours follows
        try:
            return np.loadtxt(
                file, dtype=np.dtype(list(kinds.items())), delimiter=",", usecols=[header.index(name) for name in kinds],
                comments=None, ndmin=1, max_rows=rows,
            )  # fmt: skip
        except (ValueError, OverflowError) as error:
            raise WearcapError(f"not a table of numbers ({error}; rows count from {f'row {done}' if done else 'after the header'})",
                               where=path, expected=f"{len(header)} comma-separated fields in every line") from error  # fmt: skip
