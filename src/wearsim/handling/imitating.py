"""Poses of handling in which no object of the environment is touched.

A copy of an object is put to a free place nearby and handled there. The copy belongs to no environment, its handling
is no interaction, and it is gone afterwards. The poses are those of a touch, for as long, but nothing guides or carries
the hands (`loosened`): they stay where they are on the body, held out or with something else in them; or they stray as
in gesturing. Rarely they go just as if they touched.
"""

from dataclasses import replace
from itertools import cycle, repeat

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearsim.handling.grips import Grip, posed, wandering
from wearsim.handling.opening import operate
from wearsim.handling.rearranging import rearrange, relocate
from wearsim.people.plan import Plan
from wearsim.places.interactive_flat import House, InteractiveFlat
from wearsim.places.movables import Movable
from wearsim.places.openables import Openable
from wearsim.places.outline import stays_apart

NEAR_M, APART_M, TRIES = 1.6, 0.05, 8
"""Largest distance of the copy from the wearer, its distance from other objects, and the places that are tried."""
COPY = "something"
MIMED, STILL = 0.1, 0.1
"""Shares of imitated handlings in which hands go as if they touched, and stay where they are on the body."""
MIMED_M, STILL_M, STRAY_M = 0.012, 0.012, 0.03
"""Deviation of hands' waves (m; `wandering`) in these, and in all others, in which they stray."""


def imitate(plan: Plan, house: House, rng: np.random.Generator, item: Movable | Openable, busy_s: float) -> bool:
    """Handle a copy of an object at a free place until hands were busy for some time (s); False, with nothing done, where
    none is found. Hands are `loosened` from the copy."""
    before = {side: len(grips) for side, grips in plan.grips.items()}
    done = _handle_copy(plan, house, rng, item, busy_s)
    manner = rng.random()
    for side, count in before.items():
        plan.grips[side][count:] = [loosened(grip, rng, manner) for grip in plan.grips[side][count:]]
    return done


def loosened(grip: Grip, rng: np.random.Generator, manner: float) -> Grip:
    """The grip of a hand that nothing guides. `manner`, 0…1, says how it goes (`MIMED`, `STILL`)."""
    if manner < MIMED:
        return replace(grip, moves=wandering(grip.moves, rng, MIMED_M))
    if manner < MIMED + STILL:
        still = posed(grip.moves, rng.uniform(grip.touch_s, grip.release_s))
        return replace(grip, moves=wandering(still, rng, STILL_M))
    return replace(grip, moves=wandering(grip.moves, rng, STRAY_M))


def _handle_copy(plan: Plan, house: House, rng: np.random.Generator, item: Movable | Openable, busy_s: float) -> bool:
    """The same with hands that keep to the copy."""
    until = free_hands_s(plan, house) + busy_s
    flat, points = house.flat, house.world(plan.position).navigation.node_points
    points = points[np.linalg.norm(points[:, :2] - plan.position[:2], axis=1) < NEAR_M]
    solid = [each.footprint for each in (*flat.static.objects, *house.obstacles()) if each.z_range[0] < 1.5]
    for _ in range(TRIES if len(points) else 0):
        x, y, z = points[rng.integers(len(points))]
        place = np.array([x, y, rng.uniform(-np.pi, np.pi)])
        if not stays_apart(item.outline, place[None], solid, APART_M):
            continue
        if isinstance(item, Movable):
            copy = item.placed(*place.tolist(), float(z))
            copy = replace(copy, object=replace(copy.object, name=COPY))
            other = _with(house, InteractiveFlat(flat.static, (*flat.movables, copy), flat.openables))
            act = rearrange if item.rails else relocate
            uses = (act(plan, other, rng, copy, "move") for _ in repeat(None))
        else:
            copy = _moved(item, place)
            other = _with(house, InteractiveFlat(flat.static, flat.movables, (*flat.openables, copy)))
            ends = copy.closed, copy.closed + rng.uniform(0.5, 0.98) * (copy.opened - copy.closed)
            start, stop = ends if rng.random() < 0.5 else ends[::-1]
            other.values[COPY], handle = start, int(rng.integers(len(copy.handles)))
            uses = (operate(plan, other, rng, copy, value, handle, "move") for value in cycle((stop, start)))
        if next(uses):
            while free_hands_s(plan, house) < until and next(uses):
                pass
            return True
    return False


def free_hands_s(plan: Plan, house: House) -> float:
    """Time (s) of both hands so far at places where they touch no object of a house."""
    grips = sum(grip.release_s - grip.touch_s for side in plan.grips.values() for grip in side)
    return grips - sum((stop - start) * sum(hands) for h in house.handlings for start, stop, hands in h.rows)


def _with(house: House, flat: InteractiveFlat) -> House:
    """A house in the same state whose flat has an object more; its handlings are its own."""
    other = House(flat)
    other.values |= house.values
    other.poses |= house.poses
    return other


def _moved(item: Openable, place: Float[np.ndarray, "3"]) -> Openable:
    """An openable with its origin over another place of the floor: x, y (m), heading (rad)."""
    found, freedom = item.object, item.object.freedom
    t_old, t = found.t_world_object, torch.tensor([place[0], place[1], float(found.t_world_object[2])]).float()
    R = rotation.about_axis("z", torch.tensor(place[2])).float()
    between = R @ found.R_world_object.T
    turned = lambda vector: tuple((between @ torch.tensor(vector)).tolist())  # noqa: E731
    if freedom.pivot is not None:
        freedom = replace(freedom, pivot=tuple((t + between @ (torch.tensor(freedom.pivot) - t_old)).tolist()))
    elif freedom.axis is not None:
        freedom = replace(freedom, axis=turned(freedom.axis))
    return replace(item, object=replace(found, name=COPY, R_world_object=R, t_world_object=t, freedom=freedom))
