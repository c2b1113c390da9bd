"""Objects in the hands: lifted off the floor, carried at the side or before the body, put down elsewhere.

A box is carried between the palms before the chest (`Carry`); other objects are held in one hand or both (`Take`) and
can be moved about (`HeldObject.go`). Whoever chooses an option of `carry_options` or `take_options` checks that one can
stand at its `stand` and `goal`, goes to the first, calls `lift`, goes to the second and calls `put_down`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.spatial
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearsim.handling.grips import Grip, GripPlace, Handling, Vector, vector
from wearsim.people.actions import DEEP, HEELS_RAD, ON_THIGHS, hold
from wearsim.people.plan import LEFT_SIGN, OTHER, SIDES, Plan
from wearsim.people.posture import look_at
from wearsim.people.track import Track, ease
from wearsim.people.walking import arrive
from wearsim.places.movables import Movable
from wearsim.places.outline import turn

BEFORE_CHEST_M = (0.17, 0.22)
"""Distance range between the chest's joint and the near face of the carried box."""
BELOW_CHEST = (0.16, 0.30)
"""Range of the palms' height below the chest, as a share of the hip height."""
OUT_OF_THE_WAY = (-0.02, 0.42, -0.74, 0.5, 0.0, 0.0)
"""The hand's pose channel (`HandScore.pose`): out to the side and back."""
BESIDE = ("suitcase", "backpack")
"""Categories that hang beside the body when held by one hand; all others are held before it."""
LONG_M = 0.4
"""Half length from which on a tool is a long stick."""
LEG_M = 0.19
"""Distance from the body's middle to the outside of a leg, with a margin."""
OFF_FLOOR_M = 0.07
"""Least height above the floor of an object that hangs from a hand."""
STRETCH = 0.93
"""Distance from shoulder to palm of a hanging arm, as a share of its length."""
LIFTED_M, LONG_LIFTED_M = 0.02, 0.08
"""Softness of the clearance from the floor: a held object keeps about half of it; the second is for long sticks."""
SWING_M, SWING_RAD = 0.05, 0.10
"""Swing of an object that hangs from a hand, forwards and back with each stride."""


@dataclass(frozen=True)
class Errand:
    """A plan to take an object from one place to another, not yet written to the motion's plan."""

    wait_s: ClassVar[float]
    """Longest time between taking hold and lifting."""
    rise: ClassVar[float]
    """Time to lift per bend of the knees (s/m)."""
    upright: ClassVar[float]
    """Mean lean of the trunk while carrying (rad)."""
    out: ClassVar[float]
    """Share of the way down in which free hands get out of the way."""
    lower: ClassVar[float]
    """Time to put down per bend of the knees (s/m)."""
    release_s: ClassVar[float]
    """Longest time between setting down and letting go."""
    movable: Movable
    start: Float[np.ndarray, "4"]
    """Pose of the object before: x, y (m), heading (rad), height of its underside (m)."""
    stop: Float[np.ndarray, "4"]
    places: dict[str, GripPlace]
    """Palm places by hand: one, or both."""
    facing: float
    """Heading of the holder relative to the object's (rad)."""
    local: Float[np.ndarray, "2"]
    """Object's origin from the middle of the feet, ahead and to the left, when it is lifted and put down (m)."""

    @property
    def stand(self) -> Float[np.ndarray, "3"]:
        """Pose at which the wearer lifts the object: x, y, heading."""
        return self._before(self.start)

    @property
    def goal(self) -> Float[np.ndarray, "3"]:
        """Pose at which the wearer puts the object down: x, y, heading."""
        return self._before(self.stop)

    def _before(self, pose: np.ndarray) -> np.ndarray:
        heading = pose[2] + self.facing
        return np.append(pose[:2] - turn(heading) @ self.local, heading)

    @property
    def side(self) -> str | None:
        """The hand that holds it, None for both."""
        return None if len(self.places) == 2 else next(iter(self.places))

    @property
    def sign(self) -> float:
        """Sign of the lateral axis: keys are those of the left hand, mirrored for the right."""
        return 1.0 if self.side is None else LEFT_SIGN[self.side]

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Mean position of the palms, in the object's axes (m)."""
        return np.mean([place.point for place in self.places.values()], 0)

    @property
    def lies(self) -> bool:
        """Whether it lies on the floor: it is taken up from above and turned in the air."""
        return all(place.normal[2] > 0.9 for place in self.places.values())

    @property
    def long(self) -> bool:
        """Whether it is a stick whose other end is held ahead."""
        return self.movable.category == "tool" and max(self.movable.half_size) > LONG_M

    @property
    def beside(self) -> bool:
        """Whether it hangs beside the body."""
        return self.side is not None and self.movable.category in BESIDE

    @cached_property
    def extent(self) -> Float[np.ndarray, "2"]:
        """Half of its outline ahead and across, as the holder sees it (m)."""
        return np.abs(turn(self.facing).T) @ np.array(self.movable.half_size)

    def bend(self, plan: Plan, pose: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float]:
        """Bend of the knees (m) and the trunk (rad; forwards, to the right) for the palms on the object at a pose."""
        low = float(pose[3] + self.middle[2] - plan.position[2])
        if self.side is None:
            return *bend_for(plan, low, rng), 0.0
        if not self.beside:
            bend, lean = bend_for(plan, low + 0.18 * plan.arm_length, rng)
            return bend, lean, -0.06 * self.sign
        drop = max(plan.shoulder_height - low - 0.98 * plan.arm_length, 0.0)
        knees = float(np.clip(rng.normal(0.45, 0.1), 0.25, 0.65))
        bend = float(np.clip(knees * drop, 0.0, 0.4 * plan.hip_height))
        return bend, float(np.clip(0.10 + (1.3 - knees) * drop, 0.08, 0.8)), -0.12 * self.sign

    def move_free_hand(
        self, plan: Plan, bend: float, out: tuple[float, float], back: tuple[float, float], rng: np.random.Generator
    ) -> None:
        """Put the free hand on the thigh while the knees bend, or let it hang; two hands come from beside the object."""
        if self.side is None:
            keep_hands_aside(plan, out, back)
        elif bend > 0.5 * DEEP * plan.hip_height or rng.random() < 0.3:
            hold(plan, (OTHER[self.side],), ON_THIGHS, out[0], back[1] + 0.1, rng)


@dataclass(frozen=True)
class Carry(Errand):
    """A plan to carry a box between both palms."""

    wait_s, rise, upright, out, lower, release_s = 0.5, 1.2, -0.04, 0.45, 1.2, 0.4
    chest: Float[np.ndarray, "2"]
    """Origin of the box ahead of and below the chest while it is carried (m)."""


@dataclass(frozen=True)
class Take(Errand):
    """A plan to take an object with one hand or both."""

    wait_s, rise, upright, out, lower, release_s = 0.4, 1.1, -0.03, 0.5, 1.1, 0.35

    def neutral(self) -> Float[np.ndarray, "3 3"]:
        """Rotation relative to the holder's heading while the keys' angles are zero: upright, or, for objects
        taken from above, with the back of the hand outwards and the fingers ahead."""
        if not self.lies:
            R = np.eye(3)
            R[:2, :2] = turn(-self.facing)
            return R
        place = next(iter(self.places.values()))
        here, wanted = (
            np.stack([normal, fingers, np.cross(normal, fingers)], 1)
            for normal, fingers in (
                (np.array(place.normal), np.array(place.fingers)),
                (np.array([0.0, self.sign, 0.0]), np.array([1.0, 0.0, 0.0])),
            )
        )
        return wanted @ here.T

    def carrying_pose(self, plan: Plan, reach: float, rng: np.random.Generator) -> Float[np.ndarray, "6"]:
        """Pose in walking, as `HeldObject.keys`: beside a leg, ahead at arm's length (m), or before the body."""
        up = np.zeros(6)
        if self.beside:
            palm = abs(float((turn(-self.facing) @ self.middle[:2])[1]))
            out = LEG_M + self.extent[1] + palm - plan.shoulder[1]
            hangs = np.sqrt(max((STRETCH * reach) ** 2 - out**2, 0.0))
            lowest = plan.shoulder_height - self.middle[2] - OFF_FLOOR_M
            up[:3] = [rng.uniform(0.0, 0.06), out, -min(hangs, lowest)]
        elif self.side is None:
            near = self.extent[0] + rng.uniform(0.15, 0.20)
            up[:3] = [near, 0.0, -rng.uniform(0.40, 0.58) * reach]
        elif self.long:
            up[:4] = [0.42 * reach, 0.06, -0.50 * reach, -rng.uniform(0.8, 1.0)]
        elif rng.random() < 0.45:
            pitch = rng.uniform(1.0, 1.25) if self.lies else rng.uniform(0.45, 0.7)
            up[:4] = [0.08, rng.uniform(0.05, 0.09), -0.91 * reach, pitch]
        else:
            pitch = rng.uniform(-0.1, 0.4) if self.lies else rng.uniform(-0.1, 0.15)
            up[:4] = [0.50 * reach, rng.uniform(-0.03, 0.04), -rng.uniform(0.45, 0.58) * reach, pitch]
        return up


@dataclass
class Held:
    """A box in the hands; `put_down` writes its grips."""

    choice: Errand
    start_s: float
    """Time at which the plan begins to bend down for it."""
    touch_s: float
    lift_s: float
    lifted_s: float

    def pose(self, times: Float[np.ndarray, "time"], T_world_chest: Rigid, on_the_way: "_OnTheWay") -> Rigid:
        """Pose over time: where it stands, in front of the chest, and where it will stand."""
        choice, lift, lower = self.choice, on_the_way.lift, on_the_way.lower
        assert isinstance(choice, Carry)
        first, last = (torch.from_numpy(pose) for pose in (choice.start, choice.stop))
        yaw = rotation.yaw_of(T_world_chest.R).double()
        ahead = torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], -1)
        held = T_world_chest.t.double() + choice.chest[0] * ahead - torch.tensor([0.0, 0.0, choice.chest[1]])
        heading = yaw - choice.facing
        at_first, at_last = (rotation.wrap_angle(end[2] - heading) for end in (first, last))
        turned = rotation.about_axis("z", heading + (1 - lift) * at_first + lower * at_last)
        return Rigid(turned, on_the_way.point(held, first[[0, 1, 3]], last[[0, 1, 3]]))


@dataclass
class HeldObject(Held):
    """An object in one hand or both: `go` keys its pose over time."""

    choice: Take
    anchor: Float[np.ndarray, "3"]
    """The shoulder, or the middle between both, in the chest's axes (m)."""
    reach: float
    """Distance from shoulder to palm (m)."""
    carry: Float[np.ndarray, "6"]
    """Carrying pose, laid out as `keys`."""
    keys: Track = field(init=False)
    """The palms' middle from `anchor`, ahead, out and up along the body's heading (m), and the object's pitch
    (forwards), yaw (outwards) and roll (outer side up) against `Take.neutral` (rad)."""
    strides: Track = field(init=False, default_factory=lambda: Track(np.zeros(1)))
    """Swing of the hand, opposite to the foot of its side, -1…1."""

    def __post_init__(self):
        self.keys = Track(self.carry)

    def go(
        self, start_s: float, stop_s: float, place: Vector, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0
    ) -> None:
        """Bring it to a place, as shares of the arm's reach, and angles (rad) between two times."""
        self.keys.move(start_s, stop_s, np.array([*(self.reach * np.array(place)), pitch, yaw, roll]))

    def return_to_carry(self, start_s: float, stop_s: float) -> None:
        """Return to the carrying pose between two times (s)."""
        self.keys.move(start_s, stop_s, self.carry)

    def swing_with_strides(self, plan: Plan, until_s: float) -> None:
        """Write `strides` for the plan's steps between the end of the lift and a time (s)."""
        last = self.lifted_s
        prints = [(p, side) for side in SIDES for p in plan.prints[side] if self.lifted_s < p.land_s < until_s]
        for print_, side in sorted(prints, key=lambda pair: pair[0].land_s):
            other = [p for p in plan.prints[OTHER[side]] if p.land_s < print_.land_s][-1]
            step = float((print_.ground - other.ground)[:2] @ turn(print_.heading)[:, 0])
            size = float(np.clip(step / 0.6, -1.0, 1.2))
            if print_.land_s > last + 0.2:
                swung = -self.choice.sign * LEFT_SIGN[side] * size
                self.strides.move(max(last, print_.land_s - 0.7), print_.land_s, swung)
                last = print_.land_s
        self.strides.move(last, last + 0.7, 0.0)

    @cached_property
    def corners(self) -> Float[Tensor, "corner 3"]:
        """Corners of its convex hull, in its own axes (m)."""
        vertices = self.choice.movable.object.mesh.vertices.astype(np.float64)
        return torch.from_numpy(vertices[scipy.spatial.ConvexHull(vertices).vertices])

    def pose(self, times: Float[np.ndarray, "time"], T_world_chest: Rigid, on_the_way: "_OnTheWay") -> Rigid:
        """Pose over time: where it stands, in the hands as keyed, and where it will stand."""
        choice, about = self.choice, rotation.about_axis
        lift, lower = on_the_way.lift, on_the_way.lower
        keys = torch.from_numpy(self.keys.sample(times))
        swing = torch.from_numpy(self.strides.sample(times)[:, 0])
        hangs = 0.0 if choice.side is None else 1.0 if choice.beside else 0.4
        keys[:, 0] += hangs * SWING_M * swing
        keys[:, 3] -= hangs * SWING_RAD * swing
        R_heading = about("z", rotation.yaw_of(T_world_chest.R).double())
        mirror = torch.tensor([1.0, choice.sign, 1.0], dtype=torch.float64)
        anchor = T_world_chest.t.double() + T_world_chest.R.double() @ torch.from_numpy(self.anchor)
        point = anchor + (R_heading @ (keys[:, :3] * mirror)[..., None])[..., 0]
        turned = about("z", choice.sign * keys[:, 4]) @ about("y", keys[:, 3]) @ about("x", choice.sign * keys[:, 5])
        R = R_heading @ turned @ torch.from_numpy(choice.neutral())
        middle = torch.from_numpy(choice.middle)
        R_first, R_last = (about("z", torch.tensor(pose[2])) for pose in (choice.start, choice.stop))
        first, last = (
            torch.from_numpy(pose[[0, 1, 3]]) + R_pose @ middle
            for pose, R_pose in ((choice.start, R_first), (choice.stop, R_last))
        )
        near, off = (on_the_way.near, on_the_way.off) if choice.long else (lift, lower)
        R = rotation.between(R_first.expand_as(R), R, near)
        R = rotation.between(R, R_last.expand_as(R), off)
        t = on_the_way.point(point, first, last) - R @ middle
        # it keeps off the floor, smoothly
        soft = (LONG_LIFTED_M if choice.long else LIFTED_M) * lift * (1 - lower)
        below = choice.start[3] - t[:, 2] - (R[:, 2] @ self.corners.T).amin(-1)
        off_floor = (below + torch.sqrt(below**2 + soft**2 + 1e-18)) / 2
        return Rigid(R, t + off_floor[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


class _OnTheWay:
    """Progress of lifting and lowering at times (s), 0…1 each, given their intervals (s)."""

    def __init__(self, times: np.ndarray, up: tuple[float, float], down: tuple[float, float]):
        # around the knees an object comes near the body late, and leaves it early
        late = up[0] + 0.35 * (up[1] - up[0]), up[1]
        early = down[0], down[1] - 0.35 * (down[1] - down[0])
        self.lift, self.lower, self.near, self.off = (
            torch.from_numpy(ease((times - start) / (stop - start))) for start, stop in (up, down, late, early)
        )

    def point(self, held: Tensor, first: Tensor, last: Tensor) -> Float[Tensor, "time 3"]:
        """A point (m) between where it is lifted, where it is held, and where it is put down."""
        up = torch.stack([self.near, self.near, self.lift], -1)
        down = torch.stack([self.off, self.off, self.lower], -1)
        return held + (1 - up) * (first - held) + down * (last - held)


def carry_options(
    plan: Plan, movable: Movable, start: Float[np.ndarray, "4"], stop: Float[np.ndarray, "4"], rng: np.random.Generator
) -> Iterator[Carry]:
    """Options for carrying a box between two poses (x, y, heading, underside height; m, rad), in random order."""
    for index in rng.permutation(len(movable.sides)):
        left, right, facing = movable.sides[index]
        ahead = np.append(turn(facing)[:, 0], 0.0)
        deep = float(np.abs(ahead[:2]) @ np.array(movable.half_size))
        nearer = rng.uniform(0.25, 0.7) * deep * ahead
        places = {
            side: GripPlace(vector(np.array(place.point) - nearer), place.normal, place.fingers)
            for side, place in zip(SIDES, (left, right))
        }
        below = rng.uniform(*BELOW_CHEST) * plan.hip_height
        chest = np.array([deep + rng.uniform(*BEFORE_CHEST_M), below + left.point[2]])
        away = plan.sole[1] + 0.08 + 0.2 * max(movable.height - 0.25, 0.0) + deep + rng.uniform(0.0, 0.06)
        yield Carry(movable, start, stop, places, facing, np.array([away, 0.0]), chest)


def take_options(
    plan: Plan, movable: Movable, start: Float[np.ndarray, "4"], stop: Float[np.ndarray, "4"], rng: np.random.Generator
) -> Iterator[Take]:
    """Options for holding an object and moving it to another pose, in random order."""
    variants = [({grasp.side: grasp.place}, grasp.facing) for grasp in movable.grasps]
    variants += [(dict(zip(SIDES, (left, right))), facing) for left, right, facing in movable.sides]
    both = [len(places) == 2 for places, _ in variants]
    rank = rng.exponential(size=len(variants)) * np.where(both, sum(both), len(variants) - sum(both))
    for index in np.argsort(rank):  # one hand and both come first equally often
        places, facing = variants[index]
        choice = Take(movable, start, stop, places, float(facing), np.zeros(2))
        palm = turn(-facing) @ choice.middle[:2]
        ahead = plan.sole[1] + 0.07 + choice.extent[0] + rng.uniform(0.0, 0.08)
        if choice.beside:
            away = LEG_M + choice.extent[1] + rng.uniform(0.0, 0.05)
            local = np.array([rng.uniform(0.02, 0.16), choice.sign * away])
        elif choice.side is None:
            local = np.array([ahead + 0.02, 0.0])
        else:
            local = np.array([ahead, choice.sign * rng.uniform(0.08, 0.2) - palm[1]])
        yield Take(movable, start, stop, places, float(facing), local)


def lift(plan: Plan, choice: Errand, rng: np.random.Generator) -> Held:
    """Bend down, take hold and lift; the wearer stands at or near `choice.stand`. `plan.time` becomes the end.

    A `Take` becomes a `HeldObject`.
    """
    arrive(plan, rng, choice.stand)
    start, briskness = plan.time, plan.style.briskness
    bend, lean, aside = choice.bend(plan, choice.start, rng)
    down = (0.75 + 1.1 * bend) * rng.uniform(0.9, 1.25) / briskness
    touch = start + down
    begin = touch + rng.uniform(0.1, choice.wait_s)
    rise = (0.9 + choice.rise * bend) * rng.uniform(0.9, 1.3) / briskness
    up = begin, begin + rise
    bow(plan, start, touch, bend, lean, aside)
    # one bends to the other side when something heavy is carried at one side
    bow(plan, *up, 0.0, rng.normal(choice.upright, 0.03), 0.05 * choice.sign if choice.beside else 0.0)
    choice.move_free_hand(plan, bend, (start, start + choice.out * down), (touch, up[1]), rng)
    point = np.append(choice.start[:2], choice.start[3] + 0.8 * choice.movable.height)
    look_at(plan, point, (start, start + 0.5), (begin + 0.3 * rise, up[1]))
    plan.time = up[1] + rng.uniform(0.0, 0.3)
    if not isinstance(choice, Take):
        return Held(choice, start, touch, *up)
    shoulder = plan.shoulder
    shoulder[1] *= 0.0 if choice.side is None else choice.sign
    reach = plan.arm_length + float(np.linalg.norm(plan.skeleton.sites["left_palm"].t_joint_site))
    return HeldObject(choice, start, touch, *up, shoulder, reach, choice.carrying_pose(plan, reach, rng))


def put_down(plan: Plan, held: Held, rng: np.random.Generator) -> Handling:
    """Lower the object to its place, let go and stand up; the wearer stands at or near `choice.goal`."""
    choice = held.choice
    arrive(plan, rng, choice.goal)
    start, briskness = plan.time + 0.1, plan.style.briskness
    bend, lean, aside = choice.bend(plan, choice.stop, rng)
    lower = (1.0 + choice.lower * bend) * rng.uniform(0.9, 1.3) / briskness
    release = start + lower + rng.uniform(0.05, choice.release_s)
    rise = (0.8 + 1.0 * bend) * rng.uniform(0.9, 1.2) / briskness
    down = start, start + lower
    bow(plan, *down, bend, lean, aside)
    bow(plan, release, release + rise, 0.0, 0.0)
    choice.move_free_hand(plan, bend, down, (release + 0.3 * rise, release + rise), rng)
    look_at(plan, np.append(choice.stop[:2], choice.stop[3]), (start, start + 0.5), (release, release + 0.6))
    if isinstance(held, HeldObject):
        held.swing_with_strides(plan, start)
    moves = lambda times, chest: held.pose(times, chest, _OnTheWay(times, (held.lift_s, held.lifted_s), down))  # noqa: E731
    box = isinstance(choice, Carry)
    hover = (0.15, 0.22) if box else (0.05, 0.09) if choice.side else (0.12, 0.18)
    grips = []
    for side, place in choice.places.items():
        late = min(rng.exponential(0.12), 0.4) if box else 0.0
        reach_s, return_s = held.touch_s - held.start_s, float(np.clip(0.7 * rise, 0.4, 1.1))
        grip = Grip(place, moves, held.touch_s, release + late, reach_s, return_s, rng.uniform(*hover))
        plan.grip(side, grip)
        grips.append((side, grip))
    plan.time = release + rise + rng.uniform(0.0, 0.3)
    return Handling.of(choice.movable.name, "sliding", moves, grips)


def bend_for(plan: Plan, low: float, rng: np.random.Generator) -> tuple[float, float]:
    """Bend of the knees (m) and the trunk (rad) for palms at a height above the floor (m)."""
    drop = max(1.52 * plan.hip_height - low - 0.62 * plan.arm_length, 0.0)
    knees = float(np.clip(rng.normal(0.50, 0.08), 0.32, 0.66))
    lean = float(np.clip(0.12 + (1.45 - knees) * drop, 0.1, 1.05))
    return float(np.clip(knees * drop, 0.0, 0.46 * plan.hip_height)), lean


def bow(plan: Plan, start: float, stop: float, crouch: float, lean: float, aside: float = 0.0) -> None:
    """Bring knees (m) and trunk (rad; forwards, and to the right) to a bend between two times."""
    plan.crouch.move(start, stop, crouch)
    plan.lean.move(start, stop, (lean, aside, 0.0))
    lifted = crouch > DEEP * plan.hip_height
    first, last = (start + 0.3 * (stop - start), stop) if lifted else (start, stop - 0.4 * (stop - start))
    for side in SIDES:
        plan.heel_lift[side].move(first, last, HEELS_RAD if lifted else 0.0)


def keep_hands_aside(plan: Plan, out: tuple[float, float], back: tuple[float, float]) -> None:
    """Keep hands that do not hold the object beside it while bending over it."""
    for side in SIDES:
        plan.hands[side].take(OUT_OF_THE_WAY, out, back)
