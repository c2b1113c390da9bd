"""What the documents compare HPS with (thesis §4.5.1): the suit alone, and the suit carried by the camera."""

from dataclasses import dataclass, replace

from wearcap.data.prepare.clean import resampled
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory, filled, interpolate
from wearcap.pipelines.hps import required
from wearcap.recording import Motion, Recording
from wearcap.scene.scan import Scan
from wearcap.sensors.alignment import align_suit, body_camera, inliers

KINDS = ("imu", "imu_cam", "imu_cam_filtered")


@dataclass(frozen=True)
class HpsBaseline:
    """A row of the documents' tables: "imu", "imu_cam" or "imu_cam_filtered"; all are aligned at the start."""

    kind: str
    fps: float = 30.0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise WearcapError(f"no baseline {self.kind!r}", expected=f"one of {', '.join(KINDS)}")

    def __call__(self, recording: Recording, scan: Scan | None = None) -> Motion:
        """The suit's pose, placed by the suit itself, by the camera, or by its path without outliers."""
        suit, localization, mount = required(recording)
        motion = align_suit(resampled(suit, self.fps), localization, mount)[0]
        motion = replace(motion, provenance={"pipeline": self.kind})
        if self.kind == "imu":
            return motion
        found = localization.confidence > 0
        use = inliers(localization) if self.kind == "imu_cam_filtered" else found
        path = filled(
            Trajectory(localization.timestamps, localization.R_world_cam, localization.t_world_cam), use
        )
        at = motion.timestamps.clamp(path.timestamps[0], path.timestamps[-1])
        camera = interpolate(path.timestamps, path.t_world_body, at)
        return replace(motion, t_world_root=motion.t_world_root + camera - body_camera(motion, mount.t))
