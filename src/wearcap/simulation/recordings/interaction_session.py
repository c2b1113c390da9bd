"""Simulated iReplica recordings: use of a flat's objects, recorded by a suit and a head camera (thesis §5.4)."""

from dataclasses import dataclass, field

import numpy as np

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording.recording import ContactTrack, FloorTrack, Recording
from wearcap.scene.environment import Environment
from wearcap.sensors.suit import SuitNoise, suit_motion
from wearcap.simulation.handling.house import House
from wearcap.simulation.handling.household import Household
from wearcap.simulation.people.wearer import perform
from wearcap.simulation.places.interactive_flat import InteractiveFlat, build_interactive_flat
from wearcap.simulation.places.world import World
from wearcap.simulation.recordings.localization_noise import LocalizationNoise, localize_statistically
from wearcap.simulation.recordings.simulate import POOLS, activity_of, person_of
from wearcap.simulation.rendering.head_camera import HeadCameraConfig, head_camera, view_texture

FLATS = {"train": 40, "val": 6, "test": 8}
"""Interactive flats of each split: each needs a scan, so they are used again."""


@dataclass(frozen=True)
class InteractionConfig(HeadCameraConfig):
    """Settings of a simulated recording. Suit and camera share a clock by default."""

    fps: float = 60.0
    minutes: float = 3.0
    suit: SuitNoise = field(default_factory=SuitNoise)
    localization: LocalizationNoise = field(default_factory=LocalizationNoise)
    clock_offset_s: float = 0.0
    clock_drift_ms_per_h: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        super().__post_init__()
        if self.fps < 30 or not self.minutes > 0:
            raise WearcapError(f"{self.minutes} min at {self.fps} Hz", expected="some time, at 30 Hz or more")


@dataclass(frozen=True)
class SimulatedInteractions:
    """A recording with the environment in which it took place, and the worlds it was made from."""

    recording: Recording
    environment: Environment
    world: World
    """The static world together with the movable objects at their initial poses."""
    static: World
    """The static part of the world alone."""


def flat_number(split: str, index: int) -> int:
    """Number of the split's interactive flat in which its index-th recording takes place."""
    return index % min(FLATS[split], POOLS[split][1])


def flat_of(split: str, number: int) -> InteractiveFlat:
    """A split's interactive flat by number, always the same."""
    rng = np.random.default_rng([6, sum(map(ord, split)), number])
    return build_interactive_flat(rng, f"sim-{split}-interactive_flat-{number:03d}")


def simulate_interactions(config: InteractionConfig, name: str, split: str, seed: int) -> SimulatedInteractions:
    """The recording of a seed, in the split's flat of the same number.

    Sensed are `suit`, `camera` and its `localization`. True are `motion`, `contacts` of the feet, `floor`,
    `interactions` and, for everything that can be moved, `object_motion` on the motion's timestamps.
    """
    rng = np.random.default_rng([7, sum(map(ord, split)), seed])
    person = person_of(split, int(rng.integers(POOLS[split][0])))
    flat = flat_of(split, flat_number(split, seed))
    house, duration = House(flat), 60.0 * config.minutes
    household = Household(house, person, rng)
    household.live(duration)
    simulated = perform(household.plan, flat.static, rng, duration, config.fps)
    motion = simulated.motion
    suit = suit_motion(motion, simulated.contact, config.suit, rng)
    camera, path, _ = head_camera(motion, person.t_head_device, config, rng)
    texture = view_texture(flat.world, path, max(1, round(config.camera_fps / 2)))
    recording = Recording(
        name,
        suit=suit,
        camera=camera,
        localization=localize_statistically(path, config.localization, rng, texture),
        motion=motion,
        contacts=ContactTrack(motion.timestamps, FOOT_PATCHES, simulated.contact),
        object_motion=house.object_motion(motion),
        interactions=house.interactions(duration),
        floor=FloorTrack(motion.timestamps, simulated.floor_height),
        skeleton=person.skeleton,
        shape=person.shape,
        subject=person.name,
        location=flat.static.name,
        activity=activity_of(simulated.labels),
        source="wearcap simulation",
        license="MIT (generated)",
    )
    return SimulatedInteractions(recording, flat.environment, flat.world, flat.static)
