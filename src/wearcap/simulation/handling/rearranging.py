"""New places for objects in a flat, and paths on which neither they nor the person moving them touch anything."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from wearcap.simulation.handling.carrying import Carry, carry_options, lift, put_down
from wearcap.simulation.handling.holding import Take, take_options, take_up
from wearcap.simulation.handling.holding import put_down as put_held_down
from wearcap.simulation.handling.house import Distractor, House
from wearcap.simulation.handling.sliding import Slide, slide, slide_options
from wearcap.simulation.handling.using import use
from wearcap.simulation.people.actions import approach
from wearcap.simulation.people.plan import Plan
from wearcap.simulation.people.shuffling import step_to
from wearcap.simulation.places.interactive_flat import obstacle
from wearcap.simulation.places.movables import Movable, floor_pose
from wearcap.simulation.places.openables import Openable
from wearcap.simulation.places.outline import distance_to_convex, rectangle, turn
from wearcap.simulation.places.world import World

C = TypeVar("C", Carry, Take)
Options = Callable[[Plan, Movable, np.ndarray, np.ndarray, np.random.Generator], Iterator[C]]

TRIES, OPTIONS, PLACES = 24, 4, 4
APART_M, BODY_M = 0.04, 0.22
"""Distance kept from other objects by the moved object, and by the middle of the person who moves it."""
REACHED_M = 0.35
"""Largest distance of the place to stand from where one can walk freely."""
FAR_M = {"sofa": (0.3, 1.6), "table": (0.3, 1.8), "chair": (0.25, 2.2)}
"""Range of the distance by which objects are moved."""
CARRIED_M = 5.0
USED_BEFORE, USED_AGAIN = 0.7, 0.7
"""Probability of using a held object before it is carried, and once more after; if not before, it is used after."""
TURN_SHARE = 0.4
BEFORE_M = 0.45
"""Depth kept free in front of openables, beyond their sweep."""
REACHABLE_SHARE = 0.85
KEYS = np.linspace(0.0, 1.0, 9)


def rearrange(
    plan: Plan, house: House, rng: np.random.Generator, movable: Movable, distractor: Distractor | None = None
) -> bool:
    """Slide an object to another place nearby; False, with nothing done, where none is found or reachable.

    With `distractor`, that act is done there instead, and nothing is touched.
    """
    world = house.world(plan.position)
    choice = choose_slide(plan, house, world, rng, movable)
    if choice is None:
        return False
    x, y, heading = choice.stand
    goal = np.array([x, y, plan.position[2]])
    far = np.linalg.norm(goal[:2] - plan.position[:2]) > 0.25
    if far and not approach(plan, world, rng, goal, float(heading)):
        return False
    if distractor is not None:
        step_to(plan, rng, choice.stand[:2], float(heading))
        distractor(
            plan,
            {side: choice.places[side] for side in choice.hands[0]},
            house.poses[movable.name],
            movable.height,
            rng,
        )
        return True
    house.handlings.append(slide(plan, choice, rng, float(plan.position[2])))
    house.poses[movable.name] = floor_pose(choice.stop, float(house.poses[movable.name].t[2]))
    return True


def choose_slide(plan: Plan, house: House, world: World, rng: np.random.Generator, movable: Movable) -> Slide | None:
    """A new place for an object and a plan to slide it there; None where none was found."""
    start, points = floor_place(house, movable), world.navigation.node_points[:, :2]
    if np.linalg.norm(points - start[:2], axis=1).min() > max(movable.half_size) + 1.0:
        return None
    near = [
        item
        for item in world.objects
        if item.name != movable.name
        and item.z_range[0] < 1.9
        and item.z_range[1] > 0.1
        and distance_to_convex(start[:2], item.footprint) < 5.0
    ]
    low = [item.footprint for item in near if item.z_range[0] < movable.height]
    solid, zones = ([item.footprint for item in near], [zone for zone in kept_free(house) if _meets(zone, start)])
    for _ in range(TRIES):
        stop = _drawn_stop(movable, start, rng)
        outline = rectangle((0.0, 0.0), (2 * movable.half_size[0], 2 * movable.half_size[1]))
        if not apart(outlines(outline, stop[None]), low, APART_M) or not apart(
            outlines(outline, stop[None]), zones, 0.0
        ):
            continue
        for choice in islice(slide_options(plan, movable, start, stop, rng), OPTIONS):
            if not apart(outlines(outline, choice.object_at(KEYS)), low, 0.5 * APART_M):
                continue
            body = choice.body_at(KEYS)[:, :2]
            free = min(distance_to_convex(body, footprint).min() for footprint in solid)
            reached = np.linalg.norm(points - choice.stand[:2], axis=1).min() < REACHED_M
            if (
                free > BODY_M
                and reached
                and _keeps_floor_reachable(house, world, movable, choice.stop, choice.body_at(np.ones(1))[0, :2])
            ):
                return choice
    return None


def relocate(
    plan: Plan, house: House, rng: np.random.Generator, movable: Movable, distractor: Distractor | None = None
) -> bool:
    """Carry a box to another place on the floor; False, with nothing done, where none is found or reachable.

    With `distractor`, that act is done in front of it instead, and nothing is touched.
    """
    world = house.world(plan.position)
    choice = choose_carry(plan, house, world, rng, movable, carry_options)
    floor = float(plan.position[2])
    if choice is None:
        return False
    x, y, heading = choice.stand
    if not approach(plan, world, rng, np.array([x, y, floor]), float(heading)):
        return False
    if distractor is not None:
        step_to(plan, rng, choice.stand[:2], float(heading))
        distractor(plan, choice.places, house.poses[movable.name], movable.height, rng)
        return True
    lifted = lift(plan, choice, rng)
    there = house.world(plan.position, without=(movable.name,))
    x, y, heading = choice.goal
    approach(plan, there, rng, np.array([x, y, floor]), float(heading))
    house.handlings.append(put_down(plan, lifted, rng))
    house.poses[movable.name] = floor_pose(choice.stop[:3], float(choice.stop[3]))
    return True


def fetch(
    plan: Plan, house: House, rng: np.random.Generator, movable: Movable, distractor: Distractor | None = None
) -> bool:
    """Take a hand-held object, use it, and put it down elsewhere on the floor; False where that cannot be done.

    With `distractor`, that act is done in front of it instead, and nothing is touched.
    """
    world = house.world(plan.position)
    for _ in range(PLACES):
        choice = choose_carry(plan, house, world, rng, movable, take_options)
        if choice is None:
            return False
        if _keeps_floor_reachable(house, world, movable, choice.stop[:3], choice.goal[:2]):
            break
    else:
        return False
    floor = float(plan.position[2])
    x, y, heading = choice.stand
    if not approach(plan, world, rng, np.array([x, y, floor]), float(heading)):
        return False
    if distractor is not None:
        step_to(plan, rng, choice.stand[:2], float(heading))
        distractor(plan, choice.places, house.poses[movable.name], movable.height, rng)
        return True
    held = take_up(plan, choice, rng)
    early = rng.random() < USED_BEFORE
    if early:
        use(plan, held, rng)
    there = house.world(plan.position, without=(movable.name,))
    x, y, heading = choice.goal
    approach(plan, there, rng, np.array([x, y, floor]), float(heading))
    if rng.random() < (USED_AGAIN if early else 1.0):
        use(plan, held, rng)
    house.handlings.append(put_held_down(plan, held, rng))
    house.poses[movable.name] = floor_pose(choice.stop[:3], float(choice.stop[3]))
    return True


def choose_carry(
    plan: Plan, house: House, world: World, rng: np.random.Generator, movable: Movable, options: Options[C]
) -> C | None:
    """A free place on the floor for an object and an option to hold it; None where none was found."""
    place, level = floor_place(house, movable), float(house.poses[movable.name].t[2])
    points = world.navigation.node_points[:, :2]
    if np.linalg.norm(points - place[:2], axis=1).min() > 1.0:
        return None
    others = [item.footprint for item in world.objects if item.name != movable.name and item.z_range[0] < 1.5]
    outline = rectangle((0.0, 0.0), (2 * movable.half_size[0], 2 * movable.half_size[1]))
    zones = kept_free(house)
    for _ in range(TRIES):
        spot = points[rng.integers(len(points))] + rng.uniform(-0.3, 0.3, 2)
        stop = np.array([*spot, rng.uniform(-np.pi, np.pi)])
        far = 0.8 < np.linalg.norm(spot - place[:2]) < CARRIED_M
        if not far or not apart(outlines(outline, stop[None]), [*others, *zones], APART_M):
            continue
        for choice in options(plan, movable, np.append(place, level), np.append(stop, level), rng):
            ends = np.stack([choice.stand[:2], choice.goal[:2]])
            free = min(distance_to_convex(ends, footprint).min() for footprint in others)
            away = np.linalg.norm(ends[:, None] - points[None], axis=-1).min(1)
            if free > BODY_M and (away < REACHED_M).all():
                return choice
    return None


def _keeps_floor_reachable(
    house: House, world: World, movable: Movable, stop: Float[np.ndarray, "3"], body: Float[np.ndarray, "2"]
) -> bool:
    """Whether most of the floor stays reachable after an object was moved and its mover stands at `body`."""
    end = np.append(body, float(house.poses[movable.name].t[2]))
    placed = obstacle(movable, floor_pose(stop, end[2]))
    grid = house.flat.static.navigation.barred((*house.obstacles((movable.name,)), placed), end)
    away = np.linalg.norm(grid.node_points[:, :2] - end[:2], axis=1)
    enough = grid.walkable.sum() > REACHABLE_SHARE * world.navigation.walkable.sum()
    return bool(enough) and float(away.min()) < REACHED_M


def floor_place(house: House, movable: Movable) -> Float[np.ndarray, "3"]:
    """Floor pose of an object: x, y (m) and heading (rad)."""
    pose = house.poses[movable.name]
    return np.array([*pose.t[:2].tolist(), float(np.arctan2(pose.R[1, 0], pose.R[0, 0]))])


def kept_free(house: House) -> list[Float[np.ndarray, "4 2"]]:
    """Outlines of the floor before doors, windows and cabinets."""
    zones = []
    for item in house.flat.openables:
        if item.hinged:
            zones.append(_swept(item))
        else:
            depth = abs(item.opened - item.closed) + BEFORE_M
            front = item.object.T_world_object
            half = float(item.outline[:, 1].max())
            zones.append(_local(front, np.array([[0.0, -half], [depth, -half], [depth, half], [0.0, half]])))
    return zones


def _swept(item: Openable) -> Float[np.ndarray, "4 2"]:
    """A square over a leaf's quarter circle and, for a door, the floor on the wall's other side."""
    width, sign = float(item.outline[:, 0].max()), item.opening_sign
    behind = -0.9 if item.category == "door" else 0.0
    low, high = sorted((sign * (width + 0.1), sign * behind))
    return _local(
        item.pose(item.closed), np.array([[0.0, low], [width + BEFORE_M, low], [width + BEFORE_M, high], [0.0, high]])
    )


def _local(pose, corners: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "4 2"]:
    return corners @ pose.R[:2, :2].double().numpy().T + pose.t[:2].double().numpy()


def _meets(zone: Float[np.ndarray, "4 2"], start: Float[np.ndarray, "3"]) -> bool:
    """Whether a zone matters for an object at `start`: it is near, and the object is not in it already."""
    distance = float(distance_to_convex(start[:2], zone))
    return distance < 4.0


def _drawn_stop(movable: Movable, start: Float[np.ndarray, "3"], rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A new place, mostly displaced along the object's own axes, now and then turned."""
    low, high = FAR_M[movable.category]
    along = rng.choice(4) * np.pi / 2 + start[2] if rng.random() < 0.7 else rng.uniform(-np.pi, np.pi)
    angle = float(along + rng.normal(0.0, 0.15))
    far = float(rng.uniform(low, high))
    spin = 0.0
    if rng.random() < TURN_SHARE:
        spin = float(rng.choice([-1.0, 1.0]) * (np.pi / 2 if rng.random() < 0.3 else rng.uniform(0.25, 1.2)))
        far *= rng.uniform(0.2, 1.0)
    return start + np.array([far * np.cos(angle), far * np.sin(angle), spin])


def outlines(outline: Float[np.ndarray, "4 2"], places: Float[np.ndarray, "key 3"]) -> Float[np.ndarray, "key 4 2"]:
    """An outline at places x, y (m), heading (rad)."""
    return np.stack([outline @ turn(heading).T + np.array([x, y]) for x, y, heading in places])


def apart(outlines: Float[np.ndarray, "key 4 2"], others: list[Float[np.ndarray, "corner 2"]], least_m: float) -> bool:
    """Whether outlines keep a distance from others: neither's border comes near the other."""
    share = np.linspace(0.0, 1.0, 7)[:-1, None]
    border = lambda corners: np.concatenate(  # noqa: E731
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0))]
    )
    points = np.concatenate([border(corners) for corners in outlines])
    low, high = points.min(0) - least_m, points.max(0) + least_m
    for other in others:
        if (other.min(0) > high).any() or (other.max(0) < low).any():
            continue
        if distance_to_convex(points, other).min() <= least_m:
            return False
        rim = border(other)
        if min(distance_to_convex(rim, corners).min() for corners in outlines) <= least_m:
            return False
    return True
