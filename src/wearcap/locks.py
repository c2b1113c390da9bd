"""Locks of folders: one writer at a time, in all processes of this machine and its workers."""

import errno
import json
import os
import platform
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.files import explaining_writes, open_own

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    import msvcrt

    fcntl = None

LOCK = ".wearcap.lock"
"""Lock file in a folder that one process writes into; it names that process."""

_MAX_HOLDER = 1 << 16
"""Characters of a lock's file that are read."""

LOCK_PATIENCE_S, ORPHANS_PATIENCE_S = 2.0, 20.0
"""Time (s) to wait for a lock that is taken, and for one that only workers of an ended process still hold."""


@contextmanager
def folder_lock(folder: str | Path, purpose: str) -> Iterator[int | None]:
    """Lock a folder for one writer; readers are not affected. The lock ends with its process, however that one dies.

    Yields the lock's descriptor: workers that inherit it (`wearcap.workers`) hold the lock until they end, too, so that
    none writes after another run has taken the folder. Forked children do not hold it. If the file system has no locks,
    it warns and yields None. Raises WearcapError that names the holder when another process has the folder,
    and when the folder cannot be written.
    """
    path = Path(folder) / LOCK
    with explaining_writes(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _wait_for_lock(path)
    if descriptor is None:
        yield None
        return
    _HELD.add(descriptor)
    try:
        holder = {
            "pid": os.getpid(),
            "host": platform.node(),
            "purpose": purpose,
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        with explaining_writes(path.parent), open(descriptor, "w", encoding="utf-8", closefd=False) as file:
            file.truncate()
            json.dump(holder, file)
        yield descriptor
    finally:
        if descriptor in _HELD:  # a forked child does not hold it
            _HELD.remove(descriptor)
            _unlock(path, descriptor)


_HELD: set[int] = set()
"""Descriptors of the locks that this process has taken."""


def _let_go_after_fork() -> None:
    while _HELD:
        os.close(_HELD.pop())  # the parent's own descriptor keeps the lock


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go_after_fork)


def _wait_for_lock(path: Path) -> int | None:
    """Open and lock a file; None where files cannot be locked. Raises WearcapError when it stays locked by another."""
    start = time.monotonic()
    while True:
        try:
            descriptor = open_own(path, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
                raise
            fix = "Remove it: it is not wearcap's, and nothing was written through it."
            raise WearcapError("a link, or no regular file", path, "the lock of this folder", fix) from error
        try:
            _lock(descriptor)
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        except (BlockingIOError, FileNotFoundError):  # locked, or removed by its holder, which has just ended
            pass
        except OSError as error:
            os.close(descriptor)
            path.unlink(missing_ok=True)
            warnings.warn(
                f"{path.parent}: this file system has no locks ({error.strerror}). "
                "Let no other run write into this folder meanwhile.",
                stacklevel=4,
            )
            return None
        try:
            with open(descriptor, encoding="utf-8") as file:
                holder = json.loads(file.read(_MAX_HOLDER))
        except (OSError, ValueError, RecursionError):
            holder = {}
        if not isinstance(holder, dict) or not isinstance(holder.get("pid"), int):
            holder = {}  # the lock's file is being written
        if time.monotonic() - start > (ORPHANS_PATIENCE_S if _has_ended(holder) else LOCK_PATIENCE_S):
            raise _held_by(holder, path.parent)
        time.sleep(0.05)


def _lock(descriptor: int) -> None:
    """Lock a file for this process. Raises BlockingIOError when another has it."""
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        try:
            _lock_on_windows(descriptor, msvcrt.LK_NBLCK)
        except PermissionError as error:
            raise BlockingIOError(*error.args) from error


def _unlock(path: Path, descriptor: int) -> None:
    """Remove a lock's file, if it is still the one in the folder, and release the lock for all processes that share it."""
    with suppress(OSError):
        if fcntl is not None and os.path.samestat(os.fstat(descriptor), path.stat()):
            path.unlink()
    with suppress(OSError):
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        else:
            _lock_on_windows(descriptor, msvcrt.LK_UNLCK)
    os.close(descriptor)
    with suppress(OSError):
        if fcntl is None:
            path.unlink()  # Windows removes no open file


def _lock_on_windows(descriptor: int, mode: int) -> None:
    os.lseek(descriptor, 1 << 20, os.SEEK_SET)  # a byte beyond the text, which others must be able to read
    msvcrt.locking(descriptor, mode, 1)


def _has_ended(holder: dict[str, Any]) -> bool:
    """Whether the process that took a lock has certainly ended, while its workers still hold the lock."""
    if os.name != "posix" or holder.get("host") != platform.node() or holder["pid"] <= 0:
        return False
    try:
        os.kill(holder["pid"], 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:
        return False
    return False


def _held_by(holder: dict[str, Any], folder: Path) -> WearcapError:
    pid, host = holder.get("pid", "unknown"), holder.get("host", "unknown")
    who = f"process {pid} on {host}, {holder.get('purpose', 'unknown')}, since {holder.get('since', 'unknown')}"
    if _has_ended(holder):
        what = f"workers of a run that has ended still write here ({who})"
        expected = "one run at a time in a folder"
        return WearcapError(what, folder, expected, "Run again when they have ended, or end them.")
    end = f"end it (kill {pid})" if host == platform.node() else f"end it on {host}"
    fix = f"Wait until it has ended, {end}, or choose another folder."
    return WearcapError(f"another run writes here ({who})", folder, "one run at a time in a folder", fix)
