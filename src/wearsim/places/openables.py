"""Objects that are opened and closed in place: door leaves, window sashes, and the doors and drawers of cabinets.

Axes of hinged objects: the origin is the hinge's foot, +x leads along the leaf to its latch. Axes of a drawer: the
origin is the middle of its closed front's foot, +x leads out of the cabinet, whose carcass belongs to the world.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Freedom, SceneObject
from wearsim.handling.grips import SKIN_M, GripPlace, Handled, vector
from wearsim.places.builder import Part, Piece, hue
from wearsim.places.furniture import PATTERNED, PLAIN, parts_of, wood

LEAF_M, PANEL_M = 0.04, 0.02
"""Thickness of doors and sashes, and of cabinets' fronts."""
METAL = (0.45, 0.45, 0.47)
SHOULDER_M = 1.3
"""Approximate shoulder height: it decides how steeply a hand meets a handle."""
PASSABLE = np.deg2rad(60.0)
"""Least opening at which a door can be passed."""
LOW_M, HIGH_M = 0.38, 1.1
"""Height range of the middles of fronts that can be opened; others stay shut."""
GAP_M = 0.006
MOST_OPEN = np.deg2rad(100.0)
"""Largest angle to which a leaf opens."""
FloorPoint = Callable[[tuple[float, float]], Float[np.ndarray, "3"]]
"""Maps a point in the frame of a piece of furniture to a floor point in the world (m)."""


@dataclass(frozen=True, eq=False)
class Openable(Handled):
    """A hinged or sliding object with handles. Values are those of `Freedom`: 0 is the initial pose."""

    outline: Float[np.ndarray, "4 2"]
    """Outline from above, in its own axes, counter-clockwise (m)."""
    z_range: tuple[float, float]
    handles: tuple[GripPlace, ...]
    """Handles: the first on the side to which it opens, where it is pulled open; a door's second on the other side."""
    closed: float
    opened: float
    """Value at the limit of its opening."""

    @property
    def hinged(self) -> bool:
        return self.object.freedom.kind == "hinge"

    @property
    def opening_sign(self) -> float:
        """Sign of the value's change in opening."""
        return float(np.sign(self.opened - self.closed))

    def pose(self, value: float | Float[np.ndarray, "*batch"]) -> Rigid:
        """Pose in the world at a value."""
        return self.object.freedom.moved(self.object.T_world_object, torch.as_tensor(np.asarray(value, np.float64)))

    def at(self, value: float) -> "Openable":
        """The same openable with its initial pose at `value`, which becomes the new zero."""
        pose, freedom = self.pose(value), self.object.freedom
        assert freedom.limits is not None
        freedom = replace(freedom, limits=(min(freedom.limits[0] - value, 0.0), max(freedom.limits[1] - value, 0.0)))
        moved = replace(self.object, R_world_object=pose.R.float(), t_world_object=pose.t.float(), freedom=freedom)
        return replace(self, object=moved, closed=self.closed - value, opened=self.opened - value)

    def openness(self, value: float) -> float:
        """Opening at a value (rad or m)."""
        return float(abs(value - self.closed))

    def footprint(self, values: float | Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 4 2"]:
        """Outline in the world, counter-clockwise (m)."""
        pose = self.pose(values)
        R, t = pose.R[..., :2, :2].numpy(), pose.t[..., :2].numpy()
        return np.einsum("...ij,cj->...ci", R, self.outline) + t[..., None, :]

    def handle(self, number: int, values: float | Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Position of the palm on a handle, in the world (m)."""
        pose = self.pose(values)
        return pose.t.numpy() + pose.R.numpy() @ np.array(self.handles[number].point)

    def pushed_at(self, number: int, rng: np.random.Generator) -> GripPlace:
        """A place for a flat palm on the face beside a handle, in its own axes: its front is pushed there."""
        x_low, y_low, x_high, y_high = *self.outline.min(0), *self.outline.max(0)
        low, high = (z - float(self.object.t_world_object[2]) for z in self.z_range)
        z = float(np.clip(rng.uniform(0.95, 1.45), low + 0.05, high - 0.05))
        aside = rng.normal(0.0, 0.35)
        if not self.hinged:  # its handle stands out by 3 cm beyond the front
            y = rng.uniform(0.2, 0.45) * (y_high - y_low) * rng.choice([-1.0, 1.0])
            return GripPlace((SKIN_M, y, z), (1.0, 0.0, 0.0), vector(np.array([0.0, np.sin(aside), np.cos(aside)])))
        sign = self.opening_sign * (1 if number == 0 else -1)
        edge = 0.03 if self.category == "window" else rng.uniform(0.10, 0.45) * (x_high - x_low)
        point = (x_high - edge, (y_high if sign > 0 else y_low) + sign * SKIN_M, z)
        return GripPlace(point, (0.0, sign, 0.0), vector(np.array([np.sin(aside), 0.0, np.cos(aside)])))

    def blocks(self, value: float) -> bool:
        """Whether it is a door that is not open enough to walk through."""
        return self.category == "door" and bool(self.openness(value) < PASSABLE)


def _hook(point: tuple[float, float, float], inwards: tuple[float, float]) -> GripPlace:
    """A hand over a handle, its fingers towards the surface and as steep as an arm from the shoulder comes.

    `inwards` is the unit direction to the surface in the plane.
    """
    fingers = np.array([*(0.5 * np.array(inwards)), np.clip(point[2] - SHOULDER_M, -0.8, 0.35)])
    fingers /= np.linalg.norm(fingers)
    rise = float(np.hypot(*fingers[:2]))
    normal = np.array([*(-fingers[2] * np.array(inwards)), rise])
    return GripPlace(point, vector(normal), vector(fingers))


def hinged(
    category: str,
    foot: Float[np.ndarray, "3"],
    heading: float,
    opening_sign: float,
    width: float,
    z_range: tuple[float, float],
    rng: np.random.Generator,
) -> Openable:
    """An unnamed leaf with its hinge's foot at `foot` (m), closed along `heading` (rad), opening by `MOST_OPEN`.

    `opening_sign` is the sense of opening about z; `z_range` is above the foot (m).
    """
    thick, is_door = PANEL_M if category == "cabinet_door" else LEAF_M, category == "door"
    low, high = z_range
    edge = rng.uniform(0.06, 0.08) if is_door else rng.uniform(0.03, 0.05)
    level = {"door": float(rng.uniform(1.0, 1.05)), "window": float(np.clip((low + high) / 2, 1.2, 1.5))}.get(
        category, float(np.clip(high - 0.15, low + 0.1, rng.uniform(1.0, 1.1)))
    )
    off, color = -opening_sign * thick / 2, wood(rng) if rng.random() < 0.5 else hue(rng, (0.0, 0.25))
    middle, tall = (low + high) / 2, high - low
    if category == "window":  # a frame around a pane
        bar, pane = 0.06, (0.75, 0.85, 0.9)
        rows: list[tuple] = [
            *((x, off, middle, bar, thick, tall, color, 6.0) for x in (bar / 2, width - bar / 2)),
            *((width / 2, off, z, width, thick, bar, color, 6.0) for z in (low + bar / 2, high - bar / 2)),
            (width / 2, off, middle, width - bar, 0.008, tall - bar, pane, 0.5),
        ]
    else:
        rows = [(width / 2, off, middle, width, thick, tall, color, PLAIN)]
    if is_door and rng.random() < 0.6:
        panel = (0.66 * width, thick + 0.012, 0.33 * tall, color, 8.0)
        rows += [(width / 2, off, low + share * tall, *panel) for share in (0.25, 0.72)]
    handles = []
    place, size = width - edge, (0.02, 0.02, 0.12)
    if is_door:
        place, size = width - edge - 0.11 / 2, (0.11, 0.02, 0.02)
    for side in (opening_sign, -opening_sign) if is_door else (opening_sign,):
        face = 0.0 if side == opening_sign else thick
        out = side * (face + 0.05)
        rows.append((place, out, level, *size, METAL, PATTERNED))
        rows.append((width - edge, side * (face + 0.02), level, 0.02, 0.06, 0.02, METAL, PATTERNED))
        handles.append(_hook((place, out, level), (0.0, -side)))
    most = opening_sign * MOST_OPEN
    freedom = Freedom("hinge", pivot=vector(foot), limits=(min(most, 0.0), max(most, 0.0)))
    y_low, y_high = sorted((0.0, -opening_sign * thick))
    return _made(category, rows, foot, heading, freedom, ((0.0, y_low), (width, y_high)), z_range, handles, most)


def _drawer(
    front: Float[np.ndarray, "3"],
    heading: float,
    width: float,
    level: tuple[float, float],
    depth: float,
    travel: float,
    rng: np.random.Generator,
) -> Openable:
    """An unnamed drawer; its closed front is over the floor point `front` (m) and slides `travel` (m) along `heading`.

    `level` is the front's lower and upper edge above the floor (m).
    """
    color, (low, high) = wood(rng), level
    tall, grasp = high - low, 0.5 * low + 0.5 * high
    side = (low + 0.35 * tall, depth - 0.02, 0.015, 0.6 * tall, color, PLAIN)
    rows = [
        (-PANEL_M / 2, 0.0, (low + high) / 2, PANEL_M, width, tall, color, PLAIN),
        (-depth / 2, 0.0, low + 0.02, depth - 0.02, width - 0.04, 0.02, color, PLAIN),
        *((-depth / 2, sign * (width / 2 - 0.03), *side) for sign in (-1, 1)),
        (0.03, 0.0, grasp, 0.015, min(0.16, 0.4 * width), 0.015, METAL, PATTERNED),
    ]
    handle = _hook((0.03, float(rng.uniform(-0.03, 0.03)), grasp), (-1.0, 0.0))
    axis = (float(np.cos(heading)), float(np.sin(heading)), 0.0)
    freedom = Freedom("axis", axis=axis, limits=(0.0, travel))
    corners = ((-depth, -width / 2), (0.03, width / 2))
    return _made("drawer", rows, front, heading, freedom, corners, level, [handle], travel)


def _made(
    category: str,
    rows: list[tuple],
    foot: Float[np.ndarray, "3"],
    heading: float,
    freedom: Freedom,
    corners: tuple[tuple[float, float], tuple[float, float]],
    z_range: tuple[float, float],
    handles: list[GripPlace],
    opened: float,
) -> Openable:
    """An openable of rows of parts, closed at a place; `corners` are the lowest and the highest of its outline (m)."""
    mesh = Piece(category, (1.0, 1.0), (0.0, 1.0), parts_of(rows)).mesh()
    R = rotation.about_axis("z", torch.tensor(heading, dtype=torch.float64)).float()
    made = SceneObject(category, category, mesh, R, torch.from_numpy(np.asarray(foot)).float(), freedom)
    (x_low, y_low), (x_high, y_high) = corners
    outline = np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])
    levels = (foot[2] + z_range[0], foot[2] + z_range[1])
    return Openable(made, outline, levels, tuple(handles), 0.0, opened)


def with_fronts(
    piece: Piece, floor_point: FloorPoint, heading: float, rng: np.random.Generator
) -> tuple[Piece, list[Openable]]:
    """The carcass of a cabinet or wardrobe of a piece's outline, and its doors and drawers; other pieces as they are.

    A cabinet is 0.8–1.15 m high, in columns of drawers or a door each; a wardrobe has doors of 0.45–0.65 m.
    """
    (depth, width), foot = piece.size, 0.06
    if piece.kind not in ("cabinet", "wardrobe"):
        return piece, []

    def door(span: tuple[float, float], level: tuple[float, float], hand: float) -> Openable:
        """A door hinged at the right (`hand` 1, seen from the front) or left end of its span."""
        low, high = span
        hinge = floor_point((depth / 2, low + GAP_M / 2 if hand > 0 else high - GAP_M / 2))
        along, sense = (heading + np.pi / 2, -1.0) if hand > 0 else (heading - np.pi / 2, 1.0)
        return hinged("cabinet_door", hinge, along, sense, high - low - GAP_M, level, rng)

    if piece.kind == "wardrobe":
        height, columns = piece.z_range[1], int(np.ceil(width / 0.65))
        wide = width / columns
        doors = [
            door((-width / 2 + k * wide, -width / 2 + (k + 1) * wide), (0.08, height - 0.03), -1.0 if k % 2 else 1.0)
            for k in range(columns)
        ]
        return replace(piece, parts=(_carcass(depth, width, foot, height, rng),)), doors
    height = float(rng.uniform(0.8, 1.15))
    columns = max(int(np.ceil(width / 0.8)), 1)
    wide = width / columns
    parts, openables = [_carcass(depth, width, foot, height, rng)], []
    for column in range(columns):
        middle = -width / 2 + (column + 0.5) * wide
        if rng.random() >= 0.7:
            level = (foot + 0.02, height - 0.02)
            openables.append(door((middle - wide / 2, middle + wide / 2), level, float(rng.choice([-1.0, 1.0]))))
            continue
        edges = np.linspace(foot + 0.02, height - 0.02, int(rng.integers(3, 5)) + 1)
        for low, high in pairwise(edges.tolist()):
            if LOW_M < (low + high) / 2 < HIGH_M:
                travel = float(rng.uniform(0.3, min(0.5, depth - 0.06)))
                front, level = floor_point((depth / 2, middle)), (low + GAP_M, high)
                openables.append(_drawer(front, heading, wide - GAP_M, level, depth - 0.04, travel, rng))
            else:
                size = (0.02, wide - GAP_M, high - low - GAP_M)
                parts.append(Part((depth / 2 - 0.01, middle, (low + high) / 2), size, (0.5, 0.4, 0.3), 3.0))
    return replace(piece, z_range=(0.0, height), parts=tuple(parts)), openables


def _carcass(depth: float, width: float, foot: float, height: float, rng: np.random.Generator) -> Part:
    size = (depth - 0.025, width, height - foot)
    return Part((-0.0125, 0.0, (foot + height) / 2), size, wood(rng), 3.0)
