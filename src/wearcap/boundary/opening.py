"""Opening what strangers hand over: regular files only, unpacked within the limits of their kind, and errors that name them."""

import gzip
import io
import lzma
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from wearcap.boundary.limits import Budget
from wearcap.errors import WearcapError

_CHUNK = 1 << 18
_OPENERS: dict[str, Any] = {".gz": gzip.open, ".xz": lzma.open}
_DAMAGE = (EOFError, lzma.LZMAError, gzip.BadGzipFile, zlib.error)


def file_size(path: str | Path, kind: str = "file") -> int:
    """Bytes of a regular file; `kind` is what a message calls it when it is missing.

    Raises WearcapError when it is missing, a folder, a pipe or device, or not allowed.
    """
    with explained(path, kind):
        try:
            status = os.stat(path)
        except ValueError as error:  # a NUL, or what the file system's encoding does not have
            raise WearcapError("a name that no file can have", repr(str(path))) from error
        mode = status.st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError
        if not stat.S_ISREG(mode):
            found = "pipe" if stat.S_ISFIFO(mode) else "socket" if stat.S_ISSOCK(mode) else "device"
            raise WearcapError(f"a {found}", path, "a regular file", "Copy its content to a file.")
        return status.st_size


@contextmanager
def explained(path: str | Path, kind: str = "file") -> Iterator[None]:
    """Turn errors of the operating system and of decompressors into WearcapError."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise WearcapError(f"no such {kind}", path) from error
    except PermissionError as error:
        fix = "Ask its owner, or change its mode (chmod)."
        raise WearcapError("no permission to read it", path, fix=fix) from error
    except IsADirectoryError as error:
        raise WearcapError("a folder", path, "a file") from error
    except _DAMAGE as error:
        what = f"not a complete {Path(path).suffix} file: its packed data is damaged or cut short ({error})"
        raise WearcapError(what, path, fix="Copy or fetch it again.") from error
    except OSError as error:
        raise WearcapError(f"cannot be read ({error.strerror or error})", path) from error
    except MemoryError as error:
        raise WearcapError("it does not fit into this machine's memory", path) from error


_MALFORMED = (LookupError, TypeError, ValueError, OverflowError, AttributeError)
"""Exceptions of taking content apart that is not laid out as it should be."""


@contextmanager
def understood(
    what: str,
    where: str | Path,
    expected: str = "",
    fix: str = "",
    errors: type[Exception] | tuple[type[Exception], ...] = _MALFORMED,
) -> Iterator[None]:
    """Turn the exceptions of taking foreign content apart into a WearcapError: `what`, and the exception's own words."""
    try:
        yield
    except PermissionError:
        with explained(where):
            raise
    except errors as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise WearcapError(f"{what} ({reason or type(error).__name__})"[:300], where, expected, fix) from error


@contextmanager
def placed(where: str | Path) -> Iterator[None]:
    """Name the place in the errors of what is built from a file's content and knows nothing of the file."""
    try:
        yield
    except WearcapError as error:
        raise WearcapError(error.what, where, error.expected, error.fix) from error


@contextmanager
def open_bytes(path: str | Path, kind: str = "file") -> Iterator[io.BufferedReader]:
    """Open a file for reading bytes, unpacked when its name ends in .gz or .xz.

    Raises WearcapError, while opening or while reading inside the `with` block, when the file is missing, no regular
    file, not in the format of its suffix, or beyond the limits of its kind.
    """
    size = file_size(path)
    opener = _OPENERS.get(Path(path).suffix, open)
    if opener is open:
        Budget(path, kind).spend(size)  # raises before a byte is read
    with explained(path), opener(path, "rb") as file, counted(file, Budget(path, kind, size)) as reader:
        yield reader


def counted(file: io.BufferedIOBase, budget: Budget) -> io.BufferedReader:
    """A stream whose bytes are counted against a budget as they are read."""
    return io.BufferedReader(_Counted(file, budget), _CHUNK)


class _Counted(io.RawIOBase):
    def __init__(self, file: io.BufferedIOBase, budget: Budget):
        self._file, self._budget = file, budget

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        content = self._file.read(len(buffer))
        buffer[: len(content)] = content
        self._budget.spend(len(content))
        return len(content)

    def readall(self) -> bytes:
        """The remaining bytes, in memory only once: BytesIO returns its own buffer."""
        whole = io.BytesIO()
        while content := self._file.read(_CHUNK):
            self._budget.spend(len(content))
            whole.write(content)
        return whole.getvalue()


def read_bytes(path: str | Path, kind: str = "file") -> bytes:
    """Content of a file. Raises WearcapError as `open_bytes` does, and when it is empty."""
    with open_bytes(path, kind) as file:
        content = file.read()
    if not content:
        raise WearcapError("the file is empty", path)
    return content


def path_inside(folder: str | Path, name: object, where: str | Path) -> Path:
    """The path of a file that another one names: relative to a folder and, once links are resolved, inside it.

    What lies there, if anything, is a regular file or a folder. Raises WearcapError, naming `where` it is named, for
    anything else.
    """
    if isinstance(name, str) and name.isprintable() and 0 < len(name.encode()) < 256 and "\\" not in name:
        path, parts = Path(folder) / name, PurePosixPath(name).parts
        real = Path(os.path.realpath(path))
        if parts and parts[0] != "/" and ".." not in parts and real.is_relative_to(os.path.realpath(folder)):
            if path.exists() and not path.is_dir():
                file_size(path)
            return path
    what = f"it names the file {str(name)[:80]!r}"
    raise WearcapError(what, where, f"a relative path inside {folder}", "Copy the file there and name it relatively.")
