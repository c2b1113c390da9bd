"""Collects surfaces, objects and their triangles into a World, in a local frame that is turned and shifted."""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from wearcap.geometry.mesh import Mesh, merged
from wearsim.places import world as w
from wearsim.places.outline import Box, middle_and_size, rectangle, turn

Color = tuple[float, float, float]
"""RGB, 0…1."""
Place = tuple[float, float, float]
"""x, y, z (m)."""
_BOX_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5],
     [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
)  # fmt: skip


@dataclass(frozen=True)
class Part:
    """A box or column of a piece of furniture, in the piece's frame (front +x, origin on the floor)."""

    center: Place
    size: tuple[float, float, float]
    color: Color
    texture: float = 6.0
    """Visual features per m²."""
    sides: int = 4
    """Number of sides: 4 is a box; more approximate a round column of diameter size[0]."""

    @property
    def box_size(self) -> tuple[float, float, float]:
        """Size of the box around the part (m)."""
        return self.size if self.sides == 4 else (self.size[0], self.size[0], self.size[2])


@dataclass(frozen=True)
class Piece:
    """A piece of furniture to place: its outline (length along its front, width), parts, seats and reachable points."""

    kind: str
    size: tuple[float, float]
    z_range: tuple[float, float]
    parts: tuple[Part, ...]
    seats: tuple[tuple[float, float, float, float, float], ...] = ()
    """x, y, height, heading, depth to the front edge."""
    reaches: tuple[Place, ...] = ()
    """Points a hand reaches for from the front."""

    @property
    def has_front(self) -> bool:
        """Whether it is used from its front."""
        return bool(self.seats or self.reaches)

    def mesh(self) -> Mesh:
        """The surface in the piece's own frame."""
        builder = WorldBuilder(self.kind)
        builder.place(self, (0.0, 0.0, 0.0), 0.0)
        return builder.mesh()

    def stretched(self, factor: float) -> "Piece":
        """The piece with all its heights times a factor, without points to reach for."""
        parts = tuple(
            replace(p, center=(*p.center[:2], p.center[2] * factor), size=(*p.size[:2], p.size[2] * factor))
            for p in self.parts
        )
        seats = tuple((x, y, factor * height, heading, depth) for x, y, height, heading, depth in self.seats)
        low, high = self.z_range
        return replace(self, parts=parts, seats=seats, z_range=(factor * low, factor * high), reaches=())


def hue(rng: np.random.Generator, saturation: tuple[float, float] = (0.15, 0.7)) -> Color:
    """A random RGB colour (0…1) of medium brightness."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(0.45, 0.9))


def entered(table: dict[str, Callable], *kinds: str) -> Callable:
    """Decorator that enters a maker in a table under a kind; a maker of several kinds is given its `kind`."""

    def enter(maker: Callable) -> Callable:
        table.update({kind: partial(maker, kind=kind) if len(kinds) > 1 else maker for kind in kinds})
        return maker

    return enter


class WorldBuilder:
    """Collects a world in the builder's frame; the finished world is turned by `heading` and moved by `shift`."""

    def __init__(
        self, name: str, heading: float = 0.0, shift: tuple[float, float] = (0.0, 0.0), outdoors: bool = False
    ):
        self.name, self.heading, self.shift, self.outdoors = name, heading, shift, outdoors
        self.objects: list[w.WorldObject] = []
        self.surfaces: list[w.Surface] = []
        self.places = w.Places()
        self.windows: list[w.Door] = []
        """Gaps above a sill, given by the floor point below them."""
        self._triangles: list[tuple] = []

    @classmethod
    def drawn(cls, name: str, rng: np.random.Generator, outdoors: bool = False) -> "WorldBuilder":
        """A builder with a random heading and shift."""
        return cls(name, rng.uniform(-np.pi, np.pi), tuple(rng.uniform(-5.0, 5.0, 2).tolist()), outdoors)

    def to_world(self, points: Float[np.ndarray, "*batch axis"]) -> Float[np.ndarray, "*batch axis"]:
        """Points (x y or x y z) of the builder's frame in the world."""
        out = np.array(points, dtype=np.float64)
        out[..., :2] = out[..., :2] @ turn(self.heading).T + np.array(self.shift)
        return out

    def point(self, *place: float) -> tuple:
        """A point (x y or x y z) of the builder's frame in the world."""
        return tuple(self.to_world(np.array(place)).tolist())

    def from_world(self, points_xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        return (points_xy - np.array(self.shift)) @ turn(self.heading)

    def add_triangles(self, vertices: np.ndarray, faces: np.ndarray, color, texture: float, item: int = -1) -> None:
        self._triangles.append((self.to_world(vertices), faces, color, texture, item))

    def add_box(self, center, size, color, texture: float = 6.0, heading: float = 0.0, item: int = -1, sides=4):
        """A box, or a column of `sides` sides, around `center` (m)."""
        if sides == 4:
            ring = rectangle(center[:2], size[:2], heading)
        else:
            angle = np.arange(sides) * 2 * np.pi / sides
            ring = np.stack([np.cos(angle), np.sin(angle)], 1) * size[0] / 2 + np.array(center[:2])
        low, high = (np.full((sides, 1), center[2] + side * size[2] / 2) for side in (-1, 1))
        vertices = np.concatenate([np.concatenate([ring, low], 1), np.concatenate([ring, high], 1)])
        self.add_triangles(vertices, _BOX_FACES if sides == 4 else _prism_faces(sides), color, texture, item)

    def add_prism(self, vertices: Float[np.ndarray, "corner 3"], color, texture: float, item: int = -1) -> None:
        """A solid between a lower ring of corners and the upper one that follows it, both counter-clockwise."""
        self.add_triangles(vertices, _prism_faces(len(vertices) // 2), color, texture, item)

    def add_surface(
        self, kind: str, polygon, color, *, plane=(0.0, 0.0, 0.0), level: int = 0, texture: float = 1.0, thickness=0.0
    ) -> None:
        """Add a walkable surface, as a Surface and as a slab of the given thickness (m)."""
        polygon = np.asarray(polygon, dtype=np.float64)
        a, b, c = plane
        top = np.concatenate([polygon, polygon @ np.array([[a], [b]]) + c], 1)
        if thickness:
            self.add_prism(np.concatenate([top - [0, 0, thickness], top]), color, texture)
        else:
            fan = np.array([[0, k, k + 1] for k in range(1, len(polygon) - 1)])
            self.add_triangles(top, fan, color, texture)
        gradient = turn(self.heading) @ np.array([a, b])
        offset = c - gradient @ np.array(self.shift)
        plane_world = (float(gradient[0]), float(gradient[1]), float(offset))
        self.surfaces.append(w.Surface(kind, self.to_world(polygon), plane_world, level))

    def add_slab(
        self, kind: str, box: Box, z: float, thickness: float, color, texture: float, plane=None, level: int = 0
    ) -> None:
        """A rectangle of ground whose top lies at z, or on a plane (of the builder's frame)."""
        outline = rectangle(*middle_and_size(box))
        plane = plane or (0.0, 0.0, z)
        self.add_surface(kind, outline, color, plane=plane, level=level, texture=texture, thickness=thickness)

    def add_room(self, name: str, corners, z: float, open_air: bool = False) -> None:
        """Name a part of the floor, given by its corners or its box."""
        if isinstance(corners, tuple):
            x_low, y_low, x_high, y_high = corners
            corners = np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])
        self.places.rooms.append(w.Room(name, self.to_world(corners), z, open_air))

    def add_object(self, kind: str, outline, z_range: tuple[float, float], position, heading: float = 0.0) -> int:
        """Add an obstacle without triangles; returns its index for `add_box(item=…)`."""
        number, place = len(self.objects), self.point(*position)
        name, footprint = f"{kind}_{number:03d}", self.to_world(outline)
        self.objects.append(w.WorldObject(name, kind, footprint, z_range, place, self.heading + heading))
        return number

    def add_block(self, kind: str, center, size, color, texture: float = 6.0, heading: float = 0.0) -> int:
        """Add a box that is an object by itself: a wall, a post, a hedge."""
        z_range = (center[2] - size[2] / 2, center[2] + size[2] / 2)
        outline = rectangle(center[:2], size[:2], heading)
        item = self.add_object(kind, outline, z_range, (center[0], center[1], z_range[0]), heading)
        self.add_box(center, size, color, texture, heading, item)
        return item

    def place(self, piece: Piece, position: Place, heading: float) -> int:
        """Put a piece of furniture on the floor point `position`, its front turned to `heading`."""
        x, y, z = position
        about = turn(heading)
        z_range = (z + piece.z_range[0], z + piece.z_range[1])
        item = self.add_object(piece.kind, rectangle((x, y), piece.size, heading), z_range, position, heading)
        for part in piece.parts:
            xy = about @ np.array(part.center[:2]) + np.array([x, y])
            center = (xy[0], xy[1], z + part.center[2])
            self.add_box(center, part.size, part.color, part.texture, heading, item, part.sides)
        for seat_x, seat_y, height, seat_heading, depth in piece.seats:
            spot = self.point(*(about @ np.array([seat_x, seat_y]) + (x, y)), z + height)
            self.places.seats.append(w.Seat(spot, self.heading + heading + seat_heading, height, depth))
        for reach in piece.reaches:
            front = piece.size[0] / 2 + 0.33
            self.add_reach(
                (*(about @ np.array(reach[:2]) + (x, y)), z + reach[2]),
                (*(about @ np.array([front, reach[1]]) + (x, y)), z),
                heading + np.pi,
            )
        return item

    def add_reach(self, position, stand, heading: float) -> None:
        self.places.reach_targets.append(
            w.ReachTarget(self.point(*position), self.point(*stand), self.heading + heading)
        )

    def finish(self, cell: float = 0.1) -> w.World:
        """The world, without the seats and reach targets that no walker can stand in front of.

        `cell` is the side of a cell of its planning grid (m).
        """
        face_counts = [len(t[1]) for t in self._triangles]
        draft = w.World(
            name=self.name,
            mesh=self.mesh(),
            face_object=np.repeat([t[4] for t in self._triangles], face_counts),
            face_texture=np.repeat(np.array([t[3] for t in self._triangles], np.float64), face_counts),
            objects=tuple(self.objects),
            surfaces=tuple(self.surfaces),
            places=self.places,
            cell=cell,
            outdoors=self.outdoors,
        )
        grid = draft.navigation

        def reachable(point: np.ndarray, within_m: float) -> bool:
            node = grid.nearest_node(point)
            return node is not None and bool(np.linalg.norm(grid.node_points[node][:2] - point[:2]) < within_m)

        seats = [seat for seat in self.places.seats if reachable(seat.standing_point(), 0.45)]
        targets = [each for each in self.places.reach_targets if reachable(np.array(each.stand), 0.15)]
        world = replace(draft, places=replace(self.places, seats=seats, reach_targets=targets))
        world.__dict__["navigation"] = grid
        return world

    def mesh(self) -> Mesh:
        """All triangles so far, in the world."""
        return merged(
            [
                Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.array(color, np.float32))
                for vertices, faces, color, *_ in self._triangles
            ]
        )


def _prism_faces(sides: int) -> np.ndarray:
    """Triangles of a prism whose vertices are its lower ring, then its upper ring, both counter-clockwise."""
    faces = [[0, k + 1, k] for k in range(1, sides - 1)]
    faces += [[sides, sides + k, sides + k + 1] for k in range(1, sides - 1)]
    for k in range(sides):
        n = (k + 1) % sides
        faces += [[k, n, sides + n], [k, sides + n, sides + k]]
    return np.array(faces)
