"""iReplica (thesis ch. 5): on top of HPS, tracks objects that the wearer moves, from contact predicted by pose alone.

The steps of the thesis in order, each a stage: those of the registration (HPS) → contacts → interact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.io.formats.environment import read_environment
from wearcap.metrics.objects import summary
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import resampled
from wearcap.runtime.needs import CAMERA, CONTACTS, LOCALIZATION, OBJECTS, SCAN, SUIT
from wearcap.runtime.stages import Stage, StagedSystem, run_stages
from wearcap.runtime.system import CaptureInput
from wearcap.scene.objects import Environment
from wearcap.scene.placement import placed_on_scan
from wearcap.systems.ireplica.contact_prediction import ContactPredictor
from wearcap.systems.ireplica.detected_contacts import DetectedContacts
from wearcap.systems.ireplica.object_tracker import ObjectTracker
from wearcap.systems.ireplica.scores import score_interactions


@dataclass(eq=False)
class IReplica(StagedSystem):
    """Captures the wearer and the objects that the wearer moves."""

    registration: StagedSystem
    """HPS, or another pipeline that registers the wearer in the scene."""
    predictor: Callable[[Motion], dict[str, Float[Tensor, "time hand"]]] | None
    """Contact probabilities by class, at a motion's frames, from its pose alone; None: `detections` are used."""
    tracker: ObjectTracker
    detections: DetectedContacts | None = None
    """Contacts that were found in the camera's pictures, in place of the predictor's."""
    environment: str | Path | None = None
    """File of the objects; None: the recording's environment."""
    place_on_scan: bool = False
    """Whether objects' initial poses and hinges are corrected by the scan (ours), where there is one."""
    fps: float = 60.0
    """Frame rate of contacts, objects and output motion, independent of the registration's."""
    name: str = "ireplica"

    pipeline = "ireplica"
    experiment = "experiment=contact_sequence, or of the contact transformers, one for each class"
    shared = ("contact_sequence",)
    joins_checkpoints = True
    required = (SUIT, CONTACTS, CAMERA, LOCALIZATION, SCAN, OBJECTS)

    @classmethod
    def trained(cls, make: Callable[..., "IReplica"], checkpoints: Sequence[str | Path], device: str) -> "IReplica":
        """`make`, the configured constructor, with the contact networks of checkpoints, one per class of interaction.

        Raises WearcapError for a checkpoint of another system.
        """
        for checkpoint in checkpoints:
            cls.require_own(checkpoint)
        return make(predictor=ContactPredictor.load(*checkpoints))

    def stages(self, source: CaptureInput) -> list[Stage]:
        """The registration's stages, `contacts`, `interact`. Raises WearcapError as those, or without environment."""
        environment = read_environment(self.environment_file(source))
        recording, before = source.recording, self.registration.stages(source)
        found = (
            None if self.detections is None else (self.detections, self.detections.file(recording), recording.camera)
        )
        return [
            *before,
            Stage(
                "contacts",
                lambda done: self.contacts(recording),
                lambda: (self.predictor, recording.suit, self.fps, found),
            ),
            Stage(
                "interact",
                lambda done: self.interact(
                    self.registration.motion_of(done), done["contacts"], self.placed(environment, source)
                ),
                lambda: (environment, source.scan if self.place_on_scan else None, self.tracker, self.fps),
                (*(stage.name for stage in before), "contacts"),
            ),
        ]

    def environment_file(self, source: CaptureInput) -> Path:
        """Path of the environment file. Raises WearcapError if neither the pipeline nor the recording names one."""
        path = source.environment_file(self.environment)
        if path is None:
            expected = "a recording that names its environment, or pipeline.environment=FILE"
            fix = "Make one with `wearcap scene`."
            raise WearcapError("no objects that can be moved", where=source.recording.name, expected=expected, fix=fix)
        return path

    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """Motion with objects after the last stage; before it, the registration's motion."""
        return results["interact"] if "interact" in results else self.registration.motion_of(results)

    def report(self, source: CaptureInput, results: dict[str, Any]) -> dict[str, Any]:
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

    def score(self, motion: Motion, source: CaptureInput, seed: int) -> Row:
        """The common scores, and means over handlings for recordings with true interactions (thesis Tables 5.1, 5.2)."""
        row, path = super().score(motion, source, seed), source.environment_file(self.environment)
        if source.recording.interactions is None or path is None:
            return row
        scores = score_interactions(motion, source.recording, read_environment(path))
        return replace(row, scores=row.scores | summary(scores.handlings))

    def registered(self, source: CaptureInput) -> Motion:
        """The wearer's motion in the scene, without objects. Raises WearcapError as the registration does."""
        results, _ = run_stages(self.registration.stages(source))
        motion = self.registration.motion_of(results)
        assert motion is not None
        return motion

    def contacts(self, recording: Recording) -> dict[str, Tensor]:
        """Contact probabilities of both hands by class, from the suit's pose alone (thesis §5.3.2), or as detected."""
        assert recording.suit is not None
        motion = resampled(recording.suit, self.fps)
        if self.detections is not None:
            return {"timestamps": motion.timestamps, **self.detections(recording, motion.timestamps)}
        assert self.predictor is not None
        return {"timestamps": motion.timestamps, **self.predictor(motion)}

    def placed(self, environment: Environment, source: CaptureInput) -> Environment:
        """The environment as the scan shows it, if that is wanted and there is a scan."""
        scan = source.read_scan() if self.place_on_scan else None
        return environment if scan is None else placed_on_scan(environment, scan)

    def interact(self, registered: Motion, contacts: dict[str, Tensor], environment: Environment) -> Motion:
        """Attach, correct, move and release objects, one contact interval after the other (thesis §5.3.1–5.3.3)."""
        motion = self.tracker(registered, contacts, environment)
        return replace(motion, provenance=motion.provenance | {"pipeline": self.name})
