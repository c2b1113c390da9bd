"""Boxes: lifted between the palms with bent knees, carried before the chest, put down elsewhere."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.handling.grips import Grip, GripPlace
from wearcap.simulation.handling.handlings import Handling, handling_of
from wearcap.simulation.people.plan import SIDES, Plan, wrap
from wearcap.simulation.people.shuffling import step_to
from wearcap.simulation.people.track import ease
from wearcap.simulation.places.movables import Movable

BEFORE_CHEST_M = (0.17, 0.22)
"""Distance range between the chest's joint and the near face of the carried box."""
BELOW_CHEST = (0.16, 0.30)
"""Range of the palms' height below the chest, as a share of the hip height."""
BESIDE = (-0.02, 0.42, -0.74, 0.5, 0.0, 0.0)
"""The hand's pose channel (`HandScore.pose`): out to the side and back."""
DEEP = 0.30
"""Crouches deeper than this share of the hip height lift the heels."""


@dataclass(frozen=True)
class Errand:
    """A plan to take an object from one place to another, not yet written to the motion's plan."""

    movable: Movable
    start: Float[np.ndarray, "4"]
    """Pose of the object before: x, y (m), heading (rad), height of its underside (m)."""
    stop: Float[np.ndarray, "4"]
    places: dict[str, GripPlace]
    """Palm places by hand: one, or both."""
    facing: float
    """Heading of the holder relative to the object's (rad)."""

    @property
    def stand(self) -> Float[np.ndarray, "3"]:
        """Pose at which the wearer lifts the object: x, y, heading."""
        return self._before(self.start)

    @property
    def goal(self) -> Float[np.ndarray, "3"]:
        """Pose at which the wearer puts the object down: x, y, heading."""
        return self._before(self.stop)

    def _before(self, pose: np.ndarray) -> np.ndarray:
        """Pose at which one stands in front of the object at a pose."""
        raise NotImplementedError


@dataclass(frozen=True)
class Carry(Errand):
    """A plan to carry a box between both palms."""

    away: float
    """Distance from the middle of the feet to the box's middle when it is lifted and put down (m)."""
    chest: Float[np.ndarray, "2"]
    """Origin of the box ahead of and below the chest while it is carried (m)."""

    def _before(self, pose: np.ndarray) -> np.ndarray:
        heading = pose[2] + self.facing
        return np.array([pose[0] - self.away * np.cos(heading), pose[1] - self.away * np.sin(heading), heading])

    def palm_height(self, pose: Float[np.ndarray, "4"]) -> float:
        """Height of the palms on a box at a pose (m)."""
        return float(pose[3] + self.places["left"].point[2])


@dataclass(frozen=True)
class Lifted:
    """A box in the hands; `put_down` writes its grips."""

    choice: Carry
    start_s: float
    """Time at which the plan begins to bend down for the box."""
    touch_s: float
    lift_s: float
    lifted_s: float


def carry_options(
    plan: Plan, movable: Movable, start: Float[np.ndarray, "4"], stop: Float[np.ndarray, "4"], rng: np.random.Generator
) -> Iterator[Carry]:
    """Options for carrying a box between two poses (x, y, heading, underside height; m, rad), in random order.

    The caller of an option checks that one can stand at its `stand` and `goal`, goes to the first, calls `lift`, goes
    to the second and calls `put_down`. The box may end turned by quarters relative to `stop`, as `Carry.stop` states.
    """
    start, stop = np.asarray(start, np.float64), np.asarray(stop, np.float64)
    for index in rng.permutation(len(movable.sides)):
        left, right, facing = movable.sides[index]
        ahead = np.array([np.cos(facing), np.sin(facing), 0.0])
        deep = float(np.abs(ahead[:2]) @ np.array(movable.half_size))
        nearer = rng.uniform(0.25, 0.7) * deep * ahead
        places = {
            side: GripPlace(_shifted(place.point, -nearer), place.normal, place.fingers)
            for side, place in zip(SIDES, (left, right))
        }
        below = float(rng.uniform(*BELOW_CHEST)) * plan.hip_height
        chest = np.array([deep + rng.uniform(*BEFORE_CHEST_M), below + left.point[2]])
        away = plan.sole[1] + 0.08 + 0.2 * max(movable.height - 0.25, 0.0) + deep + float(rng.uniform(0.0, 0.06))
        yield Carry(movable, start, stop, places, facing, away, chest)


def _shifted(point: tuple[float, float, float], by: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.array(point) + by)
    return x, y, z


def lift(plan: Plan, choice: Carry, rng: np.random.Generator) -> Lifted:
    """Bend down, take hold, and lift; the wearer stands at or near `choice.stand`. `plan.time` becomes the end."""
    arrive(plan, choice.stand, rng)
    start, low = plan.time, choice.palm_height(choice.start) - plan.position[2]
    bend, lean = bend_for(plan, low, rng)
    down = float((0.75 + 1.1 * bend) * rng.uniform(0.9, 1.25) / plan.style.briskness)
    touch = start + down
    begin = touch + float(rng.uniform(0.1, 0.5))
    rise = float((0.9 + 1.2 * bend) * rng.uniform(0.9, 1.3) / plan.style.briskness)
    bow(plan, start, touch, bend, lean)
    spread(plan, (start, start + 0.45 * down), (touch, begin + rise))
    plan.gaze_point.move(start, start, np.append(choice.start[:2], choice.start[3] + 0.8 * choice.movable.height))
    plan.gaze_weight.move(start, start + 0.5, 0.9)
    plan.gaze_weight.move(begin + 0.3 * rise, begin + rise, 0.0)
    bow(plan, begin, begin + rise, 0.0, float(rng.normal(-0.04, 0.03)))
    plan.time = begin + rise + float(rng.uniform(0.0, 0.3))
    return Lifted(choice, start, touch, begin, begin + rise)


def put_down(plan: Plan, lifted: Lifted, rng: np.random.Generator) -> Handling:
    """Lower the box to its place, let go and stand up; the wearer stands at or near `choice.goal`."""
    choice = lifted.choice
    arrive(plan, choice.goal, rng)
    start, low = plan.time + 0.1, choice.palm_height(choice.stop) - plan.position[2]
    bend, lean = bend_for(plan, low, rng)
    down = float((1.0 + 1.2 * bend) * rng.uniform(0.9, 1.3) / plan.style.briskness)
    release = start + down + float(rng.uniform(0.05, 0.4))
    rise = float((0.8 + 1.0 * bend) * rng.uniform(0.9, 1.2) / plan.style.briskness)
    bow(plan, start, start + down, bend, lean)
    bow(plan, release, release + rise, 0.0, 0.0)
    spread(plan, (start, start + down), (release + 0.3 * rise, release + rise))
    plan.gaze_point.move(start, start, np.append(choice.stop[:2], choice.stop[3]))
    plan.gaze_weight.move(start, start + 0.5, 0.9)
    plan.gaze_weight.move(release, release + 0.6, 0.0)
    moves = _CarriedPath(choice, (lifted.lift_s, lifted.lifted_s), (start, start + down))
    grips = []
    for side in SIDES:
        late = float(rng.uniform(0.0, 0.12)) if rng.random() < 0.5 else 0.0
        grip = Grip(
            choice.places[side],
            moves,
            lifted.touch_s,
            release + late,
            lifted.touch_s - lifted.start_s,
            float(np.clip(0.7 * rise, 0.4, 1.1)),
            float(rng.uniform(0.15, 0.22)),
        )
        plan.grip(side, grip)
        grips.append((side, grip))
    plan.time = release + rise + float(rng.uniform(0.0, 0.3))
    return handling_of(choice.movable.name, "sliding", moves, grips)


def arrive(plan: Plan, place: Float[np.ndarray, "3"], rng: np.random.Generator) -> None:
    """Step to x, y (m) and a heading (rad) nearby, unless one is there."""
    if np.hypot(*(place[:2] - plan.position[:2])) > 0.03 or abs(wrap(place[2] - plan.heading)) > 0.1:
        step_to(plan, rng, place[:2], place[2])


def bend_for(plan: Plan, low: float, rng: np.random.Generator) -> tuple[float, float]:
    """Bend of the knees (m) and the trunk (rad) for palms at a height above the floor (m)."""
    drop = max(1.52 * plan.hip_height - low - 0.62 * plan.arm_length, 0.0)
    knees = float(np.clip(rng.normal(0.50, 0.08), 0.32, 0.66))
    return float(np.clip(knees * drop, 0.0, 0.46 * plan.hip_height)), float(
        np.clip(0.12 + (1.45 - knees) * drop, 0.1, 1.05)
    )


def bow(plan: Plan, start: float, stop: float, crouch: float, lean: float, aside: float = 0.0) -> None:
    """Bring knees (m) and trunk (rad; forwards, and to the right) to a bend between two times."""
    plan.crouch.move(start, stop, crouch)
    plan.lean.move(start, stop, (lean, aside, 0.0))
    heels = 0.35 if crouch > DEEP * plan.hip_height else 0.0
    for side in SIDES:
        first, last = (start + 0.3 * (stop - start), stop) if heels else (start, stop - 0.4 * (stop - start))
        plan.heel_lift[side].move(first, last, heels)


def spread(plan: Plan, out: tuple[float, float], back: tuple[float, float]) -> None:
    """Keep hands that do not hold the box beside it while bending over it."""
    for side in SIDES:
        hand = plan.hands[side]
        hand.pose.move(out[0], out[0], BESIDE)
        hand.pose_weight.move(*out, 1.0)
        hand.pose_weight.move(*back, 0.0)


@dataclass(frozen=True)
class _CarriedPath:
    """Pose of a carried box over time: where it stands, in front of the chest, and where it will stand."""

    choice: Carry
    up: tuple[float, float]
    down: tuple[float, float]

    def __call__(self, times: Float[np.ndarray, "time"], T_world_chest: Rigid) -> Rigid:
        lift, lower, near, off = (
            torch.from_numpy(ease((times - start) / (stop - start)))
            for start, stop in (self.up, self.down, late(self.up), early(self.down))
        )
        choice = self.choice
        first, last = (torch.from_numpy(pose) for pose in (choice.start, choice.stop))
        yaw = rotation.yaw_of(T_world_chest.R).double()
        ahead = torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], -1)
        held = T_world_chest.t.double() + choice.chest[0] * ahead - torch.tensor([0.0, 0.0, choice.chest[1]])
        # Around the knees: the box comes near the body late, and leaves it early.
        share = torch.stack([near, near, lift], -1), torch.stack([off, off, lower], -1)
        t = held + (1 - share[0]) * (first[[0, 1, 3]] - held) + share[1] * (last[[0, 1, 3]] - held)
        heading = yaw - choice.facing
        heading = (
            heading
            + (1 - lift) * rotation.wrap_angle(first[2] - heading)
            + lower * rotation.wrap_angle(last[2] - heading)
        )
        return Rigid(rotation.about_axis("z", heading), t)


def late(span: tuple[float, float]) -> tuple[float, float]:
    """A span without its first third."""
    return span[0] + 0.35 * (span[1] - span[0]), span[1]


def early(span: tuple[float, float]) -> tuple[float, float]:
    """A span without its last third."""
    return span[0], span[1] - 0.35 * (span[1] - span[0])
