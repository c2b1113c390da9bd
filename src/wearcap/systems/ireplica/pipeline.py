"""iReplica (thesis ch. 5): on top of HPS, tracks objects that the wearer moves, from contact predicted by pose alone.

The steps of the thesis in order, each a stage: those of the registration (HPS) → contacts → interact.
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
    """HPS, or another pipeline that registers the wearer in the scene."""
    predictor: Predictor
    tracker: ObjectTracker
    environment: str | Path | None = None
    """File of the objects; None: the recording's environment."""
    fps: float = 60.0
    """Frame rate of contacts, objects and output motion, independent of the registration's."""
    name: str = "ireplica"

    def __call__(self, recording: Recording, scan: Scan | None = None, folder: Path = Path()) -> Motion:
        """Return the wearer's motion with `object_motion` and `interactions` at `fps`. Raises WearcapError as
        `stages`."""
        results, _ = run_stages(self.stages(Source(recording, folder, scan)))
        return results["interact"]

    def stages(self, source: Source) -> list[Stage]:
        """The registration's stages, then `contacts` and `interact`. Raises WearcapError as those, and without
        environment."""
        environment = read_environment(self.environment_file(source))
        suit = source.recording.suit
        before = self.registration.stages(source)
        return [
            *before,
            Stage("contacts", lambda done: self.contacts(suit), lambda: (self.predictor, suit, self.fps)),
            Stage(
                "interact",
                lambda done: self.interact(self.registration.motion_of(done), done["contacts"], environment),
                lambda: (environment, self.tracker, self.fps),
                (*(stage.name for stage in before), "contacts"),
            ),
        ]

    def environment_file(self, source: Source) -> Path:
        """Path of the environment file. Raises WearcapError if neither the pipeline nor the recording names one."""
        if self.environment is not None:
            path = Path(self.environment)
            return path / FILE_NAME if path.is_dir() else path
        if source.recording.environment is None:
            raise WearcapError(
                "no objects that can be moved",
                where=source.recording.name,
                expected="a recording that names its environment, or pipeline.environment=FILE",
                fix="Make one with `wearcap scene`.",
            )
        return source.folder / source.recording.environment

    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """Motion with objects after the last stage; before it, the registration's motion."""
        return results["interact"] if "interact" in results else self.registration.motion_of(results)

    def report(self, source: Source, results: dict[str, Any]) -> dict[str, Any]:
        """The registration's report, and the list of interactions."""
        about = self.registration.report(source, results)
        if "interact" in results:
            found = results["interact"].interactions
            rows = zip(found.start_s.tolist(), found.stop_s.tolist(), found.hands.tolist(), found.objects)
            about["interactions"] = [
                {"start_s": start, "stop_s": stop, "left": hands[0], "right": hands[1], "object": name}
                for start, stop, hands, name in rows
            ]
        return about

    def registered(self, source: Source) -> Motion:
        """The wearer's motion in the scene, without objects. Raises WearcapError as the registration does."""
        results, _ = run_stages(self.registration.stages(source))
        motion = self.registration.motion_of(results)
        assert motion is not None
        return motion

    def contacts(self, suit: Motion) -> dict[str, Tensor]:
        """Contact probabilities of both hands by class, from the suit's pose alone (thesis §5.3.2)."""
        motion = resampled(suit, self.fps)
        return {"timestamps": motion.timestamps, **self.predictor(motion)}

    def interact(self, registered: Motion, contacts: dict[str, Tensor], environment: Environment) -> Motion:
        """Attach, correct, move and release objects, one contact interval after the other (thesis §5.3.1–5.3.3)."""
        motion = self.tracker(registered, contacts, environment)
        return replace(motion, provenance=motion.provenance | {"pipeline": self.name})
