"""The surroundings of a simulated wearer: surfaces to stand on, seats, reach targets, obstacles and the visible mesh.

World frame: metres, z up, the ground floor at z = 0. Headings are angles (rad) about z, 0 along +x.
A builder (`flat.build_flat`, `outdoor.build_outdoor`, `site.build_site`) fills it; walking and planning use
`navigation`, which sees only surfaces (stood on) and objects (obstacles), so that a new kind of object
needs no change there.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from wearcap.geometry.mesh import Mesh
from wearsim.places.navigation import NavigationGrid
from wearsim.places.outline import points_in_convex

STEP_UP_M = 0.35
"""Largest height above the last floor at which a foot finds a floor."""
CALF_TO_EDGE_M = 0.12


@dataclass(frozen=True)
class WorldObject:
    """An obstacle with a footprint, which walkers keep off; its faces are those of the world's mesh with its index."""

    name: str
    kind: str
    """"wall", "door_frame", "sofa", "chair", "table", "bed", "shelf", "counter", "railing", "tree", …"""
    footprint: Float[np.ndarray, "corner 2"]
    """Convex outline from above, counter-clockwise, in the world (m)."""
    z_range: tuple[float, float]
    position: tuple[float, float, float]
    heading: float


@dataclass(frozen=True)
class Surface:
    """A walkable surface: a convex polygon seen from above, on the plane z = a x + b y + c."""

    kind: str
    """"floor", "stairs_step", "ramp" or "kerb"."""
    polygon: Float[np.ndarray, "corner 2"]
    plane: tuple[float, float, float]
    level: int = 0
    """Storey: surfaces of one level never lie above each other, except steps and kerbs on their ground."""

    def height(self, points_xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        a, b, c = self.plane
        return a * points_xy[..., 0] + b * points_xy[..., 1] + c


@dataclass(frozen=True)
class Seat:
    """A place to sit: where the middle of the buttocks touches the seat, and where the sitter then looks."""

    position: tuple[float, float, float]
    heading: float
    height: float
    """Height of the seat above the floor (m)."""
    depth: float
    """Distance from `position` forward to the seat's front edge (m)."""

    def standing_point(self) -> Float[np.ndarray, "3"]:
        """Floor point below the pelvis of someone who stands in front of the seat, ready to sit down (m)."""
        (x, y, z), reach = self.position, self.depth + CALF_TO_EDGE_M
        return np.array([x + reach * np.cos(self.heading), y + reach * np.sin(self.heading), z - self.height])


@dataclass(frozen=True)
class ReachTarget:
    """A point that a hand reaches for, and where to stand for it and which way to face."""

    position: tuple[float, float, float]
    stand: tuple[float, float, float]
    """Floor point to stand on (m)."""
    heading: float


@dataclass(frozen=True)
class Flight:
    """Straight stairs: step k = 1 … steps rises to base_z + k · rise; the last step is the upper floor itself.

    With a single step it is a place at which a kerb is crossed. Step k < steps covers [(k − 1) · tread, k · tread]
    along `direction` from `start`.
    """

    start: tuple[float, float]
    """Middle of the foot of the first riser (m)."""
    direction: float
    """Heading when going up (rad)."""
    steps: int
    rise: float
    tread: float
    width: float
    base_z: float

    @property
    def length(self) -> float:
        """Horizontal distance from the first riser to the last (m)."""
        return (self.steps - 1) * self.tread

    @property
    def top_z(self) -> float:
        return self.base_z + self.steps * self.rise

    @property
    def left(self) -> np.ndarray:
        """Unit vector to the left when going up."""
        return np.array([-np.sin(self.direction), np.cos(self.direction)])

    def up_and_left(self, points_xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (m) of points from `start` along `direction`, and to its left."""
        along = np.array([np.cos(self.direction), np.sin(self.direction)])
        offset = points_xy - np.array(self.start)
        return offset @ along, offset @ self.left


@dataclass(frozen=True)
class Room:
    name: str
    polygon: Float[np.ndarray, "corner 2"]
    z: float
    open_air: bool = False


@dataclass(frozen=True)
class CaptureSpot:
    """A free square of floor beside a table, to which a recording returns repeatedly."""

    position: tuple[float, float, float]
    """Middle of the square on the floor (m)."""
    heading: float
    """Heading towards the table (rad)."""
    size: float
    """Side of the square (m)."""
    table_m: float
    """Distance from the middle to the table's edge."""
    table_z: float
    """Height of the table's top above the floor (m)."""


@dataclass(frozen=True)
class Door:
    """A gap in a wall; heading is the direction of walking through it."""

    position: tuple[float, float, float]
    heading: float
    width: float


@dataclass(frozen=True)
class Places:
    """Where one sits, reaches, climbs, passes, and returns to in a recording."""

    seats: list[Seat] = field(default_factory=list)
    reach_targets: list[ReachTarget] = field(default_factory=list)
    flights: list[Flight] = field(default_factory=list)
    rooms: list[Room] = field(default_factory=list)
    doors: list[Door] = field(default_factory=list)
    spots: list[CaptureSpot] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class World:
    """Seeded surroundings. `face_object` gives each face of `mesh` its object (index), or -1 for the shell."""

    name: str
    mesh: Mesh
    face_object: Int[np.ndarray, "face"]
    face_texture: Float[np.ndarray, "face"]
    """Visual features per m² of each face: near 0 on blank walls, hundreds on book spines."""
    objects: tuple[WorldObject, ...]
    surfaces: tuple[Surface, ...]
    places: Places
    cell: float = 0.1
    """Side of a cell of the planning grid (m)."""
    outdoors: bool = False

    def floor_height(
        self, points_xy: Float[np.ndarray, "*batch 2"], near_z: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch"]:
        """Height (m) of the highest surface not above near_z + 0.35 m; NaN where there is none."""
        flat_xy = points_xy.reshape(-1, 2).astype(np.float64)
        limit = near_z.reshape(-1) + STEP_UP_M
        best = np.full(len(flat_xy), -np.inf)
        for surface in self.surfaces:
            inside = np.nonzero(points_in_convex(flat_xy, surface.polygon))[0]
            height = surface.height(flat_xy[inside])
            height[height > limit[inside]] = -np.inf
            best[inside] = np.maximum(best[inside], height)
        best[np.isinf(best)] = np.nan
        return best.reshape(near_z.shape)

    @cached_property
    def navigation(self) -> NavigationGrid:
        """The planning grid, built at first use."""
        return NavigationGrid.build(self.surfaces, self.objects, self.cell)

    def on_stairs(self, points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, "point"]:
        """Whether floor points lie on a flight or within a step of its ends."""
        near = np.zeros(len(points), bool)
        for flight in self.places.flights:
            run, side = flight.up_and_left(points[:, :2])
            near |= (run > -0.8) & (run < flight.length + 0.8) & (np.abs(side) < flight.width / 2 + 0.1)
        return near

    def plan_path(
        self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "waypoint 3"] | None:
        """A smooth path over the floor from start to goal, both floor points (m), across stairs too.

        Waypoints stand about 0.1 m apart on the floor, the first is `start`, the last `goal`; they keep 0.28 m
        off obstacles, except on the last steps to a start or goal that is nearer to one itself (a seat).
        `rng` varies how far from walls this walk likes to be. None when no path leads there.
        """
        path = self.navigation.path(start, goal, self.places.flights, rng)
        if path is not None:
            floor = self.floor_height(path[:, :2], path[:, 2])
            path[:, 2] = np.where(np.isnan(floor), path[:, 2], floor)
        return path

    def sample_floor(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "count 3"]:
        """Random floor points (m) in the largest connected walkable part."""
        nodes = self.navigation.node_points
        points = nodes[rng.integers(len(nodes), size=count)]
        points[:, :2] += rng.uniform(-0.5, 0.5, (count, 2)) * self.cell
        points[:, 2] = self.floor_height(points[:, :2], points[:, 2])
        return points
