"""Simulated recordings of two wearers who face each other.

They share a session, its world and its clock. The second is placed in front of the first after both were simulated, so
walking may lead them through each other, walls and furniture: by default they stay where they are.
"""

from dataclasses import replace

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearsim.people.wearer import simulate_motion
from wearsim.recordings.simulate import POOLS, SimulationConfig, drawn_world, person_of, seeded, sensed_recording
from wearsim.sensors.keypoints import action_camera

STAYING = ("stand", "gesture", "look_around")
"""Activities on the spot."""
ACTION_CAMERA_FPS = 30.0


def simulate_two_wearers(
    config: SimulationConfig, name: str, split: str, seed: int, distance_m: float = 2.5
) -> tuple[Recording, Recording]:
    """Recordings NAME-a and NAME-b of the session NAME, of two people of the split; each wears an action camera.

    They face each other in the first frame. Raises WearcapError when the cameras are to film, which is for one wearer
    alone.
    """
    if config.camera:
        raise WearcapError("cameras that film two wearers", expected="camera=false")
    rng = seeded(seed, split, 2)
    people = [person_of(split, int(number)) for number in rng.choice(POOLS[split][0], 2, replace=False)]
    world = drawn_world(config, split, rng)
    activities = config.activities or STAYING
    first, second = (
        simulate_motion(world, person, rng, config.duration_s, config.fps, list(activities)) for person in people
    )
    rise = first.floor_height[0] - second.floor_height[0]
    moved = second.motion.moved(face_to_face(first.motion, second.motion, distance_m, rise))
    facing = replace(second, motion=moved, floor_height=second.floor_height + rise)
    recordings = []
    for letter, person, simulated in zip("ab", people, (first, facing)):
        every = max(1, round(config.fps / ACTION_CAMERA_FPS))
        recording = sensed_recording(config, f"{name}-{letter}", world, person, simulated, rng)
        camera = action_camera(simulated.motion.timestamps[::every].contiguous())
        recordings.append(replace(recording, session=name, camera=camera))
    return recordings[0], recordings[1]


def face_to_face(first: Motion, second: Motion, distance_m: float, rise_m: float | Tensor = 0.0) -> Rigid:
    """Displacement of the second motion that puts its first frame in front of the first motion's, facing it, and raises
    it by `rise_m`."""
    ahead, heading = (rotation.yaw_of(motion.R_parent_joint[0, 0]) for motion in (first, second))
    R = rotation.about_axis("z", ahead + torch.pi - heading)
    place = first.t_world_root[0] + distance_m * torch.stack([ahead.cos(), ahead.sin(), torch.zeros(())])
    place = torch.stack([place[0], place[1], second.t_world_root[0, 2] + rise_m])
    return Rigid(R, place - R @ second.t_world_root[0])
