"""Content digests: equal values give equal digests on every machine."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.files import sha256_of

PACKAGE = Path(__file__).parents[1]


def digest(*values: Any) -> str:
    """SHA-256 of settings, tensors, containers of them, and the contents of files (`Path`).

    Objects are digested by class and attributes, networks by their weights. Raises WearcapError for a missing file and
    TypeError for values without comparable content (a lambda, an open file).
    """
    sha = hashlib.sha256()
    for part in _parts(values):
        sha.update(part)
    return sha.hexdigest()


def code_digest(*places: str) -> str:
    """Digest of this package's sources by folder or module ("sensors", "optimize/hps.py")."""
    return _code_digest(places)


@functools.cache
def _code_digest(places: tuple[str, ...]) -> str:
    files = []
    for place in places:
        path = PACKAGE / place
        found = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        files += [(file.relative_to(PACKAGE).as_posix(), file) for file in found]
    return digest(files)


def _parts(value: Any) -> Iterator[bytes | memoryview]:
    yield f"<{type(value).__qualname__}>".encode()
    if value is None or isinstance(value, bool | int | float | str | torch.dtype):
        yield repr(value).encode()
    elif isinstance(value, Tensor | np.ndarray):
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
        yield f"{array.dtype.str}{array.shape}".encode()
        yield np.ascontiguousarray(array).data.cast("B") if array.size else b""
    elif isinstance(value, Path):
        yield _file_digest(value).encode()
    elif isinstance(value, dict):
        for key in sorted(value):
            yield from _parts((key, value[key]))
    elif isinstance(value, list | tuple):
        yield str(len(value)).encode()
        for item in value:
            yield from _parts(item)
    elif isinstance(value, nn.Module):
        yield from _parts(value.state_dict())
    elif isinstance(value, functools.partial):
        yield from _parts((value.func, value.args, value.keywords))
    elif isinstance(value, Callable) and hasattr(value, "__qualname__"):
        if "<lambda>" in value.__qualname__:
            raise TypeError("a lambda has no digest: it cannot be distinguished from another one")
        yield f"{value.__module__}.{value.__qualname__}".encode()
    elif dataclasses.is_dataclass(value):
        yield from _parts({field.name: getattr(value, field.name) for field in dataclasses.fields(value)})
    elif hasattr(value, "__dict__"):
        yield from _parts(vars(value))
    else:
        raise TypeError(f"a {type(value).__name__} has no digest")


def _file_digest(path: Path) -> str:
    try:
        status = path.stat()
        return _unchanged_digest(path, status.st_size, status.st_mtime_ns)
    except FileNotFoundError as error:
        raise WearcapError("no such file", where=path) from error


@functools.lru_cache(maxsize=1024)
def _unchanged_digest(path: Path, size: int, changed_ns: int) -> str:
    return sha256_of(path)
