"""Opening and closing doors, windows, cabinet doors and drawers: a hand on the handle, the body clear of the leaf."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.simulation.handling.grips import drawn_grip
from wearcap.simulation.handling.handlings import handling_of
from wearcap.simulation.handling.house import Distractor, House
from wearcap.simulation.handling.stances import Stances, Task, find_stances, smooth_path
from wearcap.simulation.people.actions import approach
from wearcap.simulation.people.plan import LEFT_SIGN, SIDES, Plan, wrap
from wearcap.simulation.people.shuffling import shuffle
from wearcap.simulation.people.track import ease
from wearcap.simulation.places.openables import Openable
from wearcap.simulation.places.outline import distance_to_convex
from wearcap.simulation.places.world import World, WorldObject

KEY_S = 0.2
NEAR_M = 2.2
"""Distance from the handle's path up to which objects are checked for collisions."""
OTHER_HAND = 0.25
"""Probability of using the hand with the higher cost."""
YAW_MOST = 1.1
"""Largest rotation of a hand on its handle (rad)."""
BEYOND_M = 0.4
"""Preferred distance beyond a leaf's edge."""
OUT_RAD, OUT_M = 0.25, 0.08
"""Opening from which on no part of a leaf or a drawer's front is within its frame."""
PALM_M = 0.085
"""Distance from wrist to palm."""


@dataclass(frozen=True)
class Turn:
    """One use of an openable: from value to value with a hand on one of its handles."""

    item: Openable
    start: float
    stop: float
    handle: int
    side: str
    seconds: float
    stances: Stances

    def values(self, share: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time"]:
        return self.start + ease(share) * (self.stop - self.start)


def operate(
    plan: Plan,
    house: House,
    rng: np.random.Generator,
    item: Openable,
    value: float,
    handle: int = 0,
    distractor: Distractor | None = None,
) -> bool:
    """Go to an openable and bring it to a value by one of its handles; False, with nothing done, if impossible.

    With `distractor`, that act is done there instead, and nothing is touched.
    """
    world = house.world(plan.position)
    turn = plan_turn(plan, house, world, rng, item, value, handle)
    if turn is None:
        return False
    first = turn.stances.places[0]
    goal = np.array([first[0], first[1], plan.position[2]])
    far = np.linalg.norm(goal[:2] - plan.position[:2]) > 0.1 or abs(wrap(first[2] - plan.heading)) > 0.3
    if far and not approach(plan, world, rng, goal, float(first[2])):
        return False
    if distractor is not None:
        distractor(plan, {turn.side: item.handles[handle]}, item.pose(turn.start), item.handles[handle].point[2], rng)
    else:
        _perform(plan, house, turn, rng)
    return True


def plan_turn(
    plan: Plan, house: House, world: World, rng: np.random.Generator, item: Openable, value: float, handle: int
) -> Turn | None:
    """Hand, tempo and body path; None where the leaf or drawer would hit something or one cannot stand for it."""
    start, shoulder = house.values[item.name], 1.50 * plan.hip_height
    amount = abs(value - start) / (np.deg2rad(80.0) if item.hinged else 0.4)
    seconds = float(np.clip((0.9 + 1.3 * amount) * rng.normal(1.0, 0.12) / plan.style.briskness, 1.0, 3.2))
    keys = max(round(seconds / KEY_S), 6)
    values = start + ease(np.linspace(0.0, 1.0, keys)) * (value - start)
    palms, footprint = item.handle(handle, values), item.footprint(values)
    near = [
        other
        for other in world.objects
        if other.name != item.name and distance_to_convex(palms[:, :2], other.footprint).min() < NEAR_M
    ]
    if _hits(item, values, near):
        return None
    floor = float(plan.position[2])
    solid = [other for other in near if other.z_range[0] < floor + 1.9 and other.z_range[1] > floor + 0.1]
    high = [other for other in solid if other.z_range[1] > palms[0, 2] - 0.05 and other.z_range[0] < floor + shoulder]
    task = Task(
        palms,
        footprint,
        tuple(other.footprint for other in solid),
        tuple(other.footprint for other in high),
        1.0,
        floor + shoulder,
        plan.arm_length + PALM_M,
        low=bool(item.z_range[1] < palms[0, 2] + 0.2),
        beyond=_beyond(item, handle),
    )
    walkable = world.navigation.node_points[:, :2]
    walkable = walkable[np.linalg.norm(walkable - palms[0, :2], axis=1) < 2.0]
    found = [(side, find_stances(replace(task, sign=LEFT_SIGN[side]), walkable, rng)) for side in SIDES]
    able = [(stances.cost, side, stances) for side, stances in found if stances is not None]
    if not able:
        return None
    able.sort(key=lambda option: option[0])
    other = rng.random() < OTHER_HAND and able[-1][0] < able[0][0] + 8.0
    _, side, stances = able[-1 if other else 0]
    return Turn(item, start, value, handle, side, seconds, stances)


def _beyond(item: Openable, handle: int) -> tuple[Float[np.ndarray, "2"], float] | None:
    if not item.hinged or handle:
        return None
    pivot, width = item.object.freedom.pivot, float(item.outline[:, 0].max())
    assert pivot is not None
    return np.array(pivot[:2]), width + BEYOND_M


def _hits(item: Openable, values: Float[np.ndarray, "key"], near: list[WorldObject]) -> bool:
    """Whether a leaf or drawer, once it is out of its frame, meets other objects."""
    others = [
        other.footprint
        for other in near
        if other.z_range[0] < item.z_range[1] - 0.02 and other.z_range[1] > item.z_range[0] + 0.02
    ]
    out = values[np.abs(values - item.closed) > (OUT_RAD if item.hinged else OUT_M)]
    footprint = item.footprint(out)
    edges = np.concatenate([footprint[:, (1, 2)], footprint[:, (1, 2)].mean(1, keepdims=True)], 1)
    return any((distance_to_convex(edges, outline) < 0.015).any() for outline in others)


def _perform(plan: Plan, house: House, turn: Turn, rng: np.random.Generator) -> None:
    """Write the grip, the steps, the object's motion and the interactions."""
    item, start = turn.item, plan.time
    touch = start + 0.75 / plan.style.briskness
    begin = touch + float(rng.uniform(0.05, 0.25))
    stop = begin + turn.seconds
    release = stop + float(rng.uniform(0.02, 0.25))
    count = max(round(turn.seconds * 30), 8)
    places = turn.stances.places.copy()
    here = np.array([*plan.position[:2], places[0, 2] + wrap(plan.heading - places[0, 2])])
    fade = np.linspace(1.0, 0.0, len(places))[:, None] ** 2
    path = smooth_path(places + fade * (here - places[0]), count)
    times = np.linspace(begin, stop, count)

    def poses(at: Float[np.ndarray, "time"]) -> Rigid:
        return item.pose(turn.values((at - begin) / turn.seconds))

    yaw = _hand_yaw(plan, turn, path)

    def moves(at: Float[np.ndarray, "time"], chest: Rigid) -> Rigid:
        pose = poses(at)
        about = rotation.about_axis("z", torch.from_numpy(np.interp(at, times, yaw)))
        point = torch.tensor(item.handles[turn.handle].point, dtype=torch.float64)
        R, palm = about @ pose.R, (pose.R @ point[:, None])[..., 0] + pose.t
        return Rigid(R, palm - (R @ point[:, None])[..., 0])

    grip = drawn_grip(item.handles[turn.handle], moves, touch, release, rng, plan.style.briskness)
    grip = replace(grip, reach_s=touch - start)
    plan.grip(turn.side, grip)
    plan.gaze_point.move(start, start, item.handle(turn.handle, np.array(turn.start)))
    plan.gaze_weight.move(start, start + 0.45, 0.8)
    plan.gaze_weight.move(begin + 0.5 * turn.seconds, begin + 0.5 * turn.seconds + 0.6, 0.0)
    body = lambda at: np.stack([np.interp(at, times, column) for column in path.T], 1)  # noqa: E731
    shuffle(plan, rng, body, begin - 0.1, stop)
    contact_class = item.object.freedom.contact_class
    house.handlings.append(handling_of(item.name, contact_class, lambda at, chest: poses(at), [(turn.side, grip)]))
    house.values[item.name] = turn.stop
    plan.time = max(plan.time, release)


def _hand_yaw(plan: Plan, turn: Turn, path: Float[np.ndarray, "time 3"]) -> Float[np.ndarray, "time"]:
    """Rotation of the hand on the handle (rad), so that the fingers point along the arm."""
    values = turn.values(np.linspace(0.0, 1.0, len(path)))
    handle, pose = turn.item.handle(turn.handle, values), turn.item.pose(values)
    fingers = (pose.R.numpy() @ np.array(turn.item.handles[turn.handle].fingers))[:, :2]
    across = np.stack([-np.sin(path[:, 2]), np.cos(path[:, 2])], 1)
    arm = handle[:, :2] - path[:, :2] - 0.18 * LEFT_SIGN[turn.side] * across
    angle = np.arctan2(fingers[:, 0] * arm[:, 1] - fingers[:, 1] * arm[:, 0], (fingers * arm).sum(1))
    return YAW_MOST * np.tanh(np.unwrap(angle) / YAW_MOST)
