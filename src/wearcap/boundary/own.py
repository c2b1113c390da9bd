"""Which files are the user's own: formats that can run code are not for strangers.

A run's `.ckpt` and an exported `.pt2` open where they lie in `outputs/`, in the folder of a run or under the name of an export
that this user's commands wrote (kept in the user's cache folder), and elsewhere with `trust=true`.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.files import remember, remembered

TRUST = "WEARCAP_TRUST"
"""Environment variable that `trust=true` sets to 1, for worker processes too."""
OUTPUTS = Path("outputs")
_OWN = "own.jsonl"


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


def remember_own(path: str | Path) -> None:
    """Keep in mind that a file, or all in a run's folder, was written here. Without a cache folder nothing is kept."""
    if (name := str(Path(path).resolve())) not in remembered(_OWN):
        remember(_OWN, name)


def require_own(path: str | Path) -> None:
    """Raise WearcapError unless a file of a format that can run code is the user's own."""
    real = Path(path).resolve()
    if os.environ.get(TRUST) == "1" or OUTPUTS.resolve() in real.parents:
        return
    known = remembered(_OWN)
    if any(str(place) in known for place in (real, *real.parents)):
        return
    what = f"a {real.suffix or 'PyTorch'} file from elsewhere, which can run code when it is opened"
    fix = "Ask for the .safetensors or .onnx export, or give trust=true if it is your own."
    raise WearcapError(what, path, fix=fix)
