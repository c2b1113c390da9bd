"""Pipelines as cached stages: a stage's result is stored by a digest of its inputs and recomputed when they change.

A stage's key is a digest of its name, its inputs (settings, streams, files), the results of the stages that it follows,
and its code: the module that computes it, the modules of its inputs, and all that these import. A change therefore
propagates to later stages only as far as results differ.
"""

import json
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
from rich.console import Console
from safetensors.torch import load, save

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.optimize.hps import HpsState, Solution
from wearcap.recording import Motion, Recording
from wearcap.recording.serialize import KNOWN, dumps, flatten, unflatten
from wearcap.runtime.digest import code_digest, digest, modules_of
from wearcap.runtime.system import Captured, CaptureInput, StageOptions, System
from wearcap.sensors.clock import Clock
from wearcap.sensors.initialization import Initialization

RESULTS = KNOWN | {cls.__name__: cls for cls in (Clock, Initialization, Solution, HpsState)}
"""Classes that a cached result may contain."""


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


@dataclass(frozen=True)
class _StageRun:
    """How a stage's result was obtained."""

    stage: str
    seconds: float
    """Time that computing it took, now or when it was cached."""
    reused: bool


@dataclass(frozen=True)
class StageCache:
    """Cached results in a folder: a .safetensors file per stage and key, and a .json file that is written last."""

    folder: Path

    def read(self, stage: str, key: str) -> tuple[Any, str, float] | None:
        """(result, its digest, seconds), or None if it is not cached. Raises WearcapError when it is damaged."""
        note, tensors = self._files(stage, key)
        try:
            kept = json.loads(note.read_text(encoding="utf-8"))
            content = load(tensors.read_bytes())
            value = unflatten(kept["result"], content.__getitem__, RESULTS).get("value")
            found, seconds = digest(kept["result"], content), float(kept["seconds"])
            expected = kept["digest"]
        except FileNotFoundError:
            if not note.exists():
                return None
            raise WearcapError("incomplete", where=tensors) from None
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
            WearcapError,
            safetensors.SafetensorError,
        ) as error:
            raise WearcapError(f"damaged ({error})", where=note) from error
        if found != expected:
            raise WearcapError("damaged (its content is not what was written)", where=tensors)
        return value, found, seconds

    def write(self, stage: str, key: str, value: Any, seconds: float) -> str:
        """Store a result; returns its digest."""
        note, tensors = self._files(stage, key)
        tree, content = flatten({"value": value})
        tree = json.loads(dumps(tree))
        found = digest(tree, content)
        kept = {"stage": stage, "key": key, "digest": found, "seconds": round(seconds, 3), "result": tree}
        with atomic_path(tensors) as temporary:
            temporary.write_bytes(save(content))
        write_text(note, json.dumps(kept, indent=1) + "\n")
        return found

    def _files(self, stage: str, key: str) -> tuple[Path, Path]:
        return tuple(self.folder / f"{stage}-{key[:16]}{ending}" for ending in (".json", ".safetensors"))  # pyright: ignore[reportReturnType]


def run_stages(
    stages: list[Stage], cache: StageCache | None = None, until: str | None = None, console: Console | None = None
) -> tuple[dict[str, Any], list[_StageRun]]:
    """Results by stage, up to and including `until`, and how each was obtained; the console shows a line for each.

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
        key = _key(stage, digests) if cache else ""
        kept = _kept(stage, key, cache, console)
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
        runs.append(_StageRun(stage.name, round(seconds, 3), kept is not None))
        console.print(f"{stage.name}: {'reused' if kept is not None else f'{seconds:.1f} s'}", highlight=False)
        if stage.name == until:
            break
    return results, runs


def _key(stage: Stage, digests: dict[str, str]) -> str:
    followed = [digests[name] for name in stage.after]
    reads = list(stage.reads())
    return digest(stage.name, code_digest(*modules_of([stage.make, reads])), reads, followed)


def _kept(stage: Stage, key: str, cache: StageCache | None, console: Console) -> tuple[Any, str, float] | None:
    if cache is None:
        return None
    try:
        return cache.read(stage.name, key)
    except WearcapError as error:
        console.print(f"{stage.name}: {error.where} is {error.what}; it is made again", markup=False, soft_wrap=True)
        return None


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
        cache = None if options.cache is None else StageCache(options.cache / name)
        results, runs = run_stages(self.stages(source), cache, options.until, options.console)
        report = {"pipeline": self.name, "recording": name, "stages": [vars(run) for run in runs]}
        return Captured(self.motion_of(results), report | self.report(source, results))
