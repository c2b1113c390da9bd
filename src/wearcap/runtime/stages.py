"""Pipelines as cached stages: a stage's result is stored by a digest of its inputs and recomputed when they change.

A stage's key is a digest of its name, its inputs (settings, streams, files), the results of the stages that it follows,
and its code: the module that computes it, the modules of its inputs, and all that these import. A change therefore
propagates to later stages only as far as results differ.
"""

import ast
import dataclasses
import functools
import hashlib
import json
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn

from wearcap.boundary.opening import file_size, path_inside, understood
from wearcap.boundary.tensors import open_described, write_tensors
from wearcap.errors import WearcapError
from wearcap.files import sha256_of
from wearcap.recording import Motion, Recording
from wearcap.recording.serialize import KNOWN, dumps, flatten, unflatten
from wearcap.runtime.system import Captured, CaptureInput, StageOptions, System

PACKAGE = Path(__file__).parents[1]
_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, WearcapError)
"""Exceptions that reading a damaged result may raise."""


def digest(*values: Any) -> str:
    """SHA-256 of settings, tensors, containers of them, and the contents of files (`Path`).

    Objects are digested by class and attributes, networks by their weights. Raises WearcapError for a missing file and
    TypeError for values without comparable content (a lambda, an open file).
    """
    sha = hashlib.sha256()
    for part in _parts(values):
        sha.update(part)
    return sha.hexdigest()


@functools.cache
def code_digest(*modules: str) -> str:
    """Digest of the sources of some modules of this package ("wearcap.systems.hps.camera") and of all that they import.

    Modules outside the package do not count. Raises WearcapError for a module of the package that is not there.
    """
    rest, reached = sorted(modules), set(modules)
    while rest:
        new = _imports(rest.pop()) - reached
        reached |= new
        rest += sorted(new)
    return digest([(name, _source(name)) for name in sorted(reached) if _source(name) is not None])


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
        yield _unchanged_digest(value, file_size(value), value.stat().st_mtime_ns).encode()
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


@dataclass(frozen=True, eq=False)
class Stage:
    """A step of a pipeline whose result can be cached."""

    name: str
    make: Callable[[dict[str, Any]], Any]
    """Computes the result from the results of earlier stages by name."""
    reads: Callable[[], Sequence[Any]]
    """Returns all inputs other than earlier results: settings, streams, and files as paths. Called only with a
    cache."""
    after: tuple[str, ...] = ()
    """Names of the earlier stages whose results it takes."""
    kinds: tuple[type, ...] = ()
    """Classes that a cached result may contain beside those of a recording."""


@dataclass(frozen=True)
class StageCache:
    """Cached results in a folder: a .safetensors file per stage and key, laid out as a recording's."""

    folder: Path

    def read(self, stage: Stage, key: str) -> tuple[Any, str, float] | None:
        """(result, its digest, seconds), or None if it is not cached. Raises WearcapError when it is damaged."""
        if not (path := self._file(stage.name, key)).exists():
            return None
        with understood("damaged", path, errors=_DAMAGE):
            file, kept = open_described(path, "wearcap_stage", "result", "a stage")
            content = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            known = KNOWN | {kind.__name__: kind for kind in stage.kinds}
            value = unflatten(kept["result"], content.__getitem__, known).get("value")
            if digest(kept["result"], content) != kept["digest"]:
                raise ValueError("its content is not what was written")
            return value, kept["digest"], float(kept["seconds"])

    def write(self, stage: str, key: str, value: Any, seconds: float) -> str:
        """Store a result; returns its digest."""
        tree, content = flatten({"value": value})
        tree = json.loads(dumps(tree))
        found = digest(tree, content)
        kept = {"stage": stage, "key": key, "digest": found, "seconds": round(seconds, 3), "result": tree}
        write_tensors(self._file(stage, key), content, {"wearcap_stage": dumps(kept)})
        return found

    def _file(self, stage: str, key: str) -> Path:
        return self.folder / f"{stage}-{key[:16]}.safetensors"


def run_stages(
    stages: list[Stage], cache: StageCache | None = None, until: str | None = None, console: Console | None = None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Results by stage, up to and including `until`, and how each was obtained; the console shows a line for each.

    How: the `stage`, the `seconds` that computing it took (now or when it was cached), and whether it was `reused`.
    Cached results are reused; damaged ones are recomputed. Raises WearcapError for an unknown `until`.
    """
    names = [stage.name for stage in stages]
    if until is not None and until not in names:
        raise WearcapError(f"no stage {until!r}", expected=f"one of {', '.join(names)}")
    console = console or Console(quiet=True)
    results: dict[str, Any] = {}
    digests: dict[str, str] = {}
    runs = []
    for stage in stages:
        key, kept = "", None
        if cache:
            reads, followed = list(stage.reads()), [digests[name] for name in stage.after]
            key = digest(stage.name, code_digest(*modules_of([stage.make, reads])), reads, followed)
            try:
                kept = cache.read(stage, key)
            except WearcapError as error:
                damage = f"{stage.name}: {error.where} is {error.what}; it is made again"
                console.print(damage, markup=False, soft_wrap=True)
        if kept is not None:
            results[stage.name], digests[stage.name], seconds = kept
        else:
            if console.is_terminal:
                console.print(f"{stage.name} …")
            begin = time.perf_counter()
            results[stage.name] = stage.make(results)
            seconds = time.perf_counter() - begin
            if cache:
                digests[stage.name] = cache.write(stage.name, key, results[stage.name], seconds)
        runs.append({"stage": stage.name, "seconds": round(seconds, 3), "reused": kept is not None})
        console.print(f"{stage.name}: {'reused' if kept is not None else f'{seconds:.1f} s'}", highlight=False)
        if stage.name == until:
            break
    return results, runs


class StagedSystem(System):
    """A system that runs in stages, each of which can be cached; seeds have no effect."""

    draws = False

    @abstractmethod
    def stages(self, source: CaptureInput) -> list[Stage]:
        """The stages in order. Raises WearcapError when the recording lacks an input of the system."""

    @abstractmethod
    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """The motion after the stages that were run; None if there is none yet."""

    def report(self, source: CaptureInput, results: dict[str, Any]) -> dict[str, Any]:
        """Findings of the stages that were run, as plain data for JSON."""
        return {}

    def results(self, recording: Recording | CaptureInput) -> dict[str, Any]:
        """Results of all stages by name, without a cache."""
        return run_stages(self.stages(CaptureInput.of(recording)))[0]

    def capture(
        self, recordings: Sequence[Recording | CaptureInput], seeds: Sequence[int], options: StageOptions | None = None
    ) -> list[Captured]:
        """One capture per recording, with a report of its stages. Raises WearcapError as `stages` and the stages do."""
        return [self._captured(CaptureInput.of(recording), options or StageOptions()) for recording in recordings]

    def _captured(self, source: CaptureInput, options: StageOptions) -> Captured:
        name = source.recording.name
        cache = None if options.cache is None else StageCache(path_inside(options.cache, name, name))
        results, runs = run_stages(self.stages(source), cache, options.until, options.console)
        report = {"pipeline": self.name, "recording": name, "stages": runs}
        return Captured(self.motion_of(results), report | self.report(source, results))
