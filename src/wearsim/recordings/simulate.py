"""Simulated recordings: a world, a person, activities, and the sensor readings."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording.recording import ContactTrack, FloorTrack, Recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.simulated import SlamNoise, head_stream
from wearsim.people.person import Person, draw_person
from wearsim.people.wearer import SimulatedMotion, simulate_motion
from wearsim.places.flat import build_flat
from wearsim.places.outdoor import build_hillside, build_outdoor
from wearsim.places.site import build_site
from wearsim.places.world import World
from wearsim.rendering.ego_view import write_ego_video
from wearsim.sensors.slam import semidense_points
from wearsim.sensors.suit import SuitNoise, suit_motion

POOLS = {"train": (200, 150), "val": (20, 15), "test": (40, 30)}
"""People and places of each split: (subjects, locations of each kind); no split shares any with another."""

WORLDS = {
    "flat": (2, build_flat),
    "outdoor": (3, build_outdoor),
    "site": (4, build_site),
    "hillside": (5, build_hillside),
}
"""Kinds of surroundings: a number for their seeds, and their builder."""

OUTDOOR_SHARE = 0.3


@dataclass(frozen=True)
class SimulationConfig:
    """Settings. `activities` names entries of `people.actions.ACTIVITIES`; None draws from all.

    `world` is "flat", "outdoor", "site", or None: one of the first two, drawn for each recording, three in ten
    outdoors. Raises WearcapError for another.
    """

    duration_s: float = 120.0
    fps: float = 60.0
    imu_joints: tuple[str, ...] = ("left_wrist", "right_wrist")
    points: bool = True
    activities: tuple[str, ...] | None = None
    head_noise: SlamNoise | None = field(default_factory=SlamNoise)
    imu_noise: ImuNoise | None = field(default_factory=ImuNoise)
    suit: SuitNoise | None = field(default_factory=SuitNoise)
    """Noise of the suit; None: no suit is worn."""
    world: str | None = None
    camera: bool = False
    """Whether to film the view of a camera on the head."""

    def __post_init__(self):
        if self.world is not None and self.world not in WORLDS:
            raise WearcapError(f"no world {self.world!r}", expected=f"{' or '.join(WORLDS)}, or null to draw one")


def simulate_recording(
    config: SimulationConfig, name: str, split: str, seed: int, folder: Path | None = None
) -> Recording:
    """The recording of a seed: subject and location are drawn from the split's own pools.

    The camera's video goes to `folder`/videos. Everything else is the same with and without a camera. Raises
    WearcapError for a camera without a folder.
    """
    if config.camera and folder is None:
        raise WearcapError("no folder for the head camera's video", expected="one for the data set")
    rng = np.random.default_rng([seed, sum(map(ord, split))])
    person = drawn_person(split, rng)
    world = drawn_world(config, split, rng)
    activities = list(config.activities) if config.activities else None
    simulated = simulate_motion(world, person, rng, config.duration_s, config.fps, activities)
    recording = sensed_recording(config, name, world, person, simulated, rng)
    if not config.camera or folder is None:
        return recording
    file = folder / "videos" / f"{name}.mp4"
    camera = write_ego_video(file, world, simulated.motion, person.shape, person.t_head_device, seeded(31, split, seed))
    return replace(recording, camera=camera)


def seeded(salt: int, split: str, number: int) -> np.random.Generator:
    """A generator for the number-th of a split's people, places or recordings; `salt` tells these apart."""
    return np.random.default_rng([salt, sum(map(ord, split)), number])


def person_of(split: str, number: int) -> Person:
    """A split's person by number, always the same."""
    return draw_person(f"sim-{split}-person-{number:03d}", seeded(1, split, number))


def drawn_person(split: str, rng: np.random.Generator) -> Person:
    """One of a split's people."""
    return person_of(split, int(rng.integers(POOLS[split][0])))


def world_of(split: str, number: int, kind: str = "flat") -> World:
    """A split's place of a kind (`WORLDS`) by number, always the same."""
    salt, build = WORLDS[kind]
    return build(seeded(salt, split, number), f"sim-{split}-{kind}-{number:03d}")


def drawn_world(config: SimulationConfig, split: str, rng: np.random.Generator) -> World:
    """One of a split's places, of the configured kind."""
    number, kind = int(rng.integers(POOLS[split][1])), "outdoor" if rng.uniform() < OUTDOOR_SHARE else "flat"
    return world_of(split, number, config.world or kind)


def sensed_recording(
    config: SimulationConfig,
    name: str,
    world: World,
    person: Person,
    simulated: SimulatedMotion,
    rng: np.random.Generator,
) -> Recording:
    """The recording of a simulated motion by the sensors of a configuration."""
    motion = simulated.motion
    head = head_stream(motion, person.t_head_device, config.head_noise, rng)
    imu = {joint: synthesize_imu(motion, joint, noise=config.imu_noise, rng=rng) for joint in config.imu_joints}
    points = semidense_points(world.mesh, world.face_texture, head, rng) if config.points else None
    suit = suit_motion(motion, simulated.contact, config.suit, rng) if config.suit else None
    return with_truth(simulated, person, name, world.name, head=head, imu=imu, suit=suit, points=points)


def with_truth(
    simulated: SimulatedMotion, person: Person, name: str, location: str, activity: str | None = None, **parts: Any
) -> Recording:
    """A recording with its sensed `parts` and the truth of a simulated motion.

    Its activities, the longest first, are those of the motion's labels unless `activity` names them.
    """
    motion = simulated.motion
    seconds: dict[str, float] = {}
    for label in simulated.labels:
        seconds[label.name] = seconds.get(label.name, 0.0) + float(label.stop_s - label.start_s)
    return Recording(
        name,
        motion=motion,
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, simulated.contact),
        floor=FloorTrack(motion.timestamps, simulated.floor_height),
        skeleton=person.skeleton,
        shape=person.shape,
        subject=person.name,
        location=location,
        activity=activity or ", ".join(sorted(seconds, key=lambda key: -seconds[key])),
        source="wearcap simulation",
        license="MIT (generated)",
        **parts,
    )
