"""A stretch of life in an interactive flat: the choice of the next activity, passing doors, and ordinary activities."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wearsim.handling.distractors import Manner
from wearsim.handling.imitating import free_hands_s, imitate
from wearsim.handling.opening import operate
from wearsim.handling.rearranging import rearrange, relocate
from wearsim.people.actions import ACTIVITIES, follow, start_place
from wearsim.people.person import Person
from wearsim.people.plan import Plan
from wearsim.people.wearer import TAIL_S
from wearsim.places.interactive_flat import House
from wearsim.places.movables import HANDHELDS, Movable
from wearsim.places.openables import Openable
from wearsim.places.outline import distance_to_convex

EVEN_S = 4.0
"""Kinds are drawn by their weight divided by the sum of this and the time for which they were held already (s)."""
AGAIN, ROOM = 0.40, 0.04
"""Probability of using the last object again, and of moving several objects of one room."""
TRIES = 5
KEEP_UP_S = 6.0
"""Lack of look-alikes (s) over which they certainly come next."""
ORDINARY = ("stand", "look_around", "turn", "walk", "hold", "gesture", "carry", "reach", "sit", "crouch")
CLOSE_BEHIND = 0.35
"""Probability of closing a door after walking through."""
PARTLY = 0.25
"""Probability of opening something only partly, or of not quite closing it."""
BEYOND_M = 0.95
"""Distance behind a door to which one walks through it."""
REACHED_M = 0.4
IN_ROOM, SAME_ROOM_M = 4, 3.5
"""Most objects that are moved when a room is rearranged, and their largest distance from the first."""


@dataclass(frozen=True)
class Habits:
    """Preferences in the choice of objects, and how often they are used."""

    weights: Mapping[str, float]
    """Weight by category."""
    held_share: float
    """Target share of the time in which hands hold an object."""
    even: bool = False
    """Whether kinds that were held less so far are preferred."""
    again: float = AGAIN
    """Probability of using the last object again, unless it was in the hands for long."""
    near_m: float = 2.5
    """Distance per factor 1/e in the probability of an object's choice."""
    alike: float = 1.4
    """Time of hands in the poses of touching that touch nothing, as a share of the hands' time in contact."""
    resting_share: float = 0.2
    """Probability of holding an object without moving it."""
    imitated_share: float = 0.5
    """Share of what resembles handling that is done in the air or with something else, away from the object."""


USUAL = Habits(
    {
        "door": 1.5, "window": 2.2, "drawer": 2.2, "cabinet_door": 1.8, "sofa": 2.5, "table": 1.2, "chair": 1.2,
        "box": 0.8,
    },
    0.36,
)  # fmt: skip
VARIED = Habits(
    {
        "door": 3.0, "window": 4.4, "drawer": 4.4, "cabinet_door": 4.6, "sofa": 4.5, "table": 2.6, "chair": 2.4,
        "box": 0.5, "suitcase": 1.2, "backpack": 1.2, "bottle": 1.0, "tool": 1.0, "ball": 0.9,
    },
    0.75, even=True, again=0.7, near_m=1.5, alike=0.1, resting_share=0.1,
)  # fmt: skip
"""Every kind is held for a fair share of the time, hand-held objects for about half of it."""


class Household:
    """Plans one activity after the other; the house's state changes with it."""

    def __init__(self, house: House, person: Person, rng: np.random.Generator, habits: Habits = USUAL):
        self.house, self.rng, self.habits = house, rng, habits
        static = house.flat.static
        worlds = [house.world(point) for point in static.sample_floor(rng, 6)]
        largest = max(worlds, key=lambda world: int(world.navigation.walkable.sum()))
        position, heading = start_place(largest, rng)
        self.plan = Plan(person, position, heading, static.floor_height)
        self.plan.time = 0.3
        self.openables = {item.name: item for item in house.flat.openables}
        self.movables = {item.name: item for item in house.flat.movables}
        self.items: dict[str, Movable | Openable] = self.openables | self.movables
        self.last: str | None = None
        self.alike_s: Counter[str] = Counter()
        """Time of hands in look-alikes of each kind of object."""

    def live(self, duration_s: float) -> None:
        """Plan until a time (s) is reached, and a little beyond."""
        while self.plan.time < duration_s + TAIL_S:
            start = self.plan.time
            held = sum(stop - begin for h in self.house.handlings for begin, stop, _ in h.rows)
            eager = 0.5 + 3.0 * (self.habits.held_share - held / max(start, 10.0))
            lacks = self._lacks()
            if self.rng.random() < np.clip(sum(lacks.values()) / KEEP_UP_S, 0.0, 0.95):
                kind = str(self.rng.choice(list(lacks), p=np.array(list(lacks.values())) / sum(lacks.values())))
                free = free_hands_s(self.plan, self.house)
                name = self.imitate(kind, lacks[kind])
                self.alike_s[kind] += free_hands_s(self.plan, self.house) - free
            else:
                name = self.interact() if self.rng.random() < np.clip(eager, 0.1, 0.92) else self.do_ordinary()
            if self.plan.time < start + 0.05:
                ACTIVITIES["stand"].act(self.plan, self.house.flat.static, self.rng)
                name = "stand"
            self.plan.label(start, name)

    def do_ordinary(self) -> str:
        """One of the activities in which nothing is moved."""
        weights = np.array([ACTIVITIES[name].weight for name in ORDINARY])
        name = str(self.rng.choice(ORDINARY, p=weights / weights.sum()))
        if name == "walk" and self.rng.random() < 0.5:
            points = self.house.flat.static.navigation.node_points
            return "walk" if self.go(points[self.rng.integers(len(points))]) else "stand"
        ACTIVITIES[name].act(self.plan, self.house.world(self.plan.position), self.rng)
        return name

    def interact(self) -> str:
        """Use an object, after passing the doors on the path; "stand" where nothing could be done."""
        chance = self.rng.random()
        held = self.last is not None and self.items[self.last].category in HANDHELDS
        again = AGAIN if held else self.habits.again
        if chance < again and self.last is not None and (done := self.use(self.last)) != "stand":
            return done
        if chance > 1.0 - ROOM:
            return self.rearrange_room()
        for _ in range(TRIES):
            if (done := self.use(self._drawn(self.items))) != "stand":
                return done
        return "stand"

    def use(self, name: str) -> str:
        """Open, close or move one object; returns the act's label ("walk": only got there, "stand": nothing done)."""
        start, done = self.plan.time, self._act(name)
        if not done and self.go(self.place_of(name), stop_m=1.0):
            done = self._act(name)
        if not done:
            return "walk" if self.plan.time > start else "stand"
        self.last = name
        return f"{'move' if name in self.movables else 'turn'} {self.items[name].category}"

    def imitate(self, kind: str, busy_s: float) -> str:
        """Do what resembles handling a kind of object but touches none: in the air, with something else, or short of it."""
        items = {name: item for name, item in self.items.items() if item.category == kind}
        if self.rng.random() < self.habits.imitated_share:
            item = items[str(self.rng.choice(list(items)))]
            if imitate(self.plan, self.house, self.rng, item, busy_s):
                return "imitate"
        name = self.last if self.last in items else self._drawn(items)
        done = self._act(name, "pretend") or (self.go(self.place_of(name), 1.0) and self._act(name, "pretend"))
        return "pretend" if done else "stand"

    def _lacks(self) -> dict[str, float]:
        """Time (s) that look-alikes of each kind of object are behind their share of the hands' time in contact."""
        found = {item.category: -self.alike_s[item.category] for item in self.items.values()}
        for handling in self.house.handlings:
            touching = sum((stop - start) * sum(hands) for start, stop, hands in handling.rows)
            found[self.items[handling.name].category] += self.habits.alike * touching
        return {kind: max(lack, 0.0) for kind, lack in found.items()}

    def _act(self, name: str, manner: Manner | None = None) -> bool:
        """Use one object in a manner; None: move it, or now and then only hold it."""
        manner = manner or ("rest" if self.rng.random() < self.habits.resting_share else "move")
        if name in self.openables:
            return self.turn(self.openables[name], manner)
        act = relocate if self.movables[name].category in ("box", *HANDHELDS) else rearrange
        return act(self.plan, self.house, self.rng, self.movables[name], manner)

    def rearrange_room(self) -> str:
        """Move several objects near each other, one after another."""
        start, first = self.plan.time, self._drawn(self.movables)
        middle = self.place_of(first)
        away = {name: float(np.linalg.norm(self.place_of(name) - middle)) for name in self.movables}
        names = sorted((name for name in away if away[name] < SAME_ROOM_M), key=lambda name: away[name])
        for name in names[: int(self.rng.integers(2, IN_ROOM + 1))]:
            self.use(name)
        return "rearrange" if self.plan.time > start else "stand"

    def turn(self, item: Openable, manner: Manner) -> bool:
        """Open a closed openable, close an open one; sometimes to a value in between."""
        at, full = self.house.values[item.name], item.openness(item.opened)
        if item.openness(at) > 0.3 * full:
            share = self.rng.uniform(0.0, 0.4) if self.rng.random() < PARTLY else 0.0
        else:
            share = self.rng.uniform(0.3, 0.7) if self.rng.random() < PARTLY else self.rng.uniform(0.7, 0.98)
        value = item.closed + share * (item.opened - item.closed)
        if abs(value - at) < 0.12 * full:
            return False
        return operate(self.plan, self.house, self.rng, item, value, self._side(item), manner)

    def go(self, goal: Float[np.ndarray, "3"], stop_m: float = 0.0) -> bool:
        """Walk to a floor point (m), or within `stop_m` of it, opening closed doors on the path; False on failure."""
        for _ in range(4):
            world = self.house.world(self.plan.position)
            points = world.navigation.node_points
            away = np.linalg.norm(points[:, :2] - goal[:2], axis=1)
            if len(points) and away.min() < max(REACHED_M, stop_m) and self.same_side(points[away.argmin()], goal):
                near = np.flatnonzero(away < max(away.min() + 0.15, stop_m))
                target = points[near[np.linalg.norm(points[near, :2] - self.plan.position[:2], axis=1).argmin()]]
                path = world.plan_path(self.plan.position, target, self.rng)
                if path is None:
                    return False
                follow(self.plan, world, self.rng, path)
                return True
            door = self.door_between(goal)
            if door is None or not self.go_through(door):
                return False
        return False

    def go_through(self, door: Openable) -> bool:
        """Open a door, walk through it, and sometimes close it behind."""
        start, side, width = self.plan.time, self._side(door), door.openness(door.opened)
        share = self.rng.uniform(np.deg2rad(66.0), width) / width
        value = door.closed + share * (door.opened - door.closed)
        if not operate(self.plan, self.house, self.rng, door, value, side):
            return False
        self.last = door.name
        self.plan.label(start, "open door")
        target = self._beyond(door, 1 - side)
        world = self.house.world(self.plan.position)
        path = world.plan_path(self.plan.position, target, self.rng)
        if path is None or np.linalg.norm(path[-1, :2] - target[:2]) > REACHED_M:
            return False
        start = self.plan.time
        follow(self.plan, world, self.rng, path)
        self.plan.label(start, "walk")
        if self.rng.random() < CLOSE_BEHIND:
            operate(self.plan, self.house, self.rng, door, door.closed, 1 - side)
        return True

    def place_of(self, name: str) -> Float[np.ndarray, "3"]:
        """Floor point at an object, or in front of an openable's handle (m)."""
        floor = float(self.plan.position[2])
        if name in self.movables:
            return np.append(self.house.floor_place(self.movables[name])[:2], floor)
        item = self.openables[name]
        if item.category == "door":
            return self._beyond(item, self._side(item), 0.6)
        place = item.handle(0, np.array(item.closed))
        out = -(item.pose(item.closed).R.numpy() @ np.array(item.handles[0].fingers))[:2]
        return np.append(place[:2] + 0.7 * out / np.linalg.norm(out), floor)

    def _drawn(self, items: Mapping[str, Movable | Openable]) -> str:
        """Name of the next object to use; near ones are preferred."""
        kinds = Counter(item.category for item in items.values())
        away = [np.linalg.norm(self.place_of(name)[:2] - self.plan.position[:2]) for name in items]
        weights = np.exp(-np.array(away) / self.habits.near_m)
        weights *= [self._weight(item.category) / kinds[item.category] for item in items.values()]
        return str(self.rng.choice(list(items), p=weights / weights.sum()))

    def _weight(self, category: str) -> float:
        if not self.habits.even:
            return self.habits.weights[category]
        spans = [h.stop_s - h.start_s for h in self.house.handlings if self.items[h.name].category == category]
        return self.habits.weights[category] / (EVEN_S + sum(spans))

    def _side(self, door: Openable) -> int:
        """Index of the handle on the side where one stands: 0 where the leaf opens to."""
        pose = door.pose(door.closed)
        offset = np.append(self.plan.position[:2] - pose.t[:2].numpy(), 0.0)
        across = float((pose.R.numpy().T @ offset)[1]) * door.opening_sign
        return 0 if len(door.handles) == 1 or across > 0 else 1

    def _beyond(self, door: Openable, side: int, far_m: float = BEYOND_M) -> Float[np.ndarray, "3"]:
        """Floor point in front of a door's middle on a side (m)."""
        pose = door.pose(door.closed)
        width = float(door.outline[:, 0].max())
        sign = door.opening_sign if side == 0 else -door.opening_sign
        point = pose.R.numpy() @ np.array([width / 2, sign * far_m, 0.0]) + pose.t.numpy()
        return np.array([point[0], point[1], self.plan.position[2]])

    def same_side(self, point: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"]) -> bool:
        """Whether no wall or closed door stands between two points near each other."""
        between = goal[:2] + np.linspace(0.0, 1.0, 9)[:, None] * (point[:2] - goal[:2])
        flat, values = self.house.flat, self.house.values
        walls = [item.footprint for item in flat.static.objects if item.kind == "wall" and item.z_range[0] < 1.0]
        walls += [door.footprint(values[door.name]) for door in flat.openables if door.category == "door"]
        return min(float(distance_to_convex(between, wall).min()) for wall in walls) > 0.01

    def door_between(self, goal: Float[np.ndarray, "3"]) -> Openable | None:
        """The first door on the path to a point that is not open enough."""
        shut = [door for door in self.house.flat.openables if door.blocks(self.house.values[door.name])]
        world = self.house.world(self.plan.position, without=tuple(door.name for door in shut))
        path = world.navigation.shortest(self.plan.position, goal, 1.0) if shut else None
        if path is None:
            return None
        near = [distance_to_convex(path[:, :2], door.footprint(door.closed)) < 0.12 for door in shut]
        passed = [(int(there.argmax()), number) for number, there in enumerate(near) if there.any()]
        return shut[min(passed)[1]] if passed else None
