"""Seeded flats whose doors, windows, drawers and much furniture can be moved (iReplica thesis §5.2).

A `House` is such a flat's current state: where every object stands, what it keeps free, and the handlings so far.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry.mesh import merged
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Interactions, Motion
from wearcap.scene.objects import Environment
from wearsim.handling.grips import Handling, object_motion
from wearsim.places.builder import Piece, WorldBuilder
from wearsim.places.flat import lay_out
from wearsim.places.furniture import FRONT_M, MAKERS, Plan
from wearsim.places.movables import Movable, make_movable
from wearsim.places.openables import MOST_OPEN, Openable, hinged, with_fronts
from wearsim.places.outline import distance_to_convex, points_in_convex, turn
from wearsim.places.walls import DOOR_HEIGHT, THICKNESS, WINDOW, before_gap
from wearsim.places.world import Door, World, WorldObject

LOOSE: dict[str, tuple[str, ...]] = {
    "living room": ("sofa", "table", "sofa", "box", "chair"),
    "bedroom": ("chair", "box", "table"),
    "kitchen": ("table", "box"),
    "study": ("sofa", "table", "box", "chair"),
}
"""Movable furniture in each kind of room, in order of preference; a table comes with chairs."""
FIXED: dict[str, tuple[str, ...]] = {
    "living room": ("cabinet", "shelf", "plant", "lamp"),
    "bedroom": ("bed", "wardrobe", "cabinet", "lamp"),
    "kitchen": ("counter", "cabinet", "shelf"),
    "study": ("cabinet", "desk", "shelf", "plant"),
}
FEWEST = {"sofa": 1, "table": 1, "chair": 1, "box": 1, "door": 2, "window": 1, "drawer": 2}
FEWEST_OBJECTS = 10
WINDOW_SHARE, AJAR_SHARE, AJAR = 0.6, 0.3, np.deg2rad(65.0)
"""Share of the windows that can be opened; share of the doors (half that of the windows) that stand open at first, and
least angle to which they do."""
LEAST_OPEN = np.deg2rad(75.0)
"""Least angle to which a leaf must open, else it is left out."""
FRAME_M = 0.015
"""Depth of a frame in front of its wall."""
NEAR_WALKABLE_M = 0.3
"""Distance from the walkable floor within which seats and reach targets can be used."""
BEFORE_M = 0.45
"""Depth kept free in front of openables, beyond their sweep."""


@dataclass(frozen=True)
class _Loose(Piece):
    """Outline of a movable object, to find a place for it."""

    movable: Movable | None = None


@dataclass(frozen=True, eq=False)
class InteractiveFlat:
    """A static world, and the objects in it that can be moved or opened."""

    static: World
    movables: tuple[Movable, ...]
    openables: tuple[Openable, ...]

    @cached_property
    def environment(self) -> Environment:
        return Environment(tuple(item.object for item in (*self.movables, *self.openables)))

    @cached_property
    def world(self) -> World:
        """The world with all objects at their initial poses, as it is scanned and seen."""
        world, items = self.static, (*self.movables, *self.openables)
        meshes = []
        for item in items:
            T, mesh = item.object.T_world_object, item.object.mesh
            meshes.append(replace(mesh, vertices=(mesh.vertices @ T.R.numpy().T + T.t.numpy()).astype(np.float32)))
        counts = [len(mesh.faces) for mesh in meshes]
        numbers = len(world.objects) + np.arange(len(items))
        return replace(
            world,
            mesh=merged([world.mesh, *meshes]),
            face_object=np.concatenate([world.face_object, np.repeat(numbers, counts)]),
            face_texture=np.concatenate([world.face_texture, np.full(sum(counts), 6.0)]),
            objects=(*world.objects, *(obstacle(item, None) for item in items)),
        )


def obstacle(item: Movable | Openable, pose: Rigid | None) -> WorldObject:
    """Obstacle of an object at a pose (None: the initial one)."""
    pose = item.object.T_world_object if pose is None else pose
    R, t = pose.R.double().numpy(), pose.t.double().numpy()
    x, y, z = t.tolist()
    z_range = item.z_range if isinstance(item, Openable) else (z, z + item.height)
    footprint, heading = item.outline @ R[:2, :2].T + t[:2], float(np.arctan2(R[1, 0], R[0, 0]))
    return WorldObject(item.name, item.category, footprint, z_range, (x, y, z), heading)


class _Builder(WorldBuilder):
    """A builder that keeps movable objects out of the world."""

    rng: np.random.Generator

    def __init__(self, *frame):
        super().__init__(*frame)
        self.movables: list[Movable] = []
        self.openables: list[Openable] = []
        self.shut: set[int] = set()
        """Indices of windows that cannot be opened."""

    def place(self, piece: Piece, position: tuple[float, float, float], heading: float) -> int:
        if isinstance(piece, _Loose):
            assert piece.movable is not None
            x, y, z = self.point(*position)
            self.movables.append(piece.movable.placed(x, y, self.heading + heading, z))
            return -1
        x, y, z = position
        floor_point = lambda local: self.to_world(np.array([*(turn(heading) @ np.array(local) + np.array([x, y])), z]))  # noqa: E731
        piece, openables = with_fronts(piece, floor_point, self.heading + heading, self.rng)
        self.openables += openables
        return super().place(piece, position, heading)

    def door_leaves(self, static: World) -> list[Openable]:
        """Door leaves in the gaps, mostly opening into rooms, on whichever side they have the space to."""
        leaves, rng = [], self.rng
        for door in self.places.doors:
            variants = list(product((-1.0, 1.0), repeat=2))
            into_hall = np.array([_room_at(static, door, side).startswith("hallway") for side, _ in variants])
            order = np.argsort(rng.random(4) + np.where(into_hall, rng.choice([0.0, 1.0], p=[0.2, 0.8]), 0.0))
            for side, hand in (variants[k] for k in order):
                leaf = self.leaf_in(static, "door", door, side, hand, door.width)
                if leaf is not None:
                    leaves.append(leaf)
                    break
        return leaves

    def sashes(self, static: World) -> list[Openable]:
        """Window sashes that open into the room; a window wider than one sash has two."""
        sashes = []
        for number, window in enumerate(self.windows):
            sides = [side for side in (-1.0, 1.0) if _room_at(static, window, side)]
            if number in self.shut or len(sides) != 1:
                continue
            single = window.width < 1.0
            width = min(window.width, 0.9) if single else window.width / 2
            for hand in (float(self.rng.choice([-1.0, 1.0])),) if single else (-1.0, 1.0):
                sashes.append(self.leaf_in(static, "window", window, sides[0], hand, width))
        return [sash for sash in sashes if sash is not None]

    def leaf_in(
        self, static: World, category: str, gap: Door, side: float, hand: float, width: float
    ) -> Openable | None:
        """A leaf in a gap that opens towards a side, now and then ajar at first; None without space to open it.

        Doors and windows are 1 cm off the gap's frame on each side.
        """
        ahead = side * turn(gap.heading)[:, 0]
        along = hand * np.array([-ahead[1], ahead[0]])
        foot = np.array(gap.position)
        foot[:2] += (THICKNESS / 2 + FRAME_M) * ahead - (gap.width - 0.01) / 2 * along
        heading, sense = (
            float(np.arctan2(along[1], along[0])),
            float(np.sign(along[0] * ahead[1] - along[1] * ahead[0])),
        )
        level = (0.01, DOOR_HEIGHT - 0.04) if category == "door" else (WINDOW[0] + 0.035, WINDOW[1] - 0.035)
        leaf = hinged(category, foot, heading, sense, width - 0.02, level, self.rng)
        # The angle to which it opens before it touches something, its own frame left aside.
        solid = [
            item for item in static.objects if np.linalg.norm(np.array(item.position[:2]) - gap.position[:2]) < 4.0
        ]
        solid += [obstacle(movable, None) for movable in self.movables]
        solid = [item for item in solid if item.z_range[0] < leaf.z_range[1] and item.z_range[1] > leaf.z_range[0]]
        angles = np.deg2rad(np.arange(15.0, 106.0, 5.0))
        edge = np.linspace(0.3, 1.0, 12)[:, None] * leaf.outline[1]  # along the leaf, away from the frame
        points = np.einsum(
            "aij,ej->aei", leaf.pose(leaf.closed + leaf.opening_sign * angles).R[:, :2, :2].numpy(), edge
        )
        points = points + np.array(leaf.object.t_world_object[:2].tolist())
        apart = np.min([distance_to_convex(points, item.footprint).min(1) for item in solid], 0)
        hit = np.flatnonzero(apart < 0.02)
        most = MOST_OPEN
        if len(hit):
            most = float(min(angles[hit[0] - 1], MOST_OPEN)) if hit[0] > 0 else 0.0
        if most < LEAST_OPEN:
            return None
        opened = leaf.opening_sign * most
        freedom = replace(leaf.object.freedom, limits=(min(opened, 0.0), max(opened, 0.0)))
        leaf = replace(leaf, object=replace(leaf.object, freedom=freedom), opened=opened)
        if self.rng.random() >= (AJAR_SHARE if category == "door" else AJAR_SHARE / 2):
            return leaf
        return leaf.at(leaf.opening_sign * float(self.rng.uniform(AJAR, leaf.openness(leaf.opened))))


def build_interactive_flat(rng: np.random.Generator, name: str) -> InteractiveFlat:
    """A flat on one floor with at least a sofa, a table, a chair, a box, a window, doors and drawers that move."""
    while True:
        draws = np.random.default_rng(rng.integers(2**63))
        builder = _Builder.drawn(name, draws)
        assert isinstance(builder, _Builder)
        builder.rng = draws
        lay_out(builder, draws, stairs=False, furnish=_furnish)
        static = builder.finish()
        leaves = builder.door_leaves(static) + builder.sashes(static)
        flat = InteractiveFlat(static, _numbered(builder.movables), _numbered([*leaves, *builder.openables]))
        kinds = Counter(item.category for item in (*flat.movables, *flat.openables))
        if all(kinds[kind] >= least for kind, least in FEWEST.items()) and kinds.total() >= FEWEST_OBJECTS:
            return flat


def _numbered(items: list) -> tuple:
    """The same items with names: door_1, door_2 …"""
    count: Counter[str] = Counter()
    out = []
    for item in items:
        count[item.category] += 1
        name = f"{item.category}_{count[item.category]}"
        out.append(replace(item, object=replace(item.object, name=name)))
    return tuple(out)


def _furnish(plan: Plan, kind: str, rng: np.random.Generator) -> None:
    """Movable furniture first, boxes and some sofas at a wall; then static furniture along the walls.

    Windows have room in front of them.
    """
    builder = plan.builder
    assert isinstance(builder, _Builder)
    for number, window in enumerate(builder.windows):
        if number not in builder.shut and rng.random() < (1 - WINDOW_SHARE) / 2:
            builder.shut.add(number)
        elif number not in builder.shut:
            plan.kept_free.append(before_gap(builder, window, 1.0, 0.1))
    x_low, y_low, x_high, y_high = plan.room
    for category in LOOSE[kind]:
        if rng.random() >= 0.85:
            continue
        piece = _loose(category, rng)
        if category == "box" or (category == "sofa" and rng.random() < 0.5):
            plan.against_wall(piece, rng, front=0.0 if category == "box" else FRONT_M)
            continue
        for _ in range(16):
            heading = int(rng.integers(4)) * np.pi / 2 + rng.normal(0.0, 0.05)
            x, y = rng.uniform(x_low + 0.6, x_high - 0.6), rng.uniform(y_low + 0.6, y_high - 0.6)
            if plan.try_place(piece, x, y, heading):
                break
        else:
            continue
        # chairs on the long sides of a table
        for side, across in product((-1, 1), (-0.25, 0.25)) if category == "table" else ():
            off = side * (piece.size[0] / 2 + rng.uniform(0.30, 0.45))
            chair_x, chair_y = (np.array([x, y]) + turn(heading) @ np.array([off, across * piece.size[1]])).tolist()
            facing = heading + (0.0 if side < 0 else np.pi) + rng.uniform(-0.3, 0.3)
            if rng.random() < 0.45:
                plan.try_place(_loose("chair", rng), chair_x, chair_y, facing)
    for category in FIXED[kind]:
        if rng.random() < 0.8:
            plan.against_wall(MAKERS[category](rng), rng)


def _loose(category: str, rng: np.random.Generator) -> _Loose:
    movable = make_movable(category, category, rng)
    size = (2 * movable.half_size[0], 2 * movable.half_size[1])
    return _Loose(category, size, (0.0, movable.height), (), movable=movable)


def _room_at(static: World, gap: Door, side: float) -> str:
    """Name of the room half a metre away from a gap, "" outside."""
    point = np.array(gap.position[:2]) + side * 0.5 * turn(gap.heading)[:, 0]
    names = [room.name for room in static.places.rooms if points_in_convex(point[None], room.polygon)[0]]
    return names[0] if names else ""


@dataclass
class House:
    """State of an interactive flat; it changes with every interaction that is planned."""

    flat: InteractiveFlat
    values: dict[str, float] = field(default_factory=dict)
    """Current value of each openable, relative to its initial pose (rad or m)."""
    poses: dict[str, Rigid] = field(default_factory=dict)
    """Current pose of each movable object."""
    handlings: list[Handling] = field(default_factory=list)
    """Handlings so far, in the order of time."""

    def __post_init__(self):
        self.values = {item.name: 0.0 for item in self.flat.openables}
        self.poses = {item.name: item.object.T_world_object.to(torch.float64) for item in self.flat.movables}

    def obstacles(self, without: tuple[str, ...] = ()) -> tuple[WorldObject, ...]:
        """Everything that can be moved, at its current place."""
        poses = [(item, self.poses[item.name]) for item in self.flat.movables]
        poses += [(item, item.pose(self.values[item.name])) for item in self.flat.openables]
        return tuple(obstacle(item, pose) for item, pose in poses if item.name not in without)

    def world(self, around: Float[np.ndarray, "3"], without: tuple[str, ...] = ()) -> World:
        """The flat's current state, walkable where one gets to from a floor point (m); seats are the fixed ones."""
        static, extra = self.flat.static, self.obstacles(without)
        grid = static.navigation.barred(extra, around)

        def near(point) -> bool:
            away = np.linalg.norm(grid.node_points[:, :2] - np.array(point)[:2], axis=1)
            return bool((away < NEAR_WALKABLE_M).any())

        places = replace(
            static.places,
            seats=[seat for seat in static.places.seats if near(seat.standing_point())],
            reach_targets=[target for target in static.places.reach_targets if near(target.stand)],
        )
        now = replace(static, objects=(*static.objects, *extra), places=places)
        now.__dict__["navigation"] = grid
        return now

    def floor_place(self, movable: Movable) -> Float[np.ndarray, "3"]:
        """Floor pose of an object: x, y (m) and heading (rad)."""
        pose = self.poses[movable.name]
        return np.array([*pose.t[:2].tolist(), float(np.arctan2(pose.R[1, 0], pose.R[0, 0]))])

    def kept_free(self) -> list[Float[np.ndarray, "4 2"]]:
        """Outlines of the floor before doors, windows and cabinets, and behind doors."""
        zones = []
        for item in self.flat.openables:
            if item.hinged:  # a square over the leaf's quarter circle
                width, sign = float(item.outline[:, 0].max()), item.opening_sign
                behind = -0.9 if item.category == "door" else 0.0
                low, high = sorted((sign * (width + 0.1), sign * behind))
                pose, depth = item.pose(item.closed), width + BEFORE_M
            else:
                high = float(item.outline[:, 1].max())
                low, pose, depth = -high, item.object.T_world_object, abs(item.opened - item.closed) + BEFORE_M
            corners = np.array([[0.0, low], [depth, low], [depth, high], [0.0, high]])
            zones.append(corners @ pose.R[:2, :2].double().numpy().T + pose.t[:2].double().numpy())
        return zones

    def interactions(self, until_s: float) -> Interactions:
        """Intervals in which hands hold objects, ordered by their start, up to the end of a recording (s)."""
        rows = sorted(
            ((row, handling) for handling in self.handlings for row in handling.rows if row[0] < until_s),
            key=lambda pair: pair[0][:2],
        )
        return Interactions.of(
            (row[0], min(row[1], until_s), row[2], handling.name, handling.contact_class) for row, handling in rows
        )

    def object_motion(self, motion: Motion) -> dict[str, Trajectory]:
        """Poses of all movable objects and openables on a motion's timestamps; each stays where it was left."""
        return {
            item.name: object_motion(
                item.object.T_world_object, [h for h in self.handlings if h.name == item.name], motion
            )
            for item in (*self.flat.movables, *self.flat.openables)
        }
