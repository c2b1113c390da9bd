"""Baselines of iReplica (thesis §5.4.3): static objects, interpolated true poses of objects, contact by proximity."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.metrics.objects import handlings
from wearcap.optimize.trajectory import BentPath
from wearcap.recording import Motion, Recording
from wearcap.recording.motion import Interactions
from wearcap.recording.timing import resampled
from wearcap.scene.objects import CONTACT_CLASSES, Environment
from wearcap.sensors.initialization import align_suit, body_camera, inliers
from wearcap.systems.hps.camera import Localize, MapLocalization, Synchronization
from wearcap.systems.hps.pipeline import required
from wearcap.systems.hps.published import PlacedSuit
from wearcap.systems.ireplica.object_tracker import PALMS, ObjectTracker, object_trajectories
from wearcap.systems.ireplica.scores import poses_at

NEAR_M = 0.08
"""Distance (m) below which the row without a contact network takes a palm to touch an object."""
ROUNDS = 3
"""Number of alternations between contacts and object positions in `held_when_near`."""


def static_objects(motion: Motion, environment: Environment) -> Motion:
    """Row "HPS": the registered wearer, objects at their initial poses."""
    return replace(motion, object_motion=object_trajectories(environment, [], motion.timestamps))


def interpolated_objects(
    motion: Motion, environment: Environment, held: Interactions, true: dict[str, Trajectory]
) -> Motion:
    """Row "HPS w/ GT": true times of handlings and true final poses of objects; in between origin and rotation angle
    are interpolated linearly, from each handling's start to its end."""
    tracks = object_trajectories(environment, [], motion.timestamps)
    for name, start, stop in handlings(held.start_s, held.stop_s, held.objects):
        scene_object, times = environment.by_name(name), motion.timestamps
        old = poses_at(tracks[name], scene_object, times)
        ends = torch.tensor([start, stop], dtype=torch.float64)
        left = poses_at(true.get(name), scene_object, ends)[1].to(torch.float64)
        frame = int(torch.searchsorted(times, start).clamp(max=len(times) - 1))
        begin = old[frame].to(torch.float64)
        share = ((times - start) / max(stop - start, 1e-6)).clamp(0.0, 1.0)
        turn = rotation.log(left.R @ begin.R.mT)
        R = rotation.exp(share[:, None] * turn) @ begin.R
        t = begin.t + share[:, None] * (left.t - begin.t)
        later = times >= start
        tracks[name] = Trajectory(
            times,
            torch.where(later[:, None, None], R.float(), old.R.float()),
            torch.where(later[:, None], t.float(), old.t.float()),
        )
    return replace(motion, object_motion=tracks)


def held_when_near(tracker: ObjectTracker, registered: Motion, environment: Environment) -> Motion:
    """The whole method without a contact network: hands hold objects within `NEAR_M`. Contacts and object positions
    depend on each other and are computed alternately, `ROUNDS` times."""
    captured = static_objects(registered, environment)
    for _ in range(ROUNDS):
        near = nearness(registered, captured.object_motion or {}, environment)
        captured = tracker(registered, {"timestamps": registered.timestamps, **near}, environment)
    return captured


def nearness(
    motion: Motion, objects: dict[str, Trajectory], environment: Environment
) -> dict[str, Float[Tensor, "time hand"]]:
    """1 where a palm is within `NEAR_M` of an object of each class, else 0."""
    palms = site_positions(motion.skeleton, motion.T_world_joint, PALMS)
    found = {name: torch.zeros(len(motion), 2) for name in CONTACT_CLASSES}
    for scene_object in environment.objects:
        T = poses_at(objects.get(scene_object.name), scene_object, motion.timestamps)
        for hand in range(2):
            distance, _ = environment.distance(scene_object.name, palms[:, hand], T)
            near = found[scene_object.freedom.contact_class]
            near[:, hand] = torch.maximum(near[:, hand], (distance <= NEAR_M).float())
    return found


@dataclass(frozen=True)
class BentSuit(PlacedSuit):
    """Places the suit's motion by bending its path in the ground plane; pose and height are the suit's."""

    bend: Callable[..., BentPath]
    """`optimize.trajectory.bend` with its settings and solver."""
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
