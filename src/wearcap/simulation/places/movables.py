"""Objects that a wearer slides or carries: their shape, their support, and the places where hands hold them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Freedom, SceneObject
from wearcap.simulation.handling.grips import SKIN_M, GripPlace, Vector, vector
from wearcap.simulation.places import furniture, handhelds
from wearcap.simulation.places.builder import Part, Piece, hue, piece_mesh
from wearcap.simulation.places.handhelds import Grasp, Handheld


@dataclass(frozen=True)
class Rail:
    """A straight segment of an object on which hands rest, for a holder on one side of it; in the object's axes."""

    start: Vector
    """End on the holder's left (m)."""
    stop: Vector
    normal: Vector
    fingers: Vector
    facing: float
    """Heading of the holder relative to the object's (rad)."""
    stand_off: float
    """Distance from the middle of the rail back to the footprint's edge, against `facing` (m)."""
    both_hands: bool = True

    @property
    def length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.stop, self.start)))

    def at(self, along: float, tilt: float = 0.0) -> GripPlace:
        """A place `along` the rail from its start (m), the hand tipped towards the holder by `tilt` (rad)."""
        share = along / self.length if self.length > 0 else 0.0
        point = np.array(self.start) + share * np.subtract(self.stop, self.start)
        normal, fingers = np.array(self.normal), np.array(self.fingers)
        normal, fingers = (
            np.cos(tilt) * normal - np.sin(tilt) * fingers,
            np.cos(tilt) * fingers + np.sin(tilt) * normal,
        )
        return GripPlace(vector(point + SKIN_M * normal), vector(normal), vector(fingers))


@dataclass(frozen=True, eq=False)
class Movable:
    """An object to be moved by hand; its own axes have the front at +x, the origin on the floor below its middle."""

    object: SceneObject
    half_size: tuple[float, float]
    """Half size of the footprint along the object's x and y (m)."""
    height: float
    rails: tuple[Rail, ...] = ()
    """Rails where it is pushed and pulled."""
    sides: tuple[tuple[GripPlace, GripPlace, float], ...] = ()
    """Options for lifting it between both hands: the left and right palm's places and the holder's relative heading."""
    grasps: tuple[Grasp, ...] = ()
    """Options for lifting it with one hand."""

    @property
    def name(self) -> str:
        return self.object.name

    @property
    def category(self) -> str:
        return self.object.category

    def placed(self, x: float, y: float, heading: float, z: float = 0.0) -> "Movable":
        """The same object with another initial pose (m, rad)."""
        R, t = rotation.about_axis("z", torch.tensor(heading)), torch.tensor([x, y, z])
        return replace(self, object=replace(self.object, R_world_object=R, t_world_object=t))


def floor_pose(place: Float[np.ndarray, "*batch 3"], z: float | np.ndarray = 0.0) -> Rigid:
    """Pose of an object that stands at x, y with a heading (m, m, rad), `z` above the world's zero (m)."""
    at = torch.from_numpy(np.asarray(place, np.float64))
    height = torch.as_tensor(np.asarray(z, np.float64)).expand(at.shape[:-1])
    return Rigid(rotation.about_axis("z", at[..., 2]), torch.cat([at[..., :2], height[..., None]], -1))


def make_movable(category: str, name: str, rng: np.random.Generator) -> Movable:
    """A movable object of a category of `MOVABLES` with drawn size and colour, at the world's origin."""
    return MOVABLES[category](name, rng)


def _sofa(name: str, rng: np.random.Generator) -> Movable:
    """A sofa, held at the upper edge of its back from behind, or of an arm from that side."""
    piece = furniture.armchair(rng) if rng.random() < 0.3 else furniture.sofa(rng)
    half_depth, half_width = piece.size[0] / 2, piece.size[1] / 2
    back = Rail((-half_depth + 0.012, half_width - 0.1, 0.85), (-half_depth + 0.012, 0.1 - half_width, 0.85),
                (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 0.0, 0.012)  # fmt: skip
    rails = [back]
    for sign in (1.0, -1.0):
        y = sign * (half_width - 0.015)
        back_end, front_end = (-half_depth + 0.3, y, 0.62), (half_depth - 0.06, y, 0.62)
        # who looks at the right arm (sign < 0) has the sofa's back on the left
        start, stop = (back_end, front_end) if sign < 0 else (front_end, back_end)
        rails.append(Rail(start, stop, (0.0, 0.0, 1.0), (0.0, -sign, 0.0), -sign * np.pi / 2, 0.015))
    return _sliding(name, "sofa", piece, rails)


def _table(name: str, rng: np.random.Generator) -> Movable:
    """A table, held at its top's edges."""
    piece = furniture.table(rng)
    bare = replace(piece, parts=piece.parts[:5])  # The four legs and the top; nothing stands on a table that is moved.
    half_depth, half_width = piece.size[0] / 2, piece.size[1] / 2
    top = piece.z_range[1]
    rails = []
    for facing in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        ahead, left = np.array([np.cos(facing), np.sin(facing)]), np.array([-np.sin(facing), np.cos(facing)])
        deep = abs(ahead @ np.array([half_depth, half_width]))
        wide = abs(left @ np.array([half_depth, half_width])) - 0.08
        edge = -(deep - 0.012) * ahead
        ends = (np.append(edge + sign * wide * left, top) for sign in (1.0, -1.0))
        start, stop = (vector(end) for end in ends)
        rails.append(Rail(start, stop, (0.0, 0.0, 1.0), (float(ahead[0]), float(ahead[1]), 0.0), facing, 0.012))
    return _sliding(name, "table", bare, rails)


def _chair(name: str, rng: np.random.Generator) -> Movable:
    """A chair, held at the top of its backrest, from behind or, with one hand, from beside it."""
    piece = furniture.chair(rng)
    half_depth, half_width, top = piece.size[0] / 2, piece.size[1] / 2, piece.z_range[1]
    x = -half_depth + 0.02
    up = (0.0, 0.0, 1.0)
    rails = [Rail((x, half_width - 0.04, top), (x, 0.04 - half_width, top), up, (1.0, 0.0, 0.0), 0.0, 0.02)]
    for sign in (1.0, -1.0):
        end = (x, sign * (half_width - 0.06), top)
        rails.append(Rail(end, end, up, (0.0, -sign, 0.0), -sign * np.pi / 2, 0.06, both_hands=False))
    return _sliding(name, "chair", piece, rails)


def _box(name: str, rng: np.random.Generator) -> Movable:
    """A box, lifted between the palms, which press on two opposite faces."""
    depth, width = rng.uniform(0.20, 0.45), rng.uniform(0.25, 0.55)
    height, color = (rng.uniform(0.20, 0.50), hue(rng, (0.2, 0.6)) if rng.random() < 0.4 else (0.68, 0.52, 0.35))
    piece = Piece("box", (depth, width), (0.0, height), (Part((0, 0, height / 2), (depth, width, height), color),))
    level, up = float(rng.uniform(0.35, 0.6) + 0.6 * max(height - 0.3, 0.0)) * height, (0.0, 0.0, 1.0)
    sides = []
    for facing, half in ((0.0, width / 2), (np.pi, width / 2), (np.pi / 2, depth / 2), (-np.pi / 2, depth / 2)):
        ahead, left = (
            np.array([np.cos(facing), np.sin(facing), 0.0]),
            np.array([-np.sin(facing), np.cos(facing), 0.0]),
        )
        fingers = vector((ahead - 0.35 * np.array(up)) / np.hypot(1.0, 0.35))
        hands = (
            GripPlace(vector(sign * (half + SKIN_M) * left + [0.0, 0.0, level]), vector(sign * left), fingers)
            for sign in (1.0, -1.0)
        )
        sides.append((*hands, facing))
    movable = _of_piece(name, "box", piece, Freedom("free"))
    return replace(movable, sides=tuple(sides))


def _handheld(
    category: str, make: Callable[[np.random.Generator], Handheld]
) -> Callable[[str, np.random.Generator], Movable]:
    def movable(name: str, rng: np.random.Generator) -> Movable:
        shape = make(rng)
        scene_object = SceneObject(name, category, shape.mesh, torch.eye(3), torch.zeros(3), Freedom("free"))
        half_size = (shape.size[0] / 2, shape.size[1] / 2)
        return Movable(scene_object, half_size, shape.height, sides=shape.sides, grasps=shape.grasps)

    return movable


def _sliding(name: str, category: str, piece: Piece, rails: list[Rail]) -> Movable:
    return replace(_of_piece(name, category, piece, Freedom("plane")), rails=tuple(rails))


def _of_piece(name: str, category: str, piece: Piece, freedom: Freedom) -> Movable:
    scene_object = SceneObject(name, category, piece_mesh(piece), torch.eye(3), torch.zeros(3), freedom)
    return Movable(scene_object, (piece.size[0] / 2, piece.size[1] / 2), piece.z_range[1])


MOVABLES: dict[str, Callable[[str, np.random.Generator], Movable]] = {
    "sofa": _sofa,
    "table": _table,
    "chair": _chair,
    "box": _box,
    **{category: _handheld(category, make) for category, make in handhelds.MAKERS.items()},
}
