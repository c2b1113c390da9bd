"""Baselines of HPS (thesis §4.5.1): the suit alone, and the suit translated by the camera."""

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

from wearcap.errors import require_choice
from wearcap.geometry.trajectory import Trajectory, filled, interpolate
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import resampled
from wearcap.runtime.stages import Stage, StagedSystem
from wearcap.runtime.system import CaptureInput
from wearcap.sensors.initialization import align_suit, body_camera, inliers
from wearcap.systems.hps.camera import (
    Localize,
    MapLocalization,
    Synchronization,
    camera_report,
    camera_stages,
    on_one_clock,
)
from wearcap.systems.hps.pipeline import mount, require, required

KINDS = ("imu", "imu_cam", "imu_cam_filtered")


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


@dataclass(frozen=True)
class HpsBaseline(PlacedSuit):
    """A baseline row of thesis Tables 4.1–4.3: "imu", "imu_cam" or "imu_cam_filtered", all aligned at the start."""

    kind: str
    fps: float = 30.0
    synchronization: Synchronization = field(default_factory=Synchronization)
    localization: Localize = field(default_factory=MapLocalization)

    def __post_init__(self):
        require_choice(self.kind, KINDS, f"no baseline {self.kind!r}")

    @property
    def name(self) -> str:
        return self.kind

    def place(self, recording: Recording) -> Motion:
        """The suit's motion in the scene."""
        suit, localization, T_head_cam = required(recording)
        motion = align_suit(resampled(suit, self.fps), localization, T_head_cam)[0]
        motion = replace(motion, provenance={"pipeline": self.kind})
        if self.kind == "imu":
            return motion
        found = localization.confidence > 0
        use = inliers(localization) if self.kind == "imu_cam_filtered" else found
        path = filled(Trajectory(localization.timestamps, localization.R_world_cam, localization.t_world_cam), use)
        at = motion.timestamps.clamp(path.timestamps[0], path.timestamps[-1])
        camera = interpolate(path.timestamps, path.t_world_body, at)
        return replace(motion, t_world_root=motion.t_world_root + camera - body_camera(motion, T_head_cam.t))
