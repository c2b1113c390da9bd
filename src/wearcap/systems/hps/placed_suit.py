"""A suit's motion that is placed in the scene in one step after the first two of HPS, without optimisation."""

from abc import abstractmethod
from typing import Any

from wearcap.recording import Motion, Recording
from wearcap.runtime.stages import Stage, StagedSystem
from wearcap.runtime.system import CaptureInput
from wearcap.systems.hps.camera import Localize, Synchronization, camera_report, camera_stages, on_one_clock
from wearcap.systems.hps.pipeline import mount, require


class PlacedSuit(StagedSystem):
    """A pipeline that places the suit's motion in the scene in one step after the first two of HPS."""

    fps: float
    synchronization: Synchronization
    localization: Localize

    @abstractmethod
    def place(self, recording: Recording) -> Motion:
        """The suit's motion in the scene."""

    def stages(self, source: CaptureInput) -> list[Stage]:
        """The first two stages of HPS, then `place`. Raises WearcapError as HPS does."""
        recording = source.recording
        require(recording, "suit", "camera")
        own = {key: value for key, value in vars(self).items() if key not in ("synchronization", "localization")}
        return [
            *camera_stages(source, self.synchronization, self.localization),
            Stage(
                "place",
                lambda done: self.place(on_one_clock(recording, done)),
                lambda: (own, recording.suit, *mount(recording)),
                ("synchronize", "localize"),
            ),
        ]

    def motion_of(self, results: dict[str, Any]) -> Motion | None:
        """The motion, once it has been placed."""
        return results.get("place")

    def report(self, source: CaptureInput, results: dict[str, Any]) -> dict[str, Any]:
        """Clock and share of localised frames."""
        return camera_report(results)
