"""Two simulated wearers of one session: one world, one clock, face to face when it begins.

The second is placed in front of the first after both were simulated, so walking may lead them through each other,
walls and furniture: by default they stay where they are.
"""

from dataclasses import replace

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording.recording import Recording
from wearcap.sensors.keypoints import action_camera
from wearcap.simulation.people.wearer import SimulatedMotion, simulate_motion
from wearcap.simulation.recordings.simulate import OUTDOOR_SHARE, POOLS, SimulationConfig, person_of, sense, world_of

STAYING = ("stand", "gesture", "look_around")
"""Activities on the spot."""
CAMERA_FPS = 30.0


def simulate_two_wearers(
    config: SimulationConfig, name: str, split: str, seed: int, distance_m: float = 2.5
) -> tuple[Recording, Recording]:
    """Recordings NAME-a and NAME-b of the session NAME, of two people of the split; each wears an action camera.

    Raises WearcapError when the cameras are to film, which is for one wearer alone.
    """
    if config.camera:
        raise WearcapError("cameras that film two wearers", expected="camera=false")
    rng = np.random.default_rng([seed, sum(map(ord, split)), 2])
    subjects, locations = POOLS[split]
    people = [person_of(split, int(number)) for number in rng.choice(subjects, 2, replace=False)]
    number, kind = int(rng.integers(locations)), "outdoor" if rng.uniform() < OUTDOOR_SHARE else "flat"
    world = world_of(split, number, config.world or kind)
    activities = config.activities or STAYING
    first, second = (
        simulate_motion(world, person, rng, config.duration_s, config.fps, list(activities)) for person in people
    )
    both = (first, face_to_face(first, second, distance_m))
    recordings = []
    for letter, person, simulated in zip("ab", people, both):
        every = max(1, round(config.fps / CAMERA_FPS))
        recording = sense(config, f"{name}-{letter}", world, person, simulated, rng)
        camera = action_camera(simulated.motion.timestamps[::every].contiguous())
        recordings.append(replace(recording, session=name, camera=camera))
    return recordings[0], recordings[1]


def face_to_face(first: SimulatedMotion, second: SimulatedMotion, distance_m: float) -> SimulatedMotion:
    """The second motion, turned and shifted as a whole so that it faces the first in its first frame, on its floor."""
    a, b = first.motion, second.motion
    ahead, heading = (rotation.yaw_of(motion.R_parent_joint[0, 0]) for motion in (a, b))
    R = rotation.about_axis("z", ahead + torch.pi - heading)
    place = a.t_world_root[0] + distance_m * torch.stack([ahead.cos(), ahead.sin(), torch.zeros(())])
    rise = first.floor_height[0] - second.floor_height[0]
    place = torch.stack([place[0], place[1], b.t_world_root[0, 2] + rise])
    moved = b.moved(Rigid(R, place - R @ b.t_world_root[0]))
    return replace(second, motion=moved, floor_height=second.floor_height + rise)
