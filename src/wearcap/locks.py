"""Locks of folders: one writer at a time, in all processes of this machine and its workers.

The lock is filelock's; here is what it lacks: the holder by name, workers that hold the lock on, folders from anywhere.
"""

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

from filelock import FileLock, Timeout

from wearcap.errors import WearcapError
from wearcap.files import explaining_writes, open_own, require_own

LOCK = ".wearcap.lock"
"""Lock file in a folder that one process writes into; it names that process."""

_MAX_HOLDER = 1 << 16
"""Bytes of a lock's file that are read."""

LOCK_PATIENCE_S, ORPHANS_PATIENCE_S = 2.0, 20.0
"""Time (s) to wait for a lock that is taken, and for one that only workers of an ended process still hold."""

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)


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
        lock, descriptor = _taken(path)
    if lock is None:
        yield None
        return
    try:
        holder = {
            "pid": os.getpid(),
            "host": platform.node(),
            "purpose": purpose,
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        with explaining_writes(path.parent), open(descriptor, "w", encoding="utf-8", closefd=False) as file:
            file.truncate()
            file.write(" " + json.dumps(holder))  # Windows lets others read all but the first byte
        yield descriptor
    finally:
        if lock.is_locked:  # a forked child does not hold it
            with suppress(OSError):
                if os.path.samestat(os.fstat(descriptor), path.stat()):
                    path.unlink()  # Windows removes no open file; filelock does there, after its release
            lock.release()


def _taken(path: Path) -> tuple[FileLock | None, int]:
    """(the lock of a file and its descriptor), or None and -1 where files cannot be locked.

    Raises WearcapError when it stays locked by another process, or is no file of its own.
    """
    found: list[int] = []

    def admit(descriptor: int) -> None:
        require_own(descriptor, path)
        found.append(descriptor)

    def given_up() -> bool:
        return time.monotonic() - start > LOCK_PATIENCE_S and not _has_ended(_holder(path))

    start, lock = time.monotonic(), FileLock(path, thread_local=False, fallback_to_soft=False, on_acquired=admit)
    try:
        lock.acquire(timeout=ORPHANS_PATIENCE_S, cancel_check=given_up)
        return lock, found[0]
    except Timeout as error:
        raise _held_by(_holder(path), path.parent) from error
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            fix = "Remove it: it is not wearcap's, and nothing was written through it."
            raise WearcapError("a link, or no regular file", path, "the lock of this folder", fix) from error
        if error.errno not in _NO_LOCKS:
            raise
        path.unlink(missing_ok=True)
        what = f"{path.parent}: this file system has no locks ({error.strerror})."
        warnings.warn(f"{what} Let no other run write into this folder meanwhile.", stacklevel=4)
        return None, -1


def _holder(path: Path) -> dict[str, Any]:
    """What a lock's file says of the process that took it; nothing while it is being written."""
    try:
        descriptor = open_own(path, os.O_RDONLY)
        with open(descriptor, encoding="utf-8") as file:
            file.seek(1)
            holder = json.loads(file.read(_MAX_HOLDER))
    except (OSError, ValueError, RecursionError):
        return {}
    return holder if isinstance(holder, dict) and isinstance(holder.get("pid"), int) else {}


def _has_ended(holder: dict[str, Any]) -> bool:
    """Whether the process that took a lock has certainly ended, while its workers still hold the lock."""
    if os.name != "posix" or holder.get("host") != platform.node() or holder.get("pid", 0) <= 0:
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
