"""ECHO on the recordings of a data set: reads their object files, captures, and scores."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from wearcap.io.formats.environment import read_environment
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording
from wearcap.recording.acts import true_acts
from wearcap.scene.environment import Environment
from wearcap.systems.echo.objects import ObjectReader
from wearcap.systems.echo.observations import Scenario
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.scores import Truth, score_echo, truth_of


@dataclass(eq=False)
class EchoOnDataset:
    """The interface that `evaluation.evaluate` expects."""

    echo: Echo
    folder: Path
    """Folder of the data set, to which the recordings' environment paths are relative."""
    _environments: dict[Path, Environment] = field(default_factory=dict, init=False)
    _reader: ObjectReader | None = field(default=None, init=False)

    def environment(self, recording: Recording) -> Environment | None:
        """The objects of a recording; each file is read once. None if the recording names no environment."""
        name = self.echo.environment or recording.environment
        if name is None:
            return None
        path = Path(name) if self.echo.environment else self.folder / name
        if path not in self._environments:
            self._environments[path] = read_environment(path)
        return self._environments[path]

    def scenario(self, recording: Recording) -> Scenario:
        """The recording with its active objects. Raises WearcapError for object files that cannot be read."""
        return self.echo.scenario(recording, self.environment(recording))

    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (recording, seed)."""
        once = {id(recording): self.scenario(recording) for recording in recordings}
        return self.echo.capture_scenarios([once[id(recording)] for recording in recordings], seeds)

    def truth(self, motion: Motion, recording: Recording) -> Truth:
        """The ground truth at a capture's frames, whichever active objects the capture was conditioned on."""
        self._reader = self._reader or self.echo.reader()
        environment = self.environment(recording)
        has_objects = environment is not None and bool(recording.object_motion)
        acts = tuple(true_acts(recording)) if has_objects else ()
        return truth_of(Scenario(recording, environment, acts), motion.timestamps, self._reader)

    def score(self, motion: Motion, recording: Recording, name: str, seed: int) -> Row:
        """ECHO's metrics of one capture."""
        return score_echo(motion, self.truth(motion, recording), name, seed)
