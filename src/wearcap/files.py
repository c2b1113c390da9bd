"""Writing files so that a reader sees the old one or the new one, never half of one; files that come with the package."""

import errno
import hashlib
import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError

MAX_JSON_DEPTH = 64
"""Deepest nesting of JSON that is read; what wearcap writes stays below 16."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is synced and renamed there, on failure removed.

    Raises WearcapError when the disk is full or the folder cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.tmp-{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _explained(error, path) from error
    finally:
        temporary.unlink(missing_ok=True) if path.parent.is_dir() else None


def _explained(error: OSError, path: Path) -> WearcapError:
    if error.errno == errno.ENOSPC:
        return WearcapError("the disk is full", where=path, fix="Free some space and run again.")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return WearcapError("no permission to write here", where=path, fix="Choose another output folder.")
    return WearcapError(f"cannot be written ({error.strerror or error})", where=path)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def parse_json(text: str | bytes, where: str | Path) -> Any:
    """Content of JSON text that may come from a stranger.

    Raises WearcapError for text that is no JSON, not UTF-8, nested deeper than `MAX_JSON_DEPTH`, or with whole numbers
    beyond 64 bits.
    """
    try:
        content = json.loads(text, parse_int=_whole_number)
    except RecursionError as error:
        raise _too_deep(where) from error
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise WearcapError(f"not readable JSON ({error})"[:300], where=where, expected="a whole JSON text") from error  # fmt: skip
    level = [content]
    for _ in range(MAX_JSON_DEPTH):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return content
    raise _too_deep(where)


def _whole_number(text: str) -> int:
    value = int(text)
    if not -(1 << 63) <= value < 1 << 64:
        raise ValueError(f"the whole number {text[:30]}… has more than 64 bits")
    return value


def _too_deep(where: str | Path) -> WearcapError:
    return WearcapError("JSON that is nested too deeply", where=where, expected=f"at most {MAX_JSON_DEPTH} levels")  # fmt: skip


def sha256_of(path: str | Path) -> str:
    """Hex digest of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def resource(in_checkout: str, in_wheel: str) -> Path:
    """A folder of the checkout when the package is imported from one, else the copy that the wheel carries."""
    package = Path(__file__).resolve().parent
    checkout = package.parents[1]
    if (checkout / "pyproject.toml").is_file() and (checkout / in_checkout).is_dir():
        return checkout / in_checkout
    return package / "_resources" / in_wheel
