"""Which files are the user's own: formats that can run code are not for strangers.

A run's `.ckpt` and an exported `.pt2` open where they lie in `outputs/`, in the folder of a run or under the name of an export
that this user's commands wrote (kept in the user's cache folder), and elsewhere with `trust=true`.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.files import cache_folder

TRUST = "WEARCAP_TRUST"
"""Environment variable that `trust=true` sets to 1, for worker processes too."""
OUTPUTS = Path("outputs")


@contextmanager
def trusting(trust: bool) -> Iterator[None]:
    """A context in which, where `trust` is true, all files count as the user's own."""
    before = os.environ.get(TRUST)
    if trust:
        os.environ[TRUST] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(TRUST, None)
        else:
            os.environ[TRUST] = before


def _ledger() -> Path:
    return cache_folder() / "own.jsonl"


def remember_own(path: str | Path) -> None:
    """Keep in mind that a file, or all in a run's folder, was written here. Without a cache folder nothing is kept."""
    path = Path(path).resolve()
    with suppress(OSError):
        if str(path) in _known():
            return
        _ledger().parent.mkdir(parents=True, exist_ok=True)
        with open(_ledger(), "a", encoding="utf-8") as file:  # one write, so that lines of other processes do not mix
            file.write(json.dumps(str(path)) + "\n")


def _known() -> set[str]:
    known = set()
    with suppress(OSError, UnicodeDecodeError):
        for line in _ledger().read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                known.add(json.loads(line))
    return known


def require_own(path: str | Path) -> None:
    """Raise WearcapError unless a file of a format that can run code is the user's own."""
    real = Path(path).resolve()
    if os.environ.get(TRUST) == "1" or OUTPUTS.resolve() in real.parents:
        return
    if {str(real), *map(str, real.parents)} & _known():
        return
    what = f"a {real.suffix or 'PyTorch'} file from elsewhere, which can run code when it is opened"
    fix = "Ask for the .safetensors or .onnx export, or give trust=true if it is your own."
    raise WearcapError(what, path, fix=fix)
