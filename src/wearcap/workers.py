"""Worker processes that end with the process that started them, however that one ends.

Imports nothing but the standard library, so that a worker is bound to its parent before it has loaded anything else.
"""

import ctypes
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from multiprocessing import reduction
from typing import Any

POLL_S = 0.2
"""Interval (s) at which a worker checks for its parent if the system does not end it by itself."""

_PR_SET_PDEATHSIG = 1
"""Constant of linux/prctl.h."""


class _Inherited:
    """A file descriptor that a worker process inherits if this object is among its start arguments."""

    def __init__(self, descriptor: int | None):
        self.descriptor = descriptor

    def __reduce__(self):
        shared = None if self.descriptor is None or os.name != "posix" else reduction.DupFd(self.descriptor)
        return _inherited, (shared,)


def _inherited(shared: Any) -> _Inherited:
    return _Inherited(None if shared is None else shared.detach())


def bound_to_this_process(lock: int | None) -> dict[str, Any]:
    """Values of loky's `initializer` and `initargs` for workers that end with this process.

    Until they end, they hold `lock` (`wearcap.locks.folder_lock`). The pool must be shut down before the thread
    that uses it ends: Linux ends a worker with the thread that started it.
    """
    return {"initializer": _end_with_parent, "initargs": (os.getpid(), _Inherited(lock))}


def _end_with_parent(parent: int, lock: _Inherited | None = None) -> None:
    """In a worker: end at once when the parent has ended, whatever this process is doing.

    Linux kills it, even within native code. Elsewhere a thread checks for the parent every `POLL_S`; native code that
    holds Python's lock delays it.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.name == "posix" and os.getppid() != parent:
        os._exit(1)  # the parent ended before prctl was called
    if sys.platform != "linux":
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    if sys.platform == "win32":
        import _winapi

        synchronize = 0x00100000
        with suppress(OSError):  # it has ended already
            _winapi.WaitForSingleObject(_winapi.OpenProcess(synchronize, False, parent), _winapi.INFINITE)
    else:
        while os.getppid() == parent:
            time.sleep(POLL_S)
    os._exit(1)
