"""Simulated recordings of the use of a flat's objects: iReplica's (thesis §5.4) and ECHO's.

iReplica's wearers open, close and move what a flat holds and wear a suit and a head camera; ECHO's wear a head device
and carry the hand-held objects that lie about as well.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from wearcap.errors import WearcapError
from wearcap.recording.recording import Recording
from wearcap.sensors.simulated import SlamNoise, head_stream
from wearsim.handling.household import USUAL, VARIED, Habits, Household
from wearsim.handling.rearranging import APART_M
from wearsim.people.person import Person
from wearsim.people.wearer import SimulatedMotion, perform
from wearsim.places.interactive_flat import House, InteractiveFlat, build_interactive_flat, obstacle
from wearsim.places.movables import HANDHELDS, Movable, make_movable
from wearsim.places.outline import stays_apart
from wearsim.recordings.localization_noise import LocalizationNoise, by_gravity, localize_statistically
from wearsim.recordings.simulate import POOLS, drawn_person, seeded, with_truth
from wearsim.rendering.head_camera import HeadCameraConfig, head_camera, view_texture
from wearsim.sensors.suit import SuitNoise, suit_motion

FLATS = {"train": 40, "val": 6, "test": 8}
"""Interactive flats of each split: each needs a scan, so they are used again."""
TWICE = 0.4
"""Probability of two objects of a kind."""
TRIES = 60
OPEN_SHARE, WIDE = 0.75, np.deg2rad(66.0)
"""Share of the shut doors that are opened; least angle to which they are."""
REACHABLE_SHARE = 0.96
"""Share of the floor that must stay reachable when an object has been put there."""


@dataclass(frozen=True)
class InteractionConfig(HeadCameraConfig):
    """Settings of a simulated recording for iReplica. Suit and camera share a clock by default."""

    fps: float = 60.0
    minutes: float = 3.0
    suit: SuitNoise = field(default_factory=SuitNoise)
    localization: LocalizationNoise = field(default_factory=LocalizationNoise)
    clock_offset_s: float = 0.0
    clock_drift_ms_per_h: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        super().__post_init__()
        _check_length(self.minutes, self.fps)


@dataclass(frozen=True)
class ObjectConfig:
    """Settings of a simulated recording for ECHO."""

    fps: float = 30.0
    minutes: float = 2.0
    head_noise: SlamNoise | None = field(default_factory=SlamNoise)

    def __post_init__(self):
        _check_length(self.minutes, self.fps)


def _check_length(minutes: float, fps: float) -> None:
    """Raises WearcapError for a recording without a length or below 30 Hz."""
    if fps < 30 or not minutes > 0:
        raise WearcapError(f"{minutes} min at {fps} Hz", expected="some time, at 30 Hz or more")


def flat_of(split: str, number: int) -> InteractiveFlat:
    """A split's interactive flat by number, always the same."""
    return build_interactive_flat(seeded(6, split, number), f"sim-{split}-interactive_flat-{number:03d}")


@lru_cache(maxsize=2)
def object_flat_of(split: str, number: int) -> InteractiveFlat:
    """A split's interactive flat with hand-held objects by number, always the same.

    Most of its doors are open, and one or two objects of each kind stand at reachable places, clear of doors, drawers
    and walkers; where a kind finds no place, the next flat is taken.
    """
    rng = seeded(8, split, number)
    while True:
        flat = build_interactive_flat(rng, f"sim-{split}-object_flat-{number:03d}")
        openables = tuple(
            item.at(item.opening_sign * float(rng.uniform(WIDE, item.openness(item.opened))))
            if item.category == "door" and item.blocks(0.0) and rng.random() < OPEN_SHARE
            else item
            for item in flat.openables
        )
        flat = InteractiveFlat(flat.static, flat.movables, openables)
        names = [f"{category}_{copy}" for category in HANDHELDS for copy in range(1, 2 + int(rng.random() < TWICE))]
        for name in names:
            if (placed := _placed(flat, make_movable(name.rpartition("_")[0], name, rng), rng)) is not None:
                flat = InteractiveFlat(flat.static, (*flat.movables, placed), openables)
        if {movable.category for movable in flat.movables}.issuperset(HANDHELDS):
            return flat


def simulate_interactions(
    config: InteractionConfig, name: str, split: str, seed: int
) -> tuple[Recording, InteractiveFlat]:
    """iReplica's recording of a seed and its flat, which is the split's flat of the same number.

    Sensed are `suit`, `camera` and its `localization`. True are `motion`, `contacts` of the feet, `floor`,
    `interactions` and, for everything that can be moved, `object_motion` on the motion's timestamps.
    """
    rng = seeded(7, split, seed)
    person = drawn_person(split, rng)
    flat = flat_of(split, seed % min(FLATS[split], POOLS[split][1]))
    house, simulated = _lived(flat, person, config.minutes, config.fps, USUAL, rng)
    suit = suit_motion(simulated.motion, simulated.contact, config.suit, rng)
    camera, path, _ = head_camera(simulated.motion, person.t_head_device, config, rng)
    texture = view_texture(flat.world, path, max(1, round(config.camera_fps / 2)))
    parts = {"suit": by_gravity(suit, config.localization.map, rng), "camera": camera}
    parts["localization"] = localize_statistically(path, config.localization, rng, texture)
    return _handled(house, simulated, person, name, config.minutes, parts), flat


def simulate_objects(config: ObjectConfig, name: str, split: str, seed: int) -> tuple[Recording, InteractiveFlat]:
    """ECHO's recording of a seed and its flat, which is the split's flat of the same number.

    Sensed is `head`. True are `motion`, `contacts` of the feet, `floor`, `interactions` and, for everything that can
    be moved, `object_motion` on the motion's timestamps.
    """
    rng = seeded(9, split, seed)
    person = drawn_person(split, rng)
    flat = object_flat_of(split, seed % POOLS[split][1])
    house, simulated = _lived(flat, person, config.minutes, config.fps, VARIED, rng)
    head = head_stream(simulated.motion, person.t_head_device, config.head_noise, rng)
    return _handled(house, simulated, person, name, config.minutes, {"head": head}), flat


def _lived(
    flat: InteractiveFlat, person: Person, minutes: float, fps: float, habits: Habits, rng: np.random.Generator
) -> tuple[House, SimulatedMotion]:
    """The motion of a person who uses a flat's objects by some habits, and the house as it is left."""
    household = Household(House(flat), person, rng, habits)
    household.live(60.0 * minutes)
    return household.house, perform(household.plan, flat.static, rng, 60.0 * minutes, fps)


def _handled(
    house: House, simulated: SimulatedMotion, person: Person, name: str, minutes: float, parts: dict
) -> Recording:
    """The recording of `_lived` with its sensed parts and the truth of body and objects."""
    return with_truth(
        simulated,
        person,
        name,
        house.flat.static.name,
        object_motion=house.object_motion(simulated.motion),
        interactions=house.interactions(60.0 * minutes),
        **parts,
    )


def _placed(flat: InteractiveFlat, movable: Movable, rng: np.random.Generator) -> Movable | None:
    """The object at a free place of the floor; None where none was found."""
    house, navigation = House(flat), flat.static.navigation
    standing = house.obstacles()
    solid = [item.footprint for item in (*flat.static.objects, *standing) if item.z_range[0] < 1.0]
    zones = house.kept_free()
    rooms = [navigation.barred(standing, point) for point in flat.static.sample_floor(rng, 6)]
    points = max(rooms, key=lambda grid: int(grid.walkable.sum())).node_points
    for _ in range(TRIES):
        x, y, z = points[rng.integers(len(points))]
        x, y, heading = (float(v) for v in (*rng.normal((x, y), 0.15), rng.uniform(-np.pi, np.pi)))
        if not stays_apart(movable.outline, np.array([[x, y, heading]]), [*solid, *zones], APART_M):
            continue
        placed = movable.placed(x, y, heading, float(z))
        for around in points[rng.integers(len(points), size=2)]:
            left = navigation.barred((*standing, obstacle(placed, None)), around).walkable.sum()
            if left > REACHABLE_SHARE * len(points):
                return placed
    return None
