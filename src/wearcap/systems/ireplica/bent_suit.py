"""The thesis's registration of iReplica (§5.3.1): the suit's path is bent to the camera positions."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from wearcap.geometry import rotation
from wearcap.geometry.trajectory import interpolate
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
from wearcap.systems.ireplica.trajectory import BentPath


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
class BentSuit(PlacedSuit):
    """Places the suit's motion by bending its path in the ground plane; pose and height are the suit's."""

    bend: Callable[..., BentPath]
    """`systems.ireplica.trajectory.bend` with its settings and solver."""
    fps: float = 30.0
    name: str = "bent_suit"
    synchronization: Synchronization = field(default_factory=Synchronization)
    localization: Localize = field(default_factory=MapLocalization)

    def place(self, recording: Recording) -> Motion:
        """Compute F_tr(l, p) of eq. 5.2; p are root positions from the localised camera positions, without outliers."""
        suit, localization, T_head_cam = required(recording)
        motion = align_suit(resampled(suit, self.fps), localization, T_head_cam)[0]
        first, last = motion.timestamps[0], motion.timestamps[-1]
        use = inliers(localization) & (localization.timestamps >= first) & (localization.timestamps <= last)
        times = localization.timestamps[use].contiguous()
        carried = body_camera(motion, T_head_cam.t) - motion.t_world_root
        points = localization.t_world_cam[use] - interpolate(motion.timestamps, carried, times)
        path = motion.t_world_root[:, :2].double()
        bent = self.bend(path, motion.timestamps, times, points[:, :2].double(), localization.confidence[use].double())
        R = motion.R_parent_joint.clone()
        R[:, 0] = rotation.about_axis("z", bent.frame_turn.to(R)) @ R[:, 0]
        root = torch.cat([bent.path.to(motion.t_world_root), motion.t_world_root[:, 2:]], 1)
        return replace(motion, R_parent_joint=R, t_world_root=root, provenance={"pipeline": self.name})
