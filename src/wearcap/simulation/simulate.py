"""One simulated recording: a world, a person, what they do, and what their sensors say of it."""

from dataclasses import dataclass, field

import numpy as np

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.recording.recording import ContactTrack, FloorTrack, PointCloud, Recording
from wearcap.sensors.head import SlamNoise, head_stream
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.slam import semidense_points
from wearcap.sensors.suit import SuitNoise, suit_motion
from wearcap.simulation.flat import build_flat
from wearcap.simulation.person import Person, draw_person
from wearcap.simulation.wearer import SimulatedMotion, simulate_motion
from wearcap.simulation.world import World

POOLS = {"train": (200, 150), "val": (20, 15), "test": (40, 30)}
"""People and places of each split: (subjects, locations); no split shares any with another."""


@dataclass(frozen=True)
class SimulationConfig:
    """What to simulate. `activities` names entries of `simulation.actions.ACTIVITIES`; None draws from all."""

    duration_s: float = 120.0
    fps: float = 60.0
    imu_joints: tuple[str, ...] = ("left_wrist", "right_wrist")
    points: bool = True
    activities: tuple[str, ...] | None = None
    head_noise: SlamNoise | None = field(default_factory=SlamNoise)
    imu_noise: ImuNoise | None = field(default_factory=ImuNoise)
    suit: SuitNoise | None = field(default_factory=SuitNoise)
    """None: no suit is worn."""


def simulate_recording(config: SimulationConfig, name: str, split: str, seed: int) -> Recording:
    """The recording of a seed: subject and location are drawn from the split's own pools."""
    rng = np.random.default_rng([seed, sum(map(ord, split))])
    subjects, locations = POOLS[split]
    person = person_of(split, int(rng.integers(subjects)))
    world = world_of(split, int(rng.integers(locations)))
    activities = list(config.activities) if config.activities else None
    simulated = simulate_motion(world, person, rng, config.duration_s, config.fps, activities)
    return sense(config, name, world, person, simulated, rng)


def person_of(split: str, number: int) -> Person:
    """A split's person by number, always the same."""
    return draw_person(
        f"sim-{split}-person-{number:03d}", np.random.default_rng([1, sum(map(ord, split)), number])
    )


def world_of(split: str, number: int) -> World:
    """A split's place by number, always the same."""
    rng = np.random.default_rng([2, sum(map(ord, split)), number])
    return build_flat(rng, f"sim-{split}-flat-{number:03d}")


def sense(
    config: SimulationConfig,
    name: str,
    world: World,
    person: Person,
    simulated: SimulatedMotion,
    rng: np.random.Generator,
) -> Recording:
    """Put sensors on a simulated motion."""
    motion = simulated.motion
    head = head_stream(motion, person.t_head_device, config.head_noise, rng)
    imu = {
        joint: synthesize_imu(motion, joint, noise=config.imu_noise, rng=rng) for joint in config.imu_joints
    }
    points: PointCloud | None = (
        semidense_points(world.mesh, world.face_texture, head, rng) if config.points else None
    )
    suit = suit_motion(motion, simulated.contact, config.suit, rng) if config.suit else None
    seconds: dict[str, float] = {}
    for label in simulated.labels:
        seconds[label.name] = seconds.get(label.name, 0.0) + float(label.stop_s - label.start_s)
    return Recording(
        name, head=head, imu=imu, suit=suit, points=points, motion=motion,
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, simulated.contact),
        floor=FloorTrack(motion.timestamps, simulated.floor_height), skeleton=person.skeleton, shape=person.shape,
        subject=person.name, location=world.name,
        activity=", ".join(sorted(seconds, key=lambda key: -seconds[key])), source="wearcap simulation",
        license="MIT (generated)",
    )  # fmt: skip
