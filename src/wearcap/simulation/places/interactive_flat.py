"""Seeded flats whose doors, windows, drawers and much furniture can be moved (iReplica thesis §5.2)."""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from wearcap.geometry.mesh import merged
from wearcap.geometry.rigid import Rigid
from wearcap.scene.environment import Environment
from wearcap.simulation.places.builder import Piece, WorldBuilder
from wearcap.simulation.places.flat import lay_out
from wearcap.simulation.places.fronts import FRONTED
from wearcap.simulation.places.furnish import FRONT_M, Box, Plan
from wearcap.simulation.places.furniture import MAKERS
from wearcap.simulation.places.movables import Movable, make_movable
from wearcap.simulation.places.openables import Openable, at, direction, hinged
from wearcap.simulation.places.outline import distance_to_convex, points_in_convex, rectangle, turn
from wearcap.simulation.places.walls import DOOR_HEIGHT, THICKNESS, WINDOW
from wearcap.simulation.places.world import Door, World, WorldObject

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
WINDOW_SHARE, AJAR_SHARE = 0.6, 0.3
"""Share of the windows that can be opened; share of the doors (half that of the windows) that stand open at first."""
LEAST_OPEN, MOST_OPEN = np.deg2rad(75.0), np.deg2rad(100.0)
"""Least angle to which a leaf must open, else it is left out; and largest angle to which any opens."""
FRAME_M = 0.015
"""Depth of a frame in front of its wall."""


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
        world, meshes = self.static, [self.static.mesh]
        face_object, face_texture = [world.face_object], [world.face_texture]
        objects = list(world.objects)
        for item in (*self.movables, *self.openables):
            scene_object = item.object
            T = scene_object.T_world_object
            vertices = scene_object.mesh.vertices @ T.R.numpy().T + T.t.numpy()
            meshes.append(replace(scene_object.mesh, vertices=vertices.astype(np.float32)))
            face_object.append(np.full(len(scene_object.mesh.faces), len(objects)))
            face_texture.append(np.full(len(scene_object.mesh.faces), 6.0))
            objects.append(obstacle(item, None))
        return replace(
            world,
            mesh=merged(meshes),
            face_object=np.concatenate(face_object),
            face_texture=np.concatenate(face_texture),
            objects=tuple(objects),
        )


def obstacle(item: Movable | Openable, pose: Rigid | None) -> WorldObject:
    """Obstacle of an object at a pose (None: the initial one)."""
    pose = item.object.T_world_object if pose is None else pose
    R, t = pose.R.double().numpy(), pose.t.double().numpy()
    if isinstance(item, Openable):
        outline, z_range = item.outline, item.z_range
    else:
        outline = rectangle((0.0, 0.0), (2 * item.half_size[0], 2 * item.half_size[1]))
        z_range = (float(t[2]), float(t[2]) + item.height)
    heading = float(np.arctan2(R[1, 0], R[0, 0]))
    place = (float(t[0]), float(t[1]), float(t[2]))
    return WorldObject(item.name, item.category, outline @ R[:2, :2].T + t[:2], z_range, place, heading)


@dataclass
class _Builder(WorldBuilder):
    """A builder that keeps movable objects out of the world."""

    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    movables: list[Movable] = field(default_factory=list)
    openables: list[Openable] = field(default_factory=list)
    shut: set[int] = field(default_factory=set)
    """Indices of windows that cannot be opened."""

    def place(self, piece: Piece, position: tuple[float, float, float], heading: float) -> int:
        if isinstance(piece, _Loose):
            assert piece.movable is not None
            x, y, z = self.to_world(np.array(position)).tolist()
            self.movables.append(piece.movable.placed(x, y, self.heading + heading, z))
            return -1
        if piece.kind in FRONTED:
            x, y, z = position

            def floor_point(local: tuple[float, float]) -> np.ndarray:
                return self.to_world(np.array([*(turn(heading) @ np.array(local) + np.array([x, y])), z]))

            piece, openables = FRONTED[piece.kind](piece, floor_point, self.heading + heading, self.rng)
            self.openables += openables
        return super().place(piece, position, heading)


def build_interactive_flat(rng: np.random.Generator, name: str) -> InteractiveFlat:
    """A flat on one floor with at least a sofa, a table, a chair, a box, a window, doors and drawers that move."""
    while True:
        flat = _draw(np.random.default_rng(rng.integers(2**63)), name)
        kinds = Counter(item.category for item in (*flat.movables, *flat.openables))
        if all(kinds[kind] >= least for kind, least in FEWEST.items()) and kinds.total() >= FEWEST_OBJECTS:
            return flat


def _draw(rng: np.random.Generator, name: str) -> InteractiveFlat:
    heading, shift = rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist())
    builder = _Builder(name, heading, shift, rng=rng)
    lay_out(builder, rng, stairs=False, furnish=_furnish)
    static = builder.finish(cell=0.1)
    leaves = _add_door_leaves(builder, static, rng) + _add_sashes(builder, static, rng)
    return InteractiveFlat(static, tuple(_numbered(builder.movables)), tuple(_numbered([*leaves, *builder.openables])))


def _numbered(items: list) -> list:
    """The same items with names: door_1, door_2 …"""
    count: Counter[str] = Counter()
    out = []
    for item in items:
        count[item.category] += 1
        name = f"{item.category}_{count[item.category]}"
        out.append(replace(item, object=replace(item.object, name=name)))
    return out


def _furnish(plan: Plan, kind: str, rng: np.random.Generator) -> None:
    """Movable furniture first, then static furniture along the walls, with room in front of windows."""
    builder = plan.builder
    assert isinstance(builder, _Builder)
    for number, window in enumerate(builder.windows):
        if number not in builder.shut and rng.random() < (1 - WINDOW_SHARE) / 2:
            builder.shut.add(number)
        elif number not in builder.shut:
            plan.kept_free.append(_before_window(builder, window))
    for category in LOOSE[kind]:
        if rng.random() < 0.85:
            _place_loose(plan, category, rng)
    for category in FIXED[kind]:
        if rng.random() < 0.8:
            plan.against_wall(MAKERS[category](rng), rng)


def _loose(category: str, rng: np.random.Generator) -> _Loose:
    movable = make_movable(category, category, rng)
    size = (2 * movable.half_size[0], 2 * movable.half_size[1])
    return _Loose(category, size, (0.0, movable.height), (), movable=movable)


def _place_loose(plan: Plan, category: str, rng: np.random.Generator) -> None:
    piece = _loose(category, rng)
    x_low, y_low, x_high, y_high = plan.room
    if category == "box" or (category == "sofa" and rng.random() < 0.5):
        front = 0.0 if category == "box" else FRONT_M
        plan.against_wall(piece, rng, front=front)
        return
    for _ in range(16):
        heading = int(rng.integers(4)) * np.pi / 2 + rng.normal(0.0, 0.05)
        x, y = rng.uniform(x_low + 0.6, x_high - 0.6), rng.uniform(y_low + 0.6, y_high - 0.6)
        if plan.try_place(piece, x, y, heading):
            if category == "table":
                _chairs_at(plan, piece, (x, y, heading), rng)
            return


def _chairs_at(plan: Plan, table: Piece, spot: tuple[float, float, float], rng: np.random.Generator) -> None:
    """Chairs on a table's long sides."""
    x, y, heading = spot
    for side in (-1, 1):
        for across in (-0.25, 0.25):
            off = side * (table.size[0] / 2 + rng.uniform(0.30, 0.45))
            chair_xy = np.array([x, y]) + turn(heading) @ np.array([off, across * table.size[1]])
            facing = heading + (0.0 if side < 0 else np.pi) + rng.uniform(-0.3, 0.3)
            if rng.random() < 0.45:
                plan.try_place(_loose("chair", rng), float(chair_xy[0]), float(chair_xy[1]), facing)


def _before_window(builder: WorldBuilder, window: Door) -> Box:
    x, y = builder.from_world(np.array(window.position[:2]))
    along = abs(np.cos(window.heading - builder.heading)) > 0.5
    half_x, half_y = (1.0, window.width / 2 + 0.1) if along else (window.width / 2 + 0.1, 1.0)
    return (x - half_x, y - half_y, x + half_x, y + half_y)


def _add_door_leaves(builder: _Builder, static: World, rng: np.random.Generator) -> list[Openable]:
    """Door leaves in the gaps, mostly opening into rooms, on whichever side they have the space to."""
    leaves = []
    for door in builder.doors:
        variants = [(side, hand) for side in (-1.0, 1.0) for hand in (-1.0, 1.0)]
        into_hall = np.array([_room_at(static, door, side).startswith("hallway") for side, _ in variants])
        order = np.argsort(rng.random(4) + np.where(into_hall, rng.choice([0.0, 1.0], p=[0.2, 0.8]), 0.0))
        for side, hand in (variants[k] for k in order):
            foot, heading, opening_sign = _jamb(door, side, hand, door.width - 0.01)
            leaf = hinged(
                "door", foot, heading, opening_sign, door.width - 0.02, (0.01, DOOR_HEIGHT - 0.04), MOST_OPEN, rng
            )
            most = _free_angle(leaf, static, builder.movables, door.position)
            if most >= LEAST_OPEN:
                leaves.append(_ajar(_limited(leaf, most), rng, AJAR_SHARE))
                break
    return leaves


def _add_sashes(builder: _Builder, static: World, rng: np.random.Generator) -> list[Openable]:
    """Window sashes that open into the room; a window wider than one sash has two."""
    sashes = []
    for number, window in enumerate(builder.windows):
        sides = [side for side in (-1.0, 1.0) if _room_at(static, window, side)]
        if number in builder.shut or len(sides) != 1:
            continue
        single = window.width < 1.0
        width = min(window.width, 0.9) if single else window.width / 2
        hands = (float(rng.choice([-1.0, 1.0])),) if single else (-1.0, 1.0)
        for hand in hands:
            foot, heading, opening_sign = _jamb(window, sides[0], hand, window.width - 0.01)
            sash = hinged(
                "window",
                foot,
                heading,
                opening_sign,
                width - 0.02,
                (WINDOW[0] + 0.035, WINDOW[1] - 0.035),
                MOST_OPEN,
                rng,
            )
            most = _free_angle(sash, static, builder.movables, window.position)
            if most >= LEAST_OPEN:
                sashes.append(_ajar(_limited(sash, most), rng, AJAR_SHARE / 2))
    return sashes


def _jamb(gap: Door, side: float, hand: float, width: float) -> tuple[np.ndarray, float, float]:
    """Hinge's foot, heading of the closed leaf and sign of opening, for a leaf that opens towards `side` of a gap."""
    ahead = side * direction(gap.heading)
    along = hand * np.array([-ahead[1], ahead[0]])
    foot = np.array(gap.position)
    foot[:2] += (THICKNESS / 2 + FRAME_M) * ahead - width / 2 * along
    return (foot, float(np.arctan2(along[1], along[0])), float(np.sign(along[0] * ahead[1] - along[1] * ahead[0])))


def _room_at(static: World, gap: Door, side: float) -> str:
    """Name of the room half a metre away from a gap, "" outside."""
    point = np.array(gap.position[:2]) + side * 0.5 * direction(gap.heading)
    names = [room.name for room in static.rooms if points_in_convex(point[None], room.polygon)[0]]
    return names[0] if names else ""


def _free_angle(leaf: Openable, static: World, movables: list[Movable], gap: tuple[float, float, float]) -> float:
    """Angle to which a leaf opens before it touches something (rad), its own frame left aside."""
    solid = [item for item in static.objects if np.linalg.norm(np.array(item.position[:2]) - gap[:2]) < 4.0]
    solid += [obstacle(movable, None) for movable in movables]
    solid = [item for item in solid if item.z_range[0] < leaf.z_range[1] and item.z_range[1] > leaf.z_range[0]]
    angles = np.deg2rad(np.arange(15.0, 106.0, 5.0))
    edge = np.linspace(0.3, 1.0, 12)[:, None] * leaf.outline[1]  # along the leaf, away from the frame
    points = np.einsum("aij,ej->aei", leaf.pose(leaf.closed + leaf.opening_sign * angles).R[:, :2, :2].numpy(), edge)
    points = points + np.array(leaf.object.t_world_object[:2].tolist())
    apart = np.min([distance_to_convex(points, item.footprint).min(1) for item in solid], 0)
    hit = np.flatnonzero(apart < 0.02)
    return float(min(angles[hit[0] - 1] if len(hit) and hit[0] > 0 else (0.0 if len(hit) else MOST_OPEN), MOST_OPEN))


def _limited(leaf: Openable, most: float) -> Openable:
    """The leaf with an opening of at most `most` (rad)."""
    freedom = leaf.object.freedom
    low, high = (min(leaf.opening_sign * most, 0.0), max(leaf.opening_sign * most, 0.0))
    return replace(
        leaf, object=replace(leaf.object, freedom=replace(freedom, limits=(low, high))), opened=leaf.opening_sign * most
    )


def _ajar(leaf: Openable, rng: np.random.Generator, share: float) -> Openable:
    """The leaf closed or, in `share` of the cases, opened by 65° or more at first."""
    if rng.random() >= share:
        return leaf
    return at(leaf, leaf.opening_sign * float(rng.uniform(np.deg2rad(65.0), leaf.openness(leaf.opened))))
