"""Opening and closing doors, windows, cabinet doors and drawers: a hand on the handle, the body clear of the leaf.

The wearer's standing places keep within reach of the handle and clear of obstacles: places on a grid have a cost at
every key, and the cheapest path through them is found by dynamic programming.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearsim.handling.distractors import Manner, pretend_to_handle, rest_on
from wearsim.handling.grips import Grip, Handling
from wearsim.people.actions import approach
from wearsim.people.plan import LEFT_SIGN, SIDES, Plan, wrap
from wearsim.people.posture import look_at
from wearsim.people.track import ease
from wearsim.people.walking import shuffle
from wearsim.places.interactive_flat import House
from wearsim.places.openables import Openable
from wearsim.places.outline import distance_to_convex
from wearsim.places.world import World

KEY_S = 0.2
NEAR_M = 2.2
"""Distance from the handle's path up to which objects are checked for collisions."""
OTHER_HAND, FLAT, FLAT_M = 0.4, 0.5, 0.8
"""Probability of using the hand with the higher cost, and of pushing with the palm where the handle is
higher above the floor than the last (m)."""
YAW_MOST = 1.1
"""Largest rotation of a hand on its handle (rad)."""
EARLY = 0.25
"""Probability of letting go of a leaf that still moves."""
BEYOND_M = 0.4
"""Preferred distance beyond a leaf's edge."""
OUT_RAD, OUT_M = 0.25, 0.08
"""Opening from which on no part of a leaf or a drawer's front is within its frame."""
PALM_M = 0.085
"""Distance from wrist to palm."""

SPACING_M = 0.07
AROUND_M = 1.15
"""Distance from the handle's path within which places are considered."""
BODY_M, ARM_M = 0.25, 0.02
"""Half the width that a body needs, and an arm."""
EASY_M = 0.12
"""Additional clearance over `BODY_M` up to which the cost falls."""
STEP_M = 0.30
"""Largest step between two keys."""
HELP_M = 0.30
"""Distance beyond an arm's reach that the trunk can cover."""
ASIDE = 0.35
"""Preferred bearing of a hand to its own side of the body's heading (rad)."""
SHOULDER_ASIDE_M = 0.18


@dataclass(frozen=True)
class _Turn:
    """One use of an openable: from value to value with a hand on one of its handles."""

    item: Openable
    start: float
    stop: float
    handle: int
    side: str
    seconds: float
    places: Float[np.ndarray, "key 3"]
    """Floor points between the feet (m) and headings (rad, unwrapped) at evenly spaced times."""

    @classmethod
    def planned(
        cls, plan: Plan, house: House, world: World, rng: np.random.Generator, item: Openable, value: float, handle: int
    ) -> "_Turn | None":
        """Hand, tempo and body path; None where the leaf or drawer would hit something or one cannot stand for it."""
        start, floor = house.values[item.name], float(plan.position[2])
        shoulder = floor + 1.50 * plan.hip_height
        amount = abs(value - start) / (np.deg2rad(80.0) if item.hinged else 0.4)
        seconds = float(np.clip((0.9 + 1.3 * amount) * rng.normal(1.0, 0.12) / plan.style.briskness, 1.0, 3.2))
        values = start + ease(np.linspace(0.0, 1.0, max(round(seconds / KEY_S), 6))) * (value - start)
        palm_m = float(item.handle(handle, start)[2]) - floor
        pushed = (value - start) * item.opening_sign * (1 if handle == 0 else -1) < 0
        place = item.handles[handle].varied(rng, 0.3, 0.25)
        if pushed and palm_m > FLAT_M and rng.random() < FLAT:
            place = item.pushed_at(handle, rng)
        item = replace(item, handles=(*item.handles[:handle], place, *item.handles[handle + 1 :]))
        palms = item.handle(handle, values)
        near = [
            other
            for other in world.objects
            if other.name != item.name and distance_to_convex(palms[:, :2], other.footprint).min() < NEAR_M
        ]
        # once it is out of its frame, a leaf or drawer may not meet other objects
        out = item.footprint(values[np.abs(values - item.closed) > (OUT_RAD if item.hinged else OUT_M)])
        edges = np.concatenate([out[:, (1, 2)], out[:, (1, 2)].mean(1, keepdims=True)], 1)
        low, high = item.z_range
        level = [other for other in near if other.z_range[0] < high - 0.02 and other.z_range[1] > low + 0.02]
        if any((distance_to_convex(edges, other.footprint) < 0.015).any() for other in level):
            return None
        solid = [other for other in near if other.z_range[0] < floor + 1.9 and other.z_range[1] > floor + 0.1]
        in_arms_way = [o for o in solid if o.z_range[1] > palms[0, 2] - 0.05 and o.z_range[0] < shoulder]
        pivot, beyond = item.object.freedom.pivot, None
        if item.hinged and not handle and pivot is not None:
            beyond = np.array(pivot[:2]), float(item.outline[:, 0].max()) + BEYOND_M
        task = _Task(
            palms,
            item.footprint(values),
            tuple(other.footprint for other in solid),
            tuple(other.footprint for other in in_arms_way),
            1.0,
            shoulder,
            plan.arm_length + PALM_M,
            low=bool(high < palms[0, 2] + 0.2),
            beyond=beyond,
        )
        walkable = world.navigation.node_points[:, :2]
        walkable = walkable[np.linalg.norm(walkable - palms[0, :2], axis=1) < 2.0]
        found = [(side, replace(task, sign=LEFT_SIGN[side]).stances(walkable, rng)) for side in SIDES]
        able = [(*stances, side) for side, stances in found if stances is not None]
        if not able:
            return None
        able.sort(key=lambda option: option[0])
        other = rng.random() < OTHER_HAND and able[-1][0] < able[0][0] + 8.0
        _, places, side = able[-1 if other else 0]
        return cls(item, start, value, handle, side, seconds, places)

    def values(self, share: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
        return self.start + ease(share) * (self.stop - self.start)

    def perform(self, plan: Plan, house: House, rng: np.random.Generator) -> None:
        """Write the grip, the steps, the object's motion and the interactions."""
        item, start, briskness = self.item, plan.time, plan.style.briskness
        touch = start + 0.75 / briskness
        begin = touch + 0.05 + min(rng.exponential(0.4), 2.0)
        stop = begin + self.seconds
        release = stop + 0.02 + min(rng.exponential(0.5), 3.0)
        if item.hinged and rng.random() < EARLY:
            release = begin + rng.uniform(0.8, 0.95) * self.seconds
        count = max(round(self.seconds * 30), 8)
        here = np.array([*plan.position[:2], self.places[0, 2] + wrap(plan.heading - self.places[0, 2])])
        fade = np.linspace(1.0, 0.0, len(self.places))[:, None] ** 2
        # the body's path at even times, smooth, its ends kept
        keys = self.places + fade * (here - self.places[0])
        at = np.linspace(0.0, len(keys) - 1.0, count)
        fine = np.stack([np.interp(at, np.arange(len(keys)), column) for column in keys.T], 1)
        sigma = 0.9 * count / len(keys)
        reach = max(int(3 * sigma), 1)
        padded = np.concatenate([np.repeat(fine[:1], reach, 0), fine, np.repeat(fine[-1:], reach, 0)])
        path = scipy.ndimage.gaussian_filter1d(padded, sigma, axis=0)[reach : reach + count]
        times = np.linspace(begin, stop, count)
        place = item.handles[self.handle]
        # the hand turns on the handle so that the fingers point along the arm
        values = self.values(np.linspace(0.0, 1.0, count))
        held, pose = item.handle(self.handle, values), item.pose(values)
        fingers = (pose.R.numpy() @ np.array(place.fingers))[:, :2]
        across = np.stack([-np.sin(path[:, 2]), np.cos(path[:, 2])], 1)
        arm = held[:, :2] - path[:, :2] - 0.18 * LEFT_SIGN[self.side] * across
        angle = np.arctan2(fingers[:, 0] * arm[:, 1] - fingers[:, 1] * arm[:, 0], (fingers * arm).sum(1))
        yaw = (0.0 if place.flat else YAW_MOST) * np.tanh(np.unwrap(angle) / YAW_MOST)

        def poses(at: Float[np.ndarray, "time"], chest: Rigid) -> Rigid:
            return item.pose(self.values((at - begin) / self.seconds))

        def hand_poses(at: Float[np.ndarray, "time"], chest: Rigid) -> Rigid:
            pose = poses(at, chest)
            about = rotation.about_axis("z", torch.from_numpy(np.interp(at, times, yaw)))
            point = torch.tensor(place.point, dtype=torch.float64)
            R, palm = about @ pose.R, (pose.R @ point[:, None])[..., 0] + pose.t
            return Rigid(R, palm - (R @ point[:, None])[..., 0])

        grip = replace(Grip.drawn(place, hand_poses, touch, release, rng, briskness), reach_s=touch - start)
        plan.grip(self.side, grip)
        middle = begin + 0.5 * self.seconds
        handle = item.handle(self.handle, np.array(self.start))
        look_at(plan, handle, (start, start + 0.45), (middle, middle + 0.6), 0.8)
        body = lambda at: np.stack([np.interp(at, times, column) for column in path.T], 1)  # noqa: E731
        shuffle(plan, rng, body, begin - 0.1, stop)
        contact_class = item.object.freedom.contact_class
        house.handlings.append(Handling.of(item.name, contact_class, poses, [(self.side, grip)], stop))
        house.values[item.name] = self.stop
        plan.time = max(plan.time, release, stop)


def operate(
    plan: Plan,
    house: House,
    rng: np.random.Generator,
    item: Openable,
    value: float,
    handle: int = 0,
    manner: Manner = "move",
) -> bool:
    """Go to an openable and bring it to a value by one of its handles; False, with nothing done, if impossible.

    In the manner "rest" it is held without being moved; in "pretend" nothing is touched (`Manner`).
    """
    world = house.world(plan.position)
    turn = _Turn.planned(plan, house, world, rng, item, value, handle)
    if turn is None:
        return False
    x, y, heading = turn.places[0]
    goal = np.array([x, y, plan.position[2]])
    far = np.linalg.norm(goal[:2] - plan.position[:2]) > 0.1 or abs(wrap(heading - plan.heading)) > 0.3
    if far and not approach(plan, world, rng, goal, heading):
        return False
    places, pose = {turn.side: turn.item.handles[handle]}, item.pose(turn.start)
    if manner == "move":
        turn.perform(plan, house, rng)
    elif manner == "rest":
        house.handlings.append(rest_on(plan, item.object, places, pose, rng))
    else:
        pretend_to_handle(plan, places, pose, places[turn.side].point[2], rng)
    return True


@dataclass(frozen=True)
class _Task:
    """Path of a handle and of the object that moves with it; keys are evenly spaced in time."""

    handle: Float[np.ndarray, "key 3"]
    """Position of the palm (m)."""
    footprint: Float[np.ndarray, "key 4 2"]
    """Outline of the moved object."""
    solid: tuple[Float[np.ndarray, "corner 2"], ...]
    """Outlines of obstacles for the body."""
    high: tuple[Float[np.ndarray, "corner 2"], ...]
    """Outlines of the obstacles that an arm cannot pass over."""
    sign: float
    """1 for the left hand, -1 for the right."""
    shoulder_m: float
    """Height of the shoulders (m)."""
    reach_m: float
    """Distance from shoulder to palm."""
    low: bool = False
    """Whether the moved object is so low that an arm passes over it."""
    beyond: tuple[Float[np.ndarray, "2"], float] | None = None
    """A point, and the preferred distance from it (m): who pulls a leaf does not step behind it."""

    def stances(
        self, walkable: Float[np.ndarray, "point 2"], rng: np.random.Generator
    ) -> tuple[float, Float[np.ndarray, "key 3"]] | None:
        """The cost of the cheapest path and its floor points and headings (m, m, rad unwrapped) at the task's keys.

        None where none is free; it begins within 0.45 m of a walkable point.
        """
        low, high = self.handle[:, :2].min(0) - AROUND_M, self.handle[:, :2].max(0) + AROUND_M
        axes = [np.arange(a, b, SPACING_M) for a, b in zip(low, high)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        points += rng.uniform(-0.5, 0.5, 2) * SPACING_M
        near = np.linalg.norm(points[:, None] - self.handle[None, :, :2], axis=-1).min(1) < AROUND_M
        points = points[near]
        room = np.min([distance_to_convex(points, outline) for outline in self.solid], 0)
        points, room = points[room >= BODY_M], room[room >= BODY_M]
        if not len(points) or not len(walkable):
            return None
        cost, heading = self.rated(points, room)
        cost += 0.15 * rng.standard_normal(len(points))
        away = np.linalg.norm(points[:, None] - walkable[None], axis=-1).min(1)
        cost[0, away > 0.45] = np.inf
        # the points by key with the least sum of their costs and of squared distances between them
        usable = np.isfinite(cost).any(0)
        points, cost, heading = points[usable], cost[:, usable], heading[:, usable]
        if not len(points):
            return None
        step = np.linalg.norm(points[:, None] - points[None], axis=-1)
        change = np.where(step > STEP_M, np.inf, (step / 0.11) ** 2)
        total, came = cost[0], []
        for key in range(1, len(cost)):
            through = total[:, None] + change
            best = through.argmin(0)
            came.append(best)
            total = through[best, np.arange(len(points))] + cost[key]
        if not np.isfinite(total).any():
            return None
        path = [int(total.argmin())]
        for best in reversed(came):
            path.append(int(best[path[-1]]))
        path.reverse()
        facing = np.unwrap(heading[np.arange(len(path)), path])
        return float(total.min()), np.column_stack([points[path], facing])

    def rated(
        self, points: Float[np.ndarray, "point 2"], room: Float[np.ndarray, "point"]
    ) -> tuple[Float[np.ndarray, "key point"], Float[np.ndarray, "key point"]]:
        """Cost of standing at each point at each key, infinite where it is impossible, and the heading there."""
        offset = self.handle[:, None, :2] - points
        toward = np.arctan2(offset[..., 1], offset[..., 0])
        heading = toward - self.sign * ASIDE
        across = np.stack([-np.sin(heading), np.cos(heading)], -1)
        shoulder = points + self.sign * SHOULDER_ASIDE_M * across
        arm = self.handle[:, None, :2] - shoulder
        far = np.linalg.norm(arm, axis=-1)
        drop = np.minimum(np.abs(self.shoulder_m - self.handle[:, 2]), 0.8 * self.reach_m)[:, None]
        best = np.clip(np.sqrt((0.88 * self.reach_m) ** 2 - drop**2), 0.30, 0.55)
        cost = ((far - best) / 0.14) ** 2
        cost = np.where(far > best + HELP_M, np.inf, cost)
        if self.beyond is not None:
            pivot, radius = self.beyond
            cost += 4.0 * np.maximum(radius - np.linalg.norm(points - pivot, axis=1), 0.0) / 0.15
        leaf = np.stack([distance_to_convex(points, outline) for outline in self.footprint])
        free = np.minimum(leaf, room)
        cost += 2.0 * np.maximum(BODY_M + EASY_M - free, 0.0) / EASY_M
        cost[leaf < BODY_M] = np.inf
        # the straight arm, except its last 7 cm, may not pass through the moved object or another
        last = np.clip(1.0 - 0.07 / np.maximum(far, 0.1), 0.0, 1.0)[..., None]
        for share in np.linspace(0.25, 1.0, 7):
            along = shoulder + share * last * arm
            for key, outline in enumerate(self.footprint if not self.low else ()):
                cost[key, _within(along[key], outline, 0.01 if share == 1.0 else ARM_M)] = np.inf
            for outline in self.high if share < 0.9 else ():
                cost[_within(along, outline, ARM_M)] = np.inf
        return cost, heading


def _within(
    points: Float[np.ndarray, "*batch 2"], outline: Float[np.ndarray, "corner 2"], margin: float
) -> Bool[np.ndarray, "*batch"]:
    """Whether points lie in a convex counter-clockwise outline whose sides are moved outwards by a margin (m)."""
    inside = np.ones(points.shape[:-1], bool)
    x, y = points[..., 0], points[..., 1]
    for start, end in zip(outline, np.roll(outline, -1, axis=0)):
        edge = end - start
        inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) > -margin * np.hypot(*edge)
    return inside
