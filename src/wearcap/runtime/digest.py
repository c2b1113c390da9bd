"""Content digests: equal values give equal digests on every machine."""

import ast
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


def code_digest(*modules: str) -> str:
    """Digest of the sources of some modules of this package ("wearcap.systems.hps.camera") and of all that they import.

    Modules outside the package do not count. Raises WearcapError for a module of the package that is not there.
    """
    return _code_digest(frozenset(modules))


def modules_of(value: Any) -> set[str]:
    """This package's modules that define the classes and functions among some values: their code decides a result, too."""
    modules: set[str] = set()
    rest = [value]
    while rest:
        part = rest.pop()
        if isinstance(part, functools.partial):
            rest += [part.func, part.args, part.keywords]
        elif isinstance(part, dict):
            rest += part.values()
        elif isinstance(part, list | tuple):
            rest += part
        elif isinstance(part, Callable) and hasattr(part, "__qualname__"):
            modules.add(part.__module__)
        elif not isinstance(part, Tensor | np.ndarray | Path) and type(part).__module__.startswith("wearcap."):
            modules.add(type(part).__module__)
            rest += list(getattr(part, "__dict__", {}).values())
    return {name for name in modules if name.startswith("wearcap.")}


@functools.cache
def _code_digest(modules: frozenset[str]) -> str:
    rest, reached = sorted(modules), set(modules)
    while rest:
        new = _imports(rest.pop()) - reached
        reached |= new
        rest += sorted(new)
    return digest([(name, _source(name)) for name in sorted(reached) if _source(name) is not None])


def _source(module: str) -> Path | None:
    """File of a module of this package; None for a name within a module."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), None)


@functools.cache
def _imports(module: str) -> frozenset[str]:
    """Names of this package that a module imports, of modules and of what they define."""
    file = _source(module)
    if file is None:
        raise WearcapError(f"no module {module!r}", where=PACKAGE, expected="one of this package")
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(name for name in found if name.startswith("wearcap.") and _source(name) is not None)


def _parts(value: Any) -> Iterator[bytes | memoryview]:
    yield f"<{type(value).__qualname__}>".encode()
    if value is None or isinstance(value, bool | int | float | str | torch.dtype):
        yield repr(value).encode()
    elif isinstance(value, Tensor | np.ndarray):
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
        yield f"{array.dtype.str}{array.shape}".encode()
        yield np.ascontiguousarray(array).data.cast("B") if array.size else b""
    elif isinstance(value, Path):
        try:
            status = value.stat()
            found = _unchanged_digest(value, status.st_size, status.st_mtime_ns)
        except FileNotFoundError as error:
            raise WearcapError("no such file", where=value) from error
        yield found.encode()
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


@functools.lru_cache(maxsize=1024)
def _unchanged_digest(path: Path, size: int, changed_ns: int) -> str:
    return sha256_of(path)
