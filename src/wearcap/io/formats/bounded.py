"""Boundary check of untrusted files: only regular files are read, unpacked up to a limit that the user can raise.

A compressed file of kilobytes may unpack to more than all memory. Bytes read are counted against a limit of size and,
beyond `FREE_BYTES`, of the ratio to the packed bytes. `wearcap --max-file-gib N` (for worker processes the environment
variable `WEARCAP_MAX_FILE_GIB`) or a reader's `max_bytes` replaces both limits.
"""

import gzip
import io
import lzma
import math
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError

VARIABLE = "WEARCAP_MAX_FILE_GIB"
MAX_BYTES = 1 << 32
"""Largest unpacked size of one file unless its reader sets another (4 GiB)."""
FREE_BYTES = 1 << 26
"""Unpacked bytes up to which their ratio to the packed ones does not matter (64 MiB)."""
MAX_RATIO = 100
"""Largest ratio of unpacked to packed bytes: text captures reach 5 to 30, decompression bombs a thousand and more."""
_CHUNK = 1 << 18
_OPENERS: dict[str, Any] = {".gz": gzip.open, ".xz": lzma.open}
_DAMAGE = (EOFError, lzma.LZMAError, gzip.BadGzipFile, zlib.error)


class Budget:
    """Number of bytes that may still be unpacked from one file."""

    def __init__(self, path: str | Path, packed: int, usual: int = MAX_BYTES, max_bytes: int | None = None):
        """`packed` is the file's size in bytes, `usual` the limit of its kind, `max_bytes` the caller's own."""
        text = os.environ.get(VARIABLE, "").strip()
        lifted = gib_bytes(text, VARIABLE) if max_bytes is None and text else max_bytes
        self.path, self.spent = path, 0
        self.max_bytes = usual if lifted is None else lifted
        self._by_ratio = math.inf if lifted is not None else max(FREE_BYTES, MAX_RATIO * packed)

    def spend(self, size: int) -> None:
        """Count bytes before or after they are unpacked. Raises WearcapError beyond the limit."""
        self.spent += size
        if self.spent > self.max_bytes:
            units = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
            unit, name = next((known for known in units if self.max_bytes >= known[0]), (1, "bytes"))
            what = f"larger than {self.max_bytes / unit:.4g} {name} once unpacked"
            raise WearcapError(what, self.path, "a smaller file", _lift(self.spent))
        if self.spent > self._by_ratio:
            what = f"it unpacks to more than {MAX_RATIO} times its size"
            raise WearcapError(what, self.path, "a capture, which packs 5 to 30 times", _lift(self.spent))


def gib_bytes(text: str, where: str) -> int:
    """Bytes of a number of GiB. Raises WearcapError naming `where` it was given when it is no positive number."""
    try:
        gib = float(text)
    except ValueError:
        gib = math.nan
    if not 0 < gib < 1e9:
        raise WearcapError(f"a limit of {text[:30]!r} GiB", where, "a number above 0, such as 16")
    return int(gib * (1 << 30))


def _lift(size: int) -> str:
    return f"If you trust it, lift the limit: wearcap --max-file-gib {max(1, math.ceil(2 * size / (1 << 30)))} VERB …"


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
def open_bytes(path: str | Path, max_bytes: int | None = None, usual: int = MAX_BYTES) -> Iterator[io.BufferedReader]:
    """Open a file for reading bytes, unpacked when its name ends in .gz or .xz.

    Raises WearcapError, while opening or while reading inside the `with` block, when the file is missing, no regular
    file, not in the format of its suffix, or larger than `max_bytes` (default: `usual`, unless the user raised it).
    """
    size = file_size(path)
    opener = _OPENERS.get(Path(path).suffix, open)
    budget = Budget(path, size, usual, max_bytes)
    if opener is open:
        Budget(path, size, usual, max_bytes).spend(size)  # raises before a byte is read
    with explained(path), opener(path, "rb") as file, counted(file, budget) as reader:
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


def read_bytes(path: str | Path, max_bytes: int | None = None, usual: int = MAX_BYTES) -> bytes:
    """Content of a file. Raises WearcapError as `open_bytes` does, and when it is empty."""
    with open_bytes(path, max_bytes, usual) as file:
        content = file.read()
    if not content:
        raise WearcapError("the file is empty", path)
    return content
