"""Baselines of HPS (thesis §4.5.1): the suit alone, and the suit translated by the camera."""

from dataclasses import dataclass, field, replace

from wearcap.errors import require_choice
from wearcap.geometry.trajectory import Trajectory, filled, interpolate
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import resampled
from wearcap.sensors.initialization import align_suit, body_camera, inliers
from wearcap.systems.hps.camera import Localize, MapLocalization, Synchronization
from wearcap.systems.hps.pipeline import required
from wearcap.systems.ireplica.bent_suit import PlacedSuit

KINDS = ("imu", "imu_cam", "imu_cam_filtered")


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
