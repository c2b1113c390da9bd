"""The interface of every capture system, learned or optimised: what commands, evaluation, callbacks and notebooks use.

A system's folder has the same rooms by name: `pipeline.py` defines the `System`, `stream.py` its `SESSION`, `export.py`
its graphs (`exports`, `from_export`). A further system is a further folder under `systems/` with its configs.
"""

import importlib
import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

from rich.console import Console

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.environment import FILE_NAME, read_environment
from wearcap.io.formats.ply import Ply
from wearcap.io.formats.scene_folder import SURFACES, cloud_file, read_scan
from wearcap.metrics.scores import score
from wearcap.metrics.table import Row
from wearcap.models.build import target_of
from wearcap.models.checkpoint import load_trained, read_checkpoint
from wearcap.recording import Motion, Recording
from wearcap.runtime.graphs import Exports
from wearcap.scene.objects import Environment
from wearcap.scene.scan import Scan


@dataclass(frozen=True, eq=False)
class CaptureInput:
    """A recording, and the files that belong to it."""

    recording: Recording
    folder: Path | None = None
    """Folder of the data set, to which the recording's file names are relative; None: the recording has no files."""
    scan: Path | Scan | None = None
    """The scene's point cloud, or its file."""
    metres_per_unit: float | int | None = None
    """Unit of that file (m); None: metres."""

    @classmethod
    def of(cls, recording: "Recording | CaptureInput") -> "CaptureInput":
        """A recording without files as a source; a source is returned as it is."""
        return recording if isinstance(recording, CaptureInput) else cls(recording)

    @classmethod
    def in_dataset(
        cls,
        recording: Recording,
        folder: Path,
        scene: str | Path | None = None,
        metres_per_unit: float | int | None = None,
    ) -> "CaptureInput":
        """A recording of a data set, with the scan that it names, or that of another scene (its folder or cloud).

        Raises WearcapError when the given scene has no point cloud.
        """
        named = folder / recording.scene if recording.scene else None
        return cls(recording, folder, named if scene is None else cloud_file(Path(scene)), metres_per_unit)

    def read_scan(self) -> Scan | None:
        """The scene's point cloud (m). Raises WearcapError for a file that cannot be read."""
        if isinstance(self.scan, Path):
            unit = None if self.metres_per_unit is None else float(self.metres_per_unit)
            return read_scan(self.scan, metres_per_unit=unit)
        return self.scan

    def read_surface(self) -> Mesh | None:
        """The scene (m) with its triangles where its file has them, else its points, without faces.

        Raises WearcapError for a file that cannot be read.
        """
        if self.scan is None:
            return None
        if isinstance(self.scan, Path) and self.metres_per_unit is None and self.scan.suffix.lower() in SURFACES:
            return SURFACES[self.scan.suffix.lower()](self.scan)
        scan = self.read_scan()
        return None if scan is None else Ply(scan.points, scan.colors).mesh

    def environment_file(self, given: str | Path | None = None) -> Path | None:
        """File of the objects: the given one (or in the given folder), else the one that the recording names."""
        if given is not None:
            path = Path(given)
            return path / FILE_NAME if path.is_dir() else path
        if self.folder is None or self.recording.environment is None:
            return None
        return self.folder / self.recording.environment

    def objects(self, given: str | Path | None = None) -> Environment | None:
        """The objects of `environment_file`; None where the recording names none, or its file is missing."""
        path = self.environment_file(given)
        return read_environment(path) if path is not None and (given is not None or path.is_file()) else None


@dataclass(frozen=True, eq=False)
class Captured:
    """What a system returns for one recording."""

    motion: Motion | None
    """None if a stage before the motion was the last one to run."""
    report: dict[str, Any] | None = None
    """Findings of the stages, or notes on the input, as plain data for JSON; None where there are none."""


@dataclass(frozen=True, eq=False)
class StageOptions:
    """How the stages of a system are run."""

    cache: Path | None = None
    """Folder in which results are kept, a folder per recording; None: nothing is kept."""
    until: str | None = None
    """Name of the last stage to run; None: all are run."""
    console: Console | None = None
    """Where a line per stage is shown; None: nowhere."""


class System(ABC):
    """Turns recordings into motion."""

    name: str
    """Name in tables and in a motion's provenance."""
    environment: str | Path | None = None
    """File of the objects; None: the file that each recording names."""
    pipeline: ClassVar[str | None] = None
    """Config (pipeline=…) that runs the system's checkpoints unless another one is chosen; None: it has no network."""
    experiment: ClassVar[str | None] = None
    """Experiments that train the network, as the command line names them; None: the system has no network."""
    shared: ClassVar[tuple[str, ...]] = ()
    """Shared checkpoints of the networks, which `wearcap.load` takes unless others are given."""
    joins_checkpoints: ClassVar[bool] = False
    """Whether several checkpoints make one system; otherwise each of them makes its own."""
    sampled: ClassVar[str | None] = None
    """Config (pipeline=…) whose `sampling` draws one of the plausible motions for each seed, in place of their mean; None:
    there is none."""
    draws: ClassVar[bool] = True
    """Whether captures depend on the seed."""
    required: ClassVar[tuple[Any, ...]] = ()
    """Inputs of a recording that the system needs or profits from (`runtime.needs.Need`)."""
    baselines: ClassVar[tuple[str, ...]] = ()
    """Names of the trivial methods that an evaluation scores beside the system (`evaluation.baselines`)."""

    @classmethod
    def trained(cls, make: Callable[..., "System"], checkpoints: Sequence[str | Path], device: str) -> "System":
        """`make`, the configured constructor, with the network of a checkpoint.

        Raises WearcapError for a checkpoint that this system did not train.
        """
        cls.require_own(checkpoints[0])
        module, _ = load_trained(checkpoints[0])
        return make(**module.pipeline_parts(), device=device)

    @classmethod
    def require_own(cls, checkpoint: str | Path) -> None:
        """Raise WearcapError unless a checkpoint is of this system; it names the pipeline that runs the checkpoint."""
        training, owner = training_of(checkpoint)
        if owner is cls:
            return
        runs = None if owner is None else owner.pipeline
        fix = "" if runs is None else f"Leave pipeline=… out, or give pipeline={runs}."
        what = f"{cls.__name__} cannot run {training}'s network"
        raise WearcapError(what, where=checkpoint, expected=f"a checkpoint of {cls.experiment}", fix=fix)

    @abstractmethod
    def capture(
        self, recordings: Sequence[Recording | CaptureInput], seeds: Sequence[int], options: StageOptions | None = None
    ) -> list[Captured]:
        """One capture per recording and seed. Raises WearcapError when a recording lacks an input of the system."""

    def __call__(self, recording: Recording | CaptureInput, seed: int = 0) -> Motion:
        """Motion of one recording. Raises WearcapError as `capture` does."""
        motion = self.capture([recording], [seed])[0].motion
        assert motion is not None
        return motion

    def score(self, motion: Motion, source: CaptureInput, seed: int) -> Row:
        """The paper's metrics of one capture. Raises WearcapError for a recording without a true motion."""
        return score(motion, source.recording, source.recording.name, seed)

    def objects(self, source: CaptureInput) -> Environment | None:
        """The objects that a motion is shown with; None where there are none."""
        return source.objects(self.environment)

    def stream(self, *args: Any, **kwargs: Any) -> Any:
        """A streaming capture of one or several wearers: the `runtime.session.Session` of the system's `stream.py`."""
        return self.session_class()(self, *args, **kwargs)

    def session_class(self) -> Any:
        """Class of `stream`'s session, a `runtime.session.Session`. Raises WearcapError for a system without streams."""
        return self._room("stream", "captures streams").SESSION

    @property
    def latency_s(self) -> float:
        """Longest time (s) from a frame to its final pose in a stream, without computation.

        Raises WearcapError for a system that does not stream.
        """
        raise WearcapError(f"pipeline {self.name!r} is none that captures streams", fix="Choose another pipeline=….")

    def exports(self) -> Exports:
        """The networks as graphs for ONNX and torch.export. Raises WearcapError for a system without any."""
        return self._room("export", "has a network to export").exports(self)

    def needs(self) -> tuple[Any, ...]:
        """`required`, as far as this configured system uses it."""
        return self.required

    def _room(self, name: str, ability: str) -> ModuleType:
        package, _, module = type(self).__module__.rpartition(".")
        if module != "pipeline" or importlib.util.find_spec(f"{package}.{name}") is None:
            raise WearcapError(f"pipeline {self.name!r} is none that {ability}", fix="Choose another pipeline=….")
        return importlib.import_module(f"{package}.{name}")


def training_of(checkpoint: str | Path) -> tuple[str, type[System] | None]:
    """(name of the class that trained a checkpoint, the system that captures with its network).

    The training says which system that is; None: no system captures with that network alone. Raises WearcapError as
    `read_checkpoint` does.
    """
    target = read_checkpoint(checkpoint)[0]["model"].get("_target_")
    training = None if target is None else target_of(target)
    return getattr(training, "__name__", "another model"), getattr(training, "system", None)


Refine = Callable[[Motion, CaptureInput], Captured]
"""A step that improves a captured motion by what its recording holds, such as `systems.hps.refining.HpsRefinement`."""


@dataclass(eq=False)
class LearnedSystem(System):
    """A system around one trained network."""

    refine: Refine | None = field(default=None, kw_only=True)
    """Step after the network's motion of whole recordings (refine=hps); None: the motion stays as it is."""

    baselines = ("mean pose", "nearest window")

    @abstractmethod
    def motions(self, sources: Sequence[CaptureInput], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording and seed. Raises WearcapError when a recording lacks an input of the network."""

    def capture(
        self, recordings: Sequence[Recording | CaptureInput], seeds: Sequence[int], options: StageOptions | None = None
    ) -> list[Captured]:
        """One capture per recording and seed; recordings share batches, which does not change the results.

        Raises WearcapError as `motions` does, and for options of stages, which a network does not have.
        """
        options = options or StageOptions()
        if options.until is not None or options.cache is not None:
            what = f"until={options.until} cache={options.cache}"
            raise WearcapError(what, expected="a pipeline with stages, such as pipeline=hps")
        once = {id(recording): CaptureInput.of(recording) for recording in recordings}
        motions = self.motions([once[id(recording)] for recording in recordings], seeds)
        notes = [motion.provenance.get("note") for motion in motions]
        found = [Captured(motion, {"notes": [note]} if note else None) for motion, note in zip(motions, notes)]
        if self.refine is None:
            return found
        return [_refined(self.refine, each, once[id(recording)]) for each, recording in zip(found, recordings)]

    def session_class(self) -> Any:
        """As of `System`. Raises WearcapError with a refinement, too, which needs the whole recording."""
        if self.refine is not None:
            raise WearcapError("a stream with refine=…, which needs whole recordings", fix="Leave refine=… out.")
        return super().session_class()


def _refined(refine: Refine, captured: Captured, source: CaptureInput) -> Captured:
    """A capture after its refinement, with the reports of both."""
    assert captured.motion is not None
    refined = refine(captured.motion, source)
    return Captured(refined.motion, (captured.report or {}) | (refined.report or {}))
