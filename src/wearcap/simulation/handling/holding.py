"""Objects held in one hand or between both: lifted off the floor, carried at the side or before the body, put down."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.spatial
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.handling.carrying import DEEP, Errand, arrive, bend_for, bow, early, late, spread
from wearcap.simulation.handling.grips import Grip
from wearcap.simulation.handling.handlings import Handling, handling_of
from wearcap.simulation.people.actions import ON_THIGHS, hold
from wearcap.simulation.people.plan import LEFT_SIGN, SIDES, Plan
from wearcap.simulation.people.track import Track, ease
from wearcap.simulation.places.movables import Movable
from wearcap.simulation.places.outline import turn

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
SOFT_M = 0.02
"""Height that soft knees and a slouch take off a standing body."""
SWING_M, SWING_RAD = 0.05, 0.10
"""Swing of an object that hangs from a hand, forwards and back with each stride."""


@dataclass(frozen=True)
class Take(Errand):
    """A plan to take an object with one hand or both, not yet written to the motion's plan."""

    local: Float[np.ndarray, "2"]
    """Object's origin from the middle of the feet, ahead and to the left, when it is lifted and put down (m)."""

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
        return self.side is not None and self.movable.category in BESIDE

    @cached_property
    def extent(self) -> Float[np.ndarray, "2"]:
        """Half of its outline ahead and across, as the holder sees it (m)."""
        return np.abs(turn(self.facing).T) @ np.array(self.movable.half_size)

    def neutral(self) -> Float[np.ndarray, "3 3"]:
        """Rotation relative to the holder's heading while the keys' angles are zero: upright, or, for objects
        taken from above, with the back of the hand outwards and the fingers ahead."""
        if not self.lies:
            R = np.eye(3)
            R[:2, :2] = turn(-self.facing)
            return R
        place = next(iter(self.places.values()))
        here = _frame(np.array(place.normal), np.array(place.fingers))
        return _frame(np.array([0.0, self.sign, 0.0]), np.array([1.0, 0.0, 0.0])) @ here.T


def _frame(normal: np.ndarray, fingers: np.ndarray) -> Float[np.ndarray, "3 3"]:
    return np.stack([normal, fingers, np.cross(normal, fingers)], 1)


@dataclass
class Held:
    """An object in the hands: `go` keys its pose over time, `put_down` writes its grips."""

    choice: Take
    start_s: float
    """Time at which the plan begins to bend down for it."""
    touch_s: float
    lift_s: float
    lifted_s: float
    anchor: Float[np.ndarray, "3"]
    """The shoulder, or the middle between both, in the chest's axes (m)."""
    reach: float
    """Distance from shoulder to palm (m)."""
    carry: Float[np.ndarray, "6"]
    """Carrying pose, laid out as `keys`."""
    keys: Track = field(init=False)
    """The palms' middle from `anchor`, ahead, out and up along the body's heading (m), and the object's pitch
    (forwards), yaw (outwards) and roll (outer side up) against `Take.neutral` (rad)."""

    def __post_init__(self):
        self.keys = Track(self.carry)

    def go(
        self,
        start_s: float,
        stop_s: float,
        place: tuple[float, float, float],
        pitch: float = 0.0,
        yaw: float = 0.0,
        roll: float = 0.0,
    ) -> None:
        """Bring it to a place, as shares of the arm's reach, and angles (rad) between two times."""
        self.keys.move(start_s, stop_s, np.array([*(self.reach * np.array(place)), pitch, yaw, roll]))

    def return_to_carry(self, start_s: float, stop_s: float) -> None:
        """Return to the carrying pose between two times (s)."""
        self.keys.move(start_s, stop_s, self.carry)


def take_options(
    plan: Plan, movable: Movable, start: Float[np.ndarray, "4"], stop: Float[np.ndarray, "4"], rng: np.random.Generator
) -> Iterator[Take]:
    """Options for holding an object and moving it to another pose, in random order; see `carrying.carry_options`.

    The caller of one checks that the wearer can stand at its `stand` and `goal`, goes to the first, calls `take_up`,
    goes to the second and calls `put_down`.
    """
    start, stop = np.asarray(start, np.float64), np.asarray(stop, np.float64)
    variants = [({grasp.side: grasp.place}, grasp.facing) for grasp in movable.grasps]
    variants += [(dict(zip(SIDES, (left, right))), facing) for left, right, facing in movable.sides]
    both = [len(places) == 2 for places, _ in variants]
    rank = rng.exponential(size=len(variants)) * np.where(both, sum(both), len(variants) - sum(both))
    for index in np.argsort(rank):  # one hand and both come first equally often
        places, facing = variants[index]
        choice = Take(movable, start, stop, places, float(facing), np.zeros(2))
        palm = turn(-facing) @ choice.middle[:2]
        ahead = plan.sole[1] + 0.07 + choice.extent[0] + float(rng.uniform(0.0, 0.08))
        if choice.beside:
            away = LEG_M + choice.extent[1] + float(rng.uniform(0.0, 0.05))
            local = np.array([float(rng.uniform(0.02, 0.16)), choice.sign * away])
        elif choice.side is None:
            local = np.array([ahead + 0.02, 0.0])
        else:
            local = np.array([ahead, choice.sign * float(rng.uniform(0.08, 0.2)) - palm[1]])
        yield Take(movable, start, stop, places, float(facing), local)


def take_up(plan: Plan, choice: Take, rng: np.random.Generator) -> Held:
    """Bend down, take hold and lift; the wearer stands at or near `choice.stand`. `plan.time` becomes the end."""
    arrive(plan, choice.stand, rng)
    start = plan.time
    bend, lean, aside = _bend(plan, choice, choice.start, rng)
    down = float((0.75 + 1.1 * bend) * rng.uniform(0.9, 1.25) / plan.style.briskness)
    touch = start + down
    begin = touch + float(rng.uniform(0.1, 0.4))
    rise = float((0.9 + 1.1 * bend) * rng.uniform(0.9, 1.3) / plan.style.briskness)
    bow(plan, start, touch, bend, lean, aside)
    bow(plan, begin, begin + rise, 0.0, float(rng.normal(-0.03, 0.03)), _counter(choice))
    _other_hand(plan, choice, bend, (start, start + 0.5 * down), (touch, begin + rise), rng)
    plan.gaze_point.move(start, start, np.append(choice.start[:2], choice.start[3] + 0.8 * choice.movable.height))
    plan.gaze_weight.move(start, start + 0.5, 0.9)
    plan.gaze_weight.move(begin + 0.3 * rise, begin + rise, 0.0)
    plan.time = begin + rise + float(rng.uniform(0.0, 0.3))
    shoulder = shoulder_of(plan)
    if choice.side is None:
        shoulder[1] = 0.0
    shoulder[1] *= choice.sign
    reach = plan.arm_length + float(np.linalg.norm(plan.skeleton.sites["left_palm"].t_joint_site))
    return Held(choice, start, touch, begin, begin + rise, shoulder, reach, _carried(plan, choice, reach, rng))


def put_down(plan: Plan, held: Held, rng: np.random.Generator) -> Handling:
    """Lower the object to its place, let go and stand up; the wearer stands at or near `choice.goal`."""
    choice = held.choice
    arrive(plan, choice.goal, rng)
    start = plan.time + 0.1
    bend, lean, aside = _bend(plan, choice, choice.stop, rng)
    down = float((1.0 + 1.1 * bend) * rng.uniform(0.9, 1.3) / plan.style.briskness)
    release = start + down + float(rng.uniform(0.05, 0.35))
    rise = float((0.8 + 1.0 * bend) * rng.uniform(0.9, 1.2) / plan.style.briskness)
    bow(plan, start, start + down, bend, lean, aside)
    bow(plan, release, release + rise, 0.0, 0.0)
    _other_hand(plan, choice, bend, (start, start + down), (release + 0.3 * rise, release + rise), rng)
    plan.gaze_point.move(start, start, np.append(choice.stop[:2], choice.stop[3]))
    plan.gaze_weight.move(start, start + 0.5, 0.9)
    plan.gaze_weight.move(release, release + 0.6, 0.0)
    moves = _HeldPath(held, strides(plan, held, start), (held.lift_s, held.lifted_s), (start, start + down))
    grips = []
    for side, place in choice.places.items():
        grip = Grip(
            place,
            moves,
            held.touch_s,
            release,
            held.touch_s - held.start_s,
            float(np.clip(0.7 * rise, 0.4, 1.1)),
            float(rng.uniform(0.05, 0.09) if choice.side else rng.uniform(0.12, 0.18)),
        )
        plan.grip(side, grip)
        grips.append((side, grip))
    plan.time = release + rise + float(rng.uniform(0.0, 0.3))
    return handling_of(choice.movable.name, "sliding", moves, grips)


def shoulder_of(plan: Plan) -> Float[np.ndarray, "3"]:
    """Position of the left shoulder relative to the chest's joint in the rest pose (m)."""
    skeleton = plan.skeleton
    arm = skeleton.indices("left_collar", "left_shoulder")
    return skeleton.t_parent_joint[arm].double().sum(0).numpy().copy()


def shoulder_height(plan: Plan) -> float:
    """Height of the shoulders above the floor when standing upright (m)."""
    spine = plan.skeleton.indices("l5", "l3", "t12", "t8")
    above = float(plan.skeleton.t_parent_joint[spine, 2].sum()) + float(shoulder_of(plan)[2])
    return plan.hip_height + above - SOFT_M


def _bend(plan: Plan, choice: Take, pose: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float]:
    """Bend of the knees (m) and the trunk (rad; forwards, to the right) for the palms on an object at a pose."""
    low = float(pose[3] + choice.middle[2] - plan.position[2])
    if choice.side is None:
        return *bend_for(plan, low, rng), 0.0
    if not choice.beside:
        bend, lean = bend_for(plan, low + 0.18 * plan.arm_length, rng)
        return bend, lean, -0.06 * choice.sign
    drop = max(shoulder_height(plan) - low - 0.98 * plan.arm_length, 0.0)
    knees = float(np.clip(rng.normal(0.45, 0.1), 0.25, 0.65))
    bend = float(np.clip(knees * drop, 0.0, 0.4 * plan.hip_height))
    return bend, float(np.clip(0.10 + (1.3 - knees) * drop, 0.08, 0.8)), -0.12 * choice.sign


def _counter(choice: Take) -> float:
    """Bend to the other side when something heavy is carried at one side (rad, to the right)."""
    return 0.05 * choice.sign if choice.beside else 0.0


def _other_hand(
    plan: Plan, choice: Take, bend: float, out: tuple[float, float], back: tuple[float, float], rng
) -> None:
    """Put the free hand on the thigh while the knees bend, or let it hang; two hands come from beside the object."""
    if choice.side is None:
        spread(plan, out, back)
    elif bend > 0.5 * DEEP * plan.hip_height or rng.random() < 0.3:
        hold(plan, (SIDES[1 - SIDES.index(choice.side)],), ON_THIGHS, out[0], back[1] + 0.1, rng)


def _carried(plan: Plan, choice: Take, reach: float, rng: np.random.Generator) -> Float[np.ndarray, "6"]:
    """Carrying pose in walking, as `Held.keys`: beside a leg, ahead at arm's length, or before the body."""
    shoulder, tall = shoulder_of(plan), shoulder_height(plan)
    out, up = 0.0, np.zeros(6)
    if choice.beside:
        palm = abs(float((turn(-choice.facing) @ choice.middle[:2])[1]))
        out = LEG_M + choice.extent[1] + palm - shoulder[1]
        hangs = np.sqrt(max((STRETCH * reach) ** 2 - out**2, 0.0))
        up[:3] = [rng.uniform(0.0, 0.06), out, -min(hangs, tall - choice.middle[2] - OFF_FLOOR_M)]
    elif choice.side is None:
        near = choice.extent[0] + rng.uniform(0.15, 0.20)
        up[:3] = [near, 0.0, -rng.uniform(0.40, 0.58) * reach]
    elif choice.long:
        up[:4] = [0.42 * reach, 0.06, -0.50 * reach, -rng.uniform(0.8, 1.0)]
    elif rng.random() < 0.45:
        pitch = rng.uniform(1.0, 1.25) if choice.lies else rng.uniform(0.45, 0.7)
        up[:4] = [0.08, rng.uniform(0.05, 0.09), -0.91 * reach, pitch]
    else:
        pitch = rng.uniform(-0.1, 0.4) if choice.lies else rng.uniform(-0.1, 0.15)
        up[:4] = [0.50 * reach, rng.uniform(-0.03, 0.04), -rng.uniform(0.45, 0.58) * reach, pitch]
    return up


def strides(plan: Plan, held: Held, until_s: float) -> Track:
    """Swing of the hand, opposite to the foot of its side, -1…1, between the end of the lift and a time (s)."""
    track, last = Track(np.zeros(1)), held.lifted_s
    prints = [(p, side) for side in SIDES for p in plan.prints[side] if held.lifted_s < p.land_s < until_s]
    for print_, side in sorted(prints, key=lambda pair: pair[0].land_s):
        other = [p for p in plan.prints[SIDES[1 - SIDES.index(side)]] if p.land_s < print_.land_s][-1]
        ahead = np.array([np.cos(print_.heading), np.sin(print_.heading)])
        step = float((print_.ground - other.ground)[:2] @ ahead)
        size = float(np.clip(step / 0.6, -1.0, 1.2))
        if print_.land_s > last + 0.2:
            track.move(max(last, print_.land_s - 0.7), print_.land_s, -held.choice.sign * LEFT_SIGN[side] * size)
            last = print_.land_s
    track.move(last, last + 0.7, 0.0)
    return track


@dataclass(frozen=True)
class _HeldPath:
    """Pose of a held object over time: where it stands, in the hands, and where it will stand."""

    held: Held
    strides: Track
    up: tuple[float, float]
    down: tuple[float, float]

    def __call__(self, times: Float[np.ndarray, "time"], T_world_chest: Rigid) -> Rigid:
        choice = self.held.choice
        lift, lower, near, off = (
            torch.from_numpy(ease((times - start) / (stop - start)))
            for start, stop in (self.up, self.down, late(self.up), early(self.down))
        )
        point, R = self._in_hand(times, T_world_chest)
        middle = torch.from_numpy(choice.middle)
        R_first, R_last = (rotation.about_axis("z", torch.tensor(pose[2])) for pose in (choice.start, choice.stop))
        first, last = (
            torch.from_numpy(pose[[0, 1, 3]]) + R_pose @ middle
            for pose, R_pose in ((choice.start, R_first), (choice.stop, R_last))
        )
        share = torch.stack([near, near, lift], -1), torch.stack([off, off, lower], -1)
        point = point + (1 - share[0]) * (first - point) + share[1] * (last - point)
        turned = (near, off) if choice.long else (lift, lower)
        R = _between(R_first.expand_as(R), R, turned[0])
        R = _between(R, R_last.expand_as(R), turned[1])
        t = point - R @ middle
        off_floor = self._raise(R, t, (LONG_LIFTED_M if choice.long else LIFTED_M) * lift * (1 - lower))
        return Rigid(R, t + off_floor[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))

    def _in_hand(
        self, times: np.ndarray, T_world_chest: Rigid
    ) -> tuple[Float[Tensor, "time 3"], Float[Tensor, "time 3 3"]]:
        """Middle of the palms (m) and rotation of the object if it were held all the time."""
        choice, about = self.held.choice, rotation.about_axis
        keys = torch.from_numpy(self.held.keys.sample(times))
        swing = torch.from_numpy(self.strides.sample(times)[:, 0])
        hangs = 0.0 if choice.side is None else 1.0 if choice.beside else 0.4
        keys[:, 0] += hangs * SWING_M * swing
        keys[:, 3] -= hangs * SWING_RAD * swing
        yaw = rotation.yaw_of(T_world_chest.R).double()
        R_heading = about("z", yaw)
        mirror = torch.tensor([1.0, choice.sign, 1.0], dtype=torch.float64)
        anchor = T_world_chest.t.double() + T_world_chest.R.double() @ torch.from_numpy(self.held.anchor)
        point = anchor + (R_heading @ (keys[:, :3] * mirror)[..., None])[..., 0]
        turned = about("z", choice.sign * keys[:, 4]) @ about("y", keys[:, 3]) @ about("x", choice.sign * keys[:, 5])
        return point, R_heading @ turned @ torch.from_numpy(choice.neutral())

    def _raise(
        self, R: Float[Tensor, "time 3 3"], t: Float[Tensor, "time 3"], soft: Float[Tensor, "time"]
    ) -> Float[Tensor, "time"]:
        """Height to add so that the object keeps off the floor (m), smooth over `soft` (m)."""
        below = self.held.choice.start[3] - t[:, 2] - (R[:, 2] @ self._corners.T).amin(-1)
        return (below + torch.sqrt(below**2 + soft**2 + 1e-18)) / 2

    @cached_property
    def _corners(self) -> Float[Tensor, "corner 3"]:
        vertices = self.held.choice.movable.object.mesh.vertices.astype(np.float64)
        return torch.from_numpy(vertices[scipy.spatial.ConvexHull(vertices).vertices])


def _between(
    R: Float[Tensor, "time 3 3"], R_other: Float[Tensor, "time 3 3"], share: Float[Tensor, "time"]
) -> Float[Tensor, "time 3 3"]:
    """Interpolation between two rotations by a share."""
    return R @ rotation.exp(share[:, None] * rotation.log(R.transpose(-1, -2) @ R_other))
