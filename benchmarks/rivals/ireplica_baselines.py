"""Baselines of iReplica (thesis §5.4.3): static objects, interpolated true poses of objects, contact by proximity."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.metrics.objects import handlings
from wearcap.recording import Motion
from wearcap.recording.motion import Interactions
from wearcap.scene.objects import CONTACT_CLASSES, Environment
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
