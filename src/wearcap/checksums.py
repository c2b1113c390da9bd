"""SHA-256 of files, computed once per file and remembered by its size, time and inode.

The cache is in the user's cache folder, so that a data set is hashed when it is first used and not again by every
process that opens it. A file whose bytes change without its time changing (a failing disk) is detected by
`wearcap doctor`, which rehashes every file.
"""

import json
import os
import time
from functools import cache
from pathlib import Path

from wearcap.files import sha256_of

SETTLED_S = 2.0
"""Age (s) below which files are hashed every time: a file system's clock may not separate two writes."""
MAX_LEDGER_BYTES = 1 << 26
"""Size (64 MiB, some 300,000 files) beyond which the cache is cleared."""

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
        _append(key, digest)
    return digest


def cache_folder() -> Path:
    """Folder of data that can be recomputed: $WEARCAP_CACHE, else `wearcap` in the user's cache folder."""
    if chosen := os.environ.get("WEARCAP_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wearcap"


def _key(path: Path) -> Key:
    found = path.stat()
    return str(path.resolve()), found.st_size, found.st_mtime_ns, found.st_ino


def _ledger_path() -> Path:
    return cache_folder() / "sha256.jsonl"


@cache
def _ledger() -> dict[Key, str]:
    """Digests cached by earlier processes; truncated or foreign lines are ignored."""
    known: dict[Key, str] = {}
    path = _ledger_path()
    try:
        if path.stat().st_size > MAX_LEDGER_BYTES:
            path.unlink()
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                name, size, mtime_ns, inode, digest = json.loads(line)
                known[(name, size, mtime_ns, inode)] = digest
            except (ValueError, TypeError):
                continue
    except (OSError, UnicodeDecodeError):
        return known
    return known


def _append(key: Key, digest: str) -> None:
    """Append a line in one write, so that lines of other processes do not mix with it; without a cache folder, only memory."""
    try:
        path = _ledger_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file:
            file.write((json.dumps([*key, digest]) + "\n").encode())
    except OSError:
        return
