"""What iReplica is compared with (thesis §5.4.3): objects that stand still, that are interpolated, or taken when near."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.metrics.interaction import handlings
from wearcap.recording import Motion
from wearcap.recording.interactions import Interactions
from wearcap.scene.environment import Environment
from wearcap.scene.objects import CONTACT_CLASSES
from wearcap.systems.ireplica.attachment import object_trajectories
from wearcap.systems.ireplica.object_tracker import PALMS, ObjectTracker
from wearcap.systems.ireplica.scores import poses_at

NEAR_M = 0.08
"""A palm so near to an object touches it, says the row without a contact network."""
ROUNDS = 3


def static_objects(motion: Motion, environment: Environment) -> Motion:
    """HPS: the wearer as registered, objects where they were at first."""
    return replace(motion, object_motion=object_trajectories(environment, [], motion.timestamps))


def interpolated_objects(
    motion: Motion, environment: Environment, held: Interactions, true: dict[str, Trajectory]
) -> Motion:
    """HPS w/ GT: an oracle tells when objects are handled and where they end; lines and slerp between.

    Linear in the object's origin and in the angle of the turn, from each handling's start to its end.
    """
    tracks = object_trajectories(environment, [], motion.timestamps)
    for name, start, stop in handlings(held.start_s, held.stop_s, held.objects):
        thing, times = environment.by_name(name), motion.timestamps
        old = poses_at(tracks[name], thing, times)
        ends = torch.tensor([start, stop], dtype=torch.float64)
        left = poses_at(true.get(name), thing, ends)[1].to(torch.float64)
        frame = int(torch.searchsorted(times, start).clamp(max=len(times) - 1))
        begin = old[frame].to(torch.float64)
        share = ((times - start) / max(stop - start, 1e-6)).clamp(0.0, 1.0)
        turn = rotation.log(left.R @ begin.R.mT)
        R = rotation.exp(share[:, None] * turn) @ begin.R
        t = begin.t + share[:, None] * (left.t - begin.t)
        later = times >= start
        tracks[name] = Trajectory(
            times, torch.where(later[:, None, None], R.float(), old.R.float()),
            torch.where(later[:, None], t.float(), old.t.float()),
        )  # fmt: skip
    return replace(motion, object_motion=tracks)


def held_when_near(tracker: ObjectTracker, registered: Motion, environment: Environment) -> Motion:
    """The whole method, but hands hold what is within `NEAR_M` of them: no network.

    Where objects are depends on what was held; so it goes round a few times.
    """
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
    for thing in environment.objects:
        T = poses_at(objects.get(thing.name), thing, motion.timestamps)
        for hand in range(2):
            distance, _ = environment.distance(thing.name, palms[:, hand], T)
            near = found[thing.freedom.contact_class]
            near[:, hand] = torch.maximum(near[:, hand], (distance <= NEAR_M).float())
    return found
