"""New places for objects in a flat, and paths on which neither they nor the person moving them touch anything."""

from itertools import islice

import numpy as np
from jaxtyping import Float

from wearsim.handling.distractors import Manner, pretend_to_handle, rest_on
from wearsim.handling.grips import GripPlace
from wearsim.handling.holding import Errand, HeldObject, carry_options, lift, put_down, take_options
from wearsim.handling.sliding import Slide, slide, slide_options
from wearsim.handling.using import use
from wearsim.people.actions import approach
from wearsim.people.plan import Plan
from wearsim.people.walking import step_to
from wearsim.places.interactive_flat import House, obstacle
from wearsim.places.movables import Movable, floor_pose
from wearsim.places.outline import distance_to_convex, stays_apart
from wearsim.places.world import World

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
REACHABLE_SHARE = 0.85
KEYS = np.linspace(0.0, 1.0, 9)


def rearrange(plan: Plan, house: House, rng: np.random.Generator, movable: Movable, manner: Manner) -> bool:
    """Slide an object to another place nearby; False, with nothing done, where none is found or reachable.

    In the manner "rest" it is held without being moved; in "pretend" nothing is touched (`Manner`).
    """
    world = house.world(plan.position)
    choice = _drawn_slide(plan, house, world, rng, movable)
    if choice is None:
        return False
    far = np.linalg.norm(choice.stand[:2] - plan.position[:2]) > 0.25
    if far and not _go_to(plan, world, rng, choice.stand):
        return False
    if manner != "move":
        _stay(plan, house, rng, choice, {side: choice.places[side] for side in choice.hands[0]}, manner)
        return True
    house.handlings.append(slide(plan, choice, rng, float(plan.position[2])))
    house.poses[movable.name] = floor_pose(choice.stop, float(house.poses[movable.name].t[2]))
    return True


def relocate(plan: Plan, house: House, rng: np.random.Generator, movable: Movable, manner: Manner) -> bool:
    """Carry an object to another place on the floor; False, with nothing done, where none is found or reachable.

    All but boxes are used before or after. In the manner "rest" it is held without being moved; in "pretend" nothing is
    touched (`Manner`).
    """
    world, box = house.world(plan.position), movable.category == "box"
    for _ in range(PLACES):
        choice = _drawn_errand(plan, house, world, rng, movable)
        if choice is None:
            return False
        if box or _keeps_floor_reachable(house, world, movable, choice.stop[:3], choice.goal[:2]):
            break
    else:
        return False
    if not _go_to(plan, world, rng, choice.stand):
        return False
    if manner != "move":
        _stay(plan, house, rng, choice, choice.places, manner)
        return True
    held = lift(plan, choice, rng)
    early = isinstance(held, HeldObject) and rng.random() < USED_BEFORE
    if isinstance(held, HeldObject) and early:
        use(plan, held, rng)
    _go_to(plan, house.world(plan.position, without=(movable.name,)), rng, choice.goal)
    if isinstance(held, HeldObject) and rng.random() < (USED_AGAIN if early else 1.0):
        use(plan, held, rng)
    house.handlings.append(put_down(plan, held, rng))
    house.poses[movable.name] = floor_pose(choice.stop[:3], float(choice.stop[3]))
    return True


def _go_to(plan: Plan, world: World, rng: np.random.Generator, place: Float[np.ndarray, "3"]) -> bool:
    """Walk to x, y (m) and turn to a heading (rad); False without a path."""
    return approach(plan, world, rng, np.append(place[:2], plan.position[2]), place[2])


def _stay(
    plan: Plan,
    house: House,
    rng: np.random.Generator,
    choice: Slide | Errand,
    places: dict[str, GripPlace],
    manner: Manner,
) -> None:
    """Hold an object, or do what resembles it, standing where it would be handled; the object stays where it is."""
    step_to(plan, rng, choice.stand[:2], choice.stand[2])
    pose = house.poses[choice.movable.name]
    if manner == "rest":
        house.handlings.append(rest_on(plan, choice.movable.object, places, pose, rng))
    else:
        pretend_to_handle(plan, places, pose, choice.movable.height, rng)


def _drawn_slide(plan: Plan, house: House, world: World, rng: np.random.Generator, movable: Movable) -> Slide | None:
    """A new place for an object and a plan to slide it there; None where none was found."""
    start, points = house.floor_place(movable), world.navigation.node_points[:, :2]
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
    zones = [zone for zone in house.kept_free() if distance_to_convex(start[:2], zone) < 4.0]
    outline = movable.outline
    for _ in range(TRIES):
        # mostly displaced along the object's own axes, now and then turned
        along = rng.choice(4) * np.pi / 2 + start[2] if rng.random() < 0.7 else rng.uniform(-np.pi, np.pi)
        angle = along + rng.normal(0.0, 0.15)
        far, spin = rng.uniform(*FAR_M[movable.category]), 0.0
        if rng.random() < TURN_SHARE:
            spin = rng.choice([-1.0, 1.0]) * (np.pi / 2 if rng.random() < 0.3 else rng.uniform(0.25, 1.2))
            far *= rng.uniform(0.2, 1.0)
        stop = start + np.array([far * np.cos(angle), far * np.sin(angle), spin])
        if not stays_apart(outline, stop[None], low, APART_M) or not stays_apart(outline, stop[None], zones, 0.0):
            continue
        for choice in islice(slide_options(plan, movable, start, stop, rng), OPTIONS):
            if not stays_apart(outline, choice.object_at(KEYS), low, 0.5 * APART_M):
                continue
            body = choice.body_at(KEYS)[:, :2]
            free = min(distance_to_convex(body, item.footprint).min() for item in near)
            reached = np.linalg.norm(points - choice.stand[:2], axis=1).min() < REACHED_M
            end = choice.body_at(np.ones(1))[0, :2]
            if free > BODY_M and reached and _keeps_floor_reachable(house, world, movable, choice.stop, end):
                return choice
    return None


def _drawn_errand(plan: Plan, house: House, world: World, rng: np.random.Generator, movable: Movable) -> Errand | None:
    """A free place on the floor for an object and an option to hold it; None where none was found."""
    place, level = house.floor_place(movable), float(house.poses[movable.name].t[2])
    points = world.navigation.node_points[:, :2]
    if np.linalg.norm(points - place[:2], axis=1).min() > 1.0:
        return None
    others = [item.footprint for item in world.objects if item.name != movable.name and item.z_range[0] < 1.5]
    outline = movable.outline
    zones, options = house.kept_free(), carry_options if movable.category == "box" else take_options
    for _ in range(TRIES):
        spot = points[rng.integers(len(points))] + rng.uniform(-0.3, 0.3, 2)
        stop = np.array([*spot, rng.uniform(-np.pi, np.pi)])
        far = 0.8 < np.linalg.norm(spot - place[:2]) < CARRIED_M
        if not far or not stays_apart(outline, stop[None], [*others, *zones], APART_M):
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
