"""Simulated ECHO recordings: a wearer of a head device uses, moves and carries the objects of a flat."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.recording.recording import ContactTrack, FloorTrack, Recording
from wearcap.scene.environment import Environment
from wearcap.sensors.head import SlamNoise, head_stream
from wearcap.simulation.handling.house import House
from wearcap.simulation.handling.household import VARIED, Household
from wearcap.simulation.people.wearer import perform
from wearcap.simulation.places.interactive_flat import InteractiveFlat, build_interactive_flat
from wearcap.simulation.places.strewn import with_handhelds
from wearcap.simulation.recordings.simulate import POOLS, activity_of, person_of


@dataclass(frozen=True)
class ObjectConfig:
    """Settings of a simulated recording."""

    fps: float = 30.0
    minutes: float = 2.0
    head_noise: SlamNoise | None = field(default_factory=SlamNoise)

    def __post_init__(self):
        if self.fps < 30 or not self.minutes > 0:
            raise WearcapError(f"{self.minutes} min at {self.fps} Hz", expected="some time, at 30 Hz or more")


@dataclass(frozen=True)
class SimulatedObjects:
    """A recording with the environment in which it took place."""

    recording: Recording
    environment: Environment


@lru_cache(maxsize=2)
def object_flat_of(split: str, number: int) -> InteractiveFlat:
    """A split's interactive flat with hand-held objects by number, always the same."""
    rng = np.random.default_rng([8, sum(map(ord, split)), number])
    while True:
        flat = build_interactive_flat(rng, f"sim-{split}-object_flat-{number:03d}")
        if (furnished := with_handhelds(flat, rng)) is not None:
            return furnished


def simulate_objects(config: ObjectConfig, name: str, split: str, seed: int) -> SimulatedObjects:
    """The recording of a seed, in the split's flat of the same number.

    Sensed is `head`. True are `motion`, `contacts` of the feet, `floor`, `interactions` and, for everything that can
    be moved, `object_motion` on the motion's timestamps.
    """
    rng = np.random.default_rng([9, sum(map(ord, split)), seed])
    subjects, locations = POOLS[split]
    person = person_of(split, int(rng.integers(subjects)))
    flat = object_flat_of(split, seed % locations)
    house, duration = House(flat), 60.0 * config.minutes
    household = Household(house, person, rng, VARIED)
    household.live(duration)
    simulated = perform(household.plan, flat.static, rng, duration, config.fps)
    motion = simulated.motion
    recording = Recording(
        name,
        head=head_stream(motion, person.t_head_device, config.head_noise, rng),
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
    return SimulatedObjects(recording, flat.environment)
