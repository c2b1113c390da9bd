"""iReplica (thesis ch. 5): the wearer of HPS moves doors, sofas and tables, told by contact from pose alone.

The document's steps in order, each a stage: those of the registration (HPS) → contacts → interact.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.io.formats.environment import FILE_NAME, read_environment
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import resampled
from wearcap.runtime.stages import Source, Stage, StagedPipeline, run_stages
from wearcap.scene.environment import Environment
from wearcap.scene.scan import Scan
from wearcap.systems.ireplica.object_tracker import ObjectTracker

Predictor = Callable[[Motion], dict[str, Float[Tensor, "time hand"]]]
"""Contact probabilities by class, at a motion's frames, from its pose alone."""


@dataclass(eq=False)
class IReplica:
    """Captures the wearer and the objects that the wearer moves."""

    registration: StagedPipeline
    """HPS, or another that puts the wearer into the scene."""
    predictor: Predictor
    tracker: ObjectTracker
    environment: str | Path | None = None
    """File of the objects; None: the one that the recording names."""
    fps: float = 60.0
    """Of contacts, objects and motion, whatever HPS runs at."""
    name: str = "ireplica"

    def __call__(self, recording: Recording, scan: Scan | None = None, folder: Path = Path()) -> Motion:
        """The wearer's motion with `object_motion` and `interactions` at `fps`. Raises WearcapError as `stages`."""
        results, _ = run_stages(self.stages(Source(recording, folder, scan)))
        return results["interact"]

    def stages(self, source: Source) -> list[Stage]:
        """HPS' steps, then contacts and interactions. Raises WearcapError as those do, and without an environment."""
        environment = read_environment(self.environment_file(source))
        suit = source.recording.suit
        before = self.registration.stages(source)
        return [
            *before,
            Stage(
                "contacts", lambda done: self.contacts(suit), lambda: (self.predictor, suit, self.fps),
            ),
            Stage(
                "interact", lambda done: self.interact(self.registration.motion_of(done), done["contacts"], environment),
                lambda: (environment, self.tracker, self.fps),
                (*(stage.name for stage in before), "contacts"),
            ),
        ]  # fmt: skip

    def environment_file(self, source: Source) -> Path:
        """Where the objects are described. Raises WearcapError where neither pipeline nor recording says it."""
        if self.environment is not None:
            path = Path(self.environment)
            return path / FILE_NAME if path.is_dir() else path
        if source.recording.environment is None:
            raise WearcapError("no objects that can be moved", where=source.recording.name,
                               expected="a recording that names its environment, or pipeline.environment=FILE",
                               fix="Make one with `wearcap scene`.")  # fmt: skip
        return source.folder / source.recording.environment

    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """With objects after the last stage; before it, the registration's."""
        return results["interact"] if "interact" in results else self.registration.motion_of(results)

    def report(self, source: Source, results: dict[str, Any]) -> dict[str, Any]:
        """The registration's report, and what was held when."""
        about = self.registration.report(source, results)
        if "interact" in results:
            held = results["interact"].interactions
            rows = zip(held.start_s.tolist(), held.stop_s.tolist(), held.hands.tolist(), held.objects)
            about["interactions"] = [
                {"start_s": start, "stop_s": stop, "left": hands[0], "right": hands[1], "object": name}
                for start, stop, hands, name in rows
            ]
        return about

    def registered(self, source: Source) -> Motion:
        """The wearer's motion in the scene, objects at rest. Raises WearcapError as the registration does."""
        results, _ = run_stages(self.registration.stages(source))
        motion = self.registration.motion_of(results)
        assert motion is not None
        return motion

    def contacts(self, suit: Motion) -> dict[str, Tensor]:
        """Contact probabilities of both hands by class, from the suit's pose alone (thesis §5.3.2)."""
        motion = resampled(suit, self.fps)
        return {"timestamps": motion.timestamps, **self.predictor(motion)}

    def interact(self, registered: Motion, contacts: dict[str, Tensor], environment: Environment) -> Motion:
        """Attach, correct, move and release, one interval after the other (thesis §5.3.1–5.3.3)."""
        motion = self.tracker(registered, contacts, environment)
        return replace(motion, provenance=motion.provenance | {"pipeline": self.name})
