"""Writing files so that a reader sees the old one or the new one, never half of one; files that come with the package;
SHA-256 of files, remembered by their size, time and inode.

The cache of checksums is in the user's cache folder, so that a data set is hashed when it is first used and not again by
every process that opens it. A file whose bytes change without its time changing (a failing disk) is detected by
`wearcap doctor`, which rehashes every file.
"""

import errno
import hashlib
import json
import os
import re
import stat
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from wearcap.errors import WearcapError

_TEMPORARY = re.compile(r"\..+\.tmp-[0-9a-f]{8}(\.[^.]+)?")
_OF_WRITES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is synced and renamed there, on failure removed.

    The temporary file is locked while it is written, so that `remove_leftovers` can distinguish it from one whose writer
    was killed; the first write into a folder removes those. Raises WearcapError when the disk is full or the folder cannot
    be written; other errors of the `with` body, such as those of a source that it reads, pass unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.tmp-{uuid.uuid4().hex[:8]}{path.suffix}")
    claim = None
    try:
        with explaining_writes(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_leftovers_once(str(path.parent.absolute()))
            claim = _claim(temporary)
        with explaining_writes(path, only_about=(temporary, path, path.parent)):
            yield temporary
        with explaining_writes(path):
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
            _sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if claim is not None:
            os.close(claim)


@contextmanager
def explaining_writes(path: Path, only_about: tuple[Path, ...] | None = None) -> Iterator[None]:
    """Turn an OSError into a WearcapError with the reason why `path` cannot be written.

    With `only_about`, only errors that name one of those paths, or that name none and can only come from a write.
    """
    try:
        yield
    except OSError as error:
        named = isinstance(error.filename, str | os.PathLike) and Path(error.filename) in (only_about or ())
        if not (only_about is None or named or (error.filename is None and error.errno in _OF_WRITES)):
            raise
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            what, fix = "the disk is full", "Free some space and run again."
        elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            what, fix = "no permission to write here", "Choose another output folder."
        else:
            what, fix = f"cannot be written ({error.strerror or error})", ""
        raise WearcapError(what, path, fix=fix) from error


def _sync_folder(folder: Path) -> None:
    """Make a rename in the folder survive a power cut, where the system can sync folders."""
    if os.name != "posix":
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:  # a folder that may be written but not listed
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network file systems refuse it
            raise
    finally:
        os.close(descriptor)


def _claim(temporary: Path) -> int | None:
    """Create and lock the file; returns the descriptor, or None where files cannot be locked."""
    if os.name != "posix":
        return None  # Windows renames no open file
    while True:
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            lock_descriptor(descriptor)
        except OSError:
            os.close(descriptor)
            return None
        if os.fstat(descriptor).st_nlink:
            return descriptor
        os.close(descriptor)  # taken for a leftover in the moment before it was locked


def open_own(path: Path, flags: int) -> int:
    """Descriptor of a regular file that lies under a fixed name in a folder from anywhere.

    Raises OSError for a link, whose target is not touched, for a pipe, and for a device.
    """
    descriptor = os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o666)
    try:
        require_own(descriptor, path)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def require_own(descriptor: int, path: Path) -> None:
    """Raise OSError for an open file that is a pipe or a device, or that has another name, too."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        raise OSError(errno.ELOOP, "no regular file of its own", str(path))


def remove_leftovers(folder: str | Path, *, below: bool = False) -> None:
    """Remove temporary files of `atomic_path` whose writer was killed, from a folder or, with `below`, from its subfolders too.

    A file whose writer is alive is locked by it and stays, as do files of any other name, and all files if the file
    system has no locks.
    """
    for where, _, names in os.walk(folder):
        for name in names:
            if not _TEMPORARY.fullmatch(name):
                continue
            path = Path(where, name)
            with suppress(OSError):  # locked, removed by another process, or without permission to remove
                if os.name != "posix":
                    path.unlink()  # Windows refuses this while a writer has it open
                    continue
                descriptor = open_own(path, os.O_RDWR)
                try:
                    if lock_descriptor(descriptor, blocking=False):
                        path.unlink()
                finally:
                    os.close(descriptor)
        if not below:
            return


@lru_cache(maxsize=1024)
def _remove_leftovers_once(folder: str) -> None:
    remove_leftovers(folder)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def sha256_of(path: str | Path) -> str:
    """Hex digest of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_hash(*parts: Any) -> str:
    """Hex digest (16 digits) of settings (anything JSON can hold) and of the bytes of files given as Path."""
    plain = [sha256_of(part) if isinstance(part, Path) else part for part in parts]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def resource(in_checkout: str, in_wheel: str) -> Path:
    """A folder of the checkout when the package is imported from one, else the copy that the wheel carries."""
    package = Path(__file__).resolve().parent
    checkout = package.parents[1]
    if (checkout / "pyproject.toml").is_file() and (checkout / in_checkout).is_dir():
        return checkout / in_checkout
    return package / "_resources" / in_wheel


SETTLED_S = 2.0
"""Age (s) below which files are hashed every time: a file system's clock may not separate two writes."""
_SUMS, MAX_LEDGER_BYTES = "sha256.jsonl", 1 << 26
"""The cache of digests, and the size (64 MiB, some 300,000 files) beyond which it is cleared."""

Key = tuple[str, int, int, int]


def remembered_sha256(path: str | Path) -> str:
    """Hex digest of a file's bytes, from the cache if the file has been hashed before and looks the same.

    Raises OSError when it cannot be read.
    """
    key = _key(Path(path))
    known = _ledger()
    if key in known:
        return known[key]
    digest = sha256_of(path)
    if key == _key(Path(path)) and time.time() - key[2] / 1e9 > SETTLED_S:
        known[key] = digest
        remember(_SUMS, [*key, digest])
    return digest


def _key(path: Path) -> Key:
    found = path.stat()
    return str(path.resolve()), found.st_size, found.st_mtime_ns, found.st_ino


def cache_folder() -> Path:
    """$WEARCAP_CACHE, else `wearcap` in the user's cache folder."""
    if chosen := os.environ.get("WEARCAP_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wearcap"


def remember(ledger: str, value: Any) -> None:
    """Add a line of JSON to a file in the cache folder. Without such a folder nothing is kept."""
    path = cache_folder() / ledger
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file:  # one write, so that lines of other processes do not mix with it
            file.write((json.dumps(value) + "\n").encode())


def remembered(ledger: str) -> list[Any]:
    """Values of a file's lines in the cache folder; truncated or foreign ones are ignored."""
    values = []
    with suppress(OSError, UnicodeDecodeError):
        for line in (cache_folder() / ledger).read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                values.append(json.loads(line))
    return values


@cache
def _ledger() -> dict[Key, str]:
    """Digests cached by earlier processes."""
    known: dict[Key, str] = {}
    with suppress(OSError):
        if (path := cache_folder() / _SUMS).stat().st_size > MAX_LEDGER_BYTES:
            path.unlink()
    for row in remembered(_SUMS):
        with suppress(ValueError, TypeError):
            name, size, mtime_ns, inode, digest = row
            known[(name, size, mtime_ns, inode)] = digest
    return known
