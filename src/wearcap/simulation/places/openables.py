"""Objects that are opened and closed in place: door leaves, window sashes, cabinet doors and drawers.

Axes of hinged objects: the origin is the hinge's foot, +x leads along the leaf to its latch. Axes of a drawer: the
origin is the middle of its closed front's foot, +x leads out of the cabinet.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Freedom, SceneObject
from wearcap.simulation.handling.grips import GripPlace, vector
from wearcap.simulation.places.builder import Part, Piece, hue, piece_mesh
from wearcap.simulation.places.furniture import PATTERNED, PLAIN, wood
from wearcap.simulation.places.outline import turn

LEAF_M, PANEL_M = 0.04, 0.02
"""Thickness of doors and sashes, and of cabinets' fronts."""
METAL = (0.45, 0.45, 0.47)
SHOULDER_M = 1.3
"""Approximate shoulder height: it decides how steeply a hand meets a handle."""
PASSABLE = np.deg2rad(60.0)
"""Least opening at which a door can be passed."""


@dataclass(frozen=True, eq=False)
class Openable:
    """A hinged or sliding object with handles. Values are those of `Freedom`: 0 is the initial pose."""

    object: SceneObject
    outline: Float[np.ndarray, "4 2"]
    """Outline from above, in its own axes, counter-clockwise (m)."""
    z_range: tuple[float, float]
    handles: tuple[GripPlace, ...]
    """Handles: the first on the side to which it opens, where it is pulled open; a door's second on the other side."""
    closed: float
    opened: float
    """Value at the limit of its opening."""

    @property
    def name(self) -> str:
        return self.object.name

    @property
    def category(self) -> str:
        return self.object.category

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

    def blocks(self, value: float) -> bool:
        """Whether it is a door that is not open enough to walk through."""
        return self.category == "door" and bool(self.openness(value) < PASSABLE)


def hook(point: tuple[float, float, float], inwards: tuple[float, float]) -> GripPlace:
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
    most: float,
    rng: np.random.Generator,
) -> Openable:
    """An unnamed leaf with its hinge's foot at `foot` (m), closed along `heading` (rad), opening by `most` (rad).

    `opening_sign` is the sense of opening about z; `z_range` is above the foot (m).
    """
    thick = PANEL_M if category == "cabinet_door" else LEAF_M
    low, high = z_range
    edge = rng.uniform(0.06, 0.08) if category == "door" else rng.uniform(0.03, 0.05)
    level = {"door": float(rng.uniform(1.0, 1.05)), "window": float(np.clip((low + high) / 2, 1.2, 1.5))}.get(
        category, float(np.clip(high - 0.15, low + 0.1, rng.uniform(1.0, 1.1)))
    )
    parts = _leaf(category, width, thick, low, high, opening_sign, rng)
    handles = []
    for side in (opening_sign, -opening_sign) if category == "door" else (opening_sign,):
        face = 0.0 if side == opening_sign else thick
        out = side * (face + 0.05)
        long = 0.11 if category != "cabinet_door" else 0.02
        middle = width - edge - long / 2
        size = (long, 0.02, 0.02) if category == "door" else (0.02, 0.02, 0.12)
        place = middle if category == "door" else width - edge
        parts.append(Part((place, out, level), size, METAL, PATTERNED))
        parts.append(Part((width - edge, side * (face + 0.02), level), (0.02, 0.06, 0.02), METAL, PATTERNED))
        handles.append(hook((place, out, level), (0.0, -side)))
    spin = rotation.about_axis("z", torch.tensor(heading, dtype=torch.float64)).float()
    freedom = Freedom(
        "hinge", pivot=vector(foot), limits=(min(opening_sign * most, 0.0), max(opening_sign * most, 0.0))
    )
    scene_object = SceneObject(
        category, category, _mesh(category, parts), spin, torch.from_numpy(np.asarray(foot)).float(), freedom
    )
    outline = _box_outline((0.0, width), sorted((0.0, -opening_sign * thick)))
    return Openable(scene_object, outline, (foot[2] + low, foot[2] + high), tuple(handles), 0.0, opening_sign * most)


def _leaf(
    category: str, width: float, thick: float, low: float, high: float, opening_sign: float, rng: np.random.Generator
) -> list[Part]:
    """Parts of a leaf: a slab, or a frame around a pane."""
    off, color = -opening_sign * thick / 2, wood(rng) if rng.random() < 0.5 else hue(rng, (0.0, 0.25))
    middle, tall = (low + high) / 2, high - low
    if category != "window":
        parts = [Part((width / 2, off, middle), (width, thick, tall), color, PLAIN)]
        if category == "door" and rng.random() < 0.6:
            parts += [
                Part((width / 2, off, low + share * tall), (0.66 * width, thick + 0.012, 0.33 * tall), color, 8.0)
                for share in (0.25, 0.72)
            ]
        return parts
    bar, pane = 0.06, (0.75, 0.85, 0.9)
    parts = [Part((x, off, middle), (bar, thick, tall), color, 6.0) for x in (bar / 2, width - bar / 2)]
    parts += [Part((width / 2, off, z), (width, thick, bar), color, 6.0) for z in (low + bar / 2, high - bar / 2)]
    return [*parts, Part((width / 2, off, middle), (width - bar, 0.008, tall - bar), pane, 0.5)]


def drawer(
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
    tall = high - low
    parts = [
        Part((-PANEL_M / 2, 0.0, (low + high) / 2), (PANEL_M, width, tall), color, PLAIN),
        Part((-depth / 2, 0.0, low + 0.02), (depth - 0.02, width - 0.04, 0.02), color, PLAIN),
    ]
    parts += [
        Part(
            (-depth / 2, side * (width / 2 - 0.03), low + 0.35 * tall), (depth - 0.02, 0.015, 0.6 * tall), color, PLAIN
        )
        for side in (-1, 1)
    ]
    grasp = 0.5 * low + 0.5 * high
    parts.append(Part((0.03, 0.0, grasp), (0.015, min(0.16, 0.4 * width), 0.015), METAL, PATTERNED))
    handle = hook((0.03, float(rng.uniform(-0.03, 0.03)), grasp), (-1.0, 0.0))
    axis = (float(np.cos(heading)), float(np.sin(heading)), 0.0)
    spin = rotation.about_axis("z", torch.tensor(heading, dtype=torch.float64)).float()
    scene_object = SceneObject(
        "drawer",
        "drawer",
        _mesh("drawer", parts),
        spin,
        torch.from_numpy(np.asarray(front)).float(),
        Freedom("axis", axis=axis, limits=(0.0, travel)),
    )
    outline = _box_outline((-depth, 0.03), (-width / 2, width / 2))
    return Openable(scene_object, outline, (front[2] + low, front[2] + high), (handle,), 0.0, travel)


def at(openable: Openable, value: float) -> Openable:
    """The same openable with its initial pose at `value`, which becomes the new zero."""
    pose, freedom = openable.pose(value), openable.object.freedom
    assert freedom.limits is not None
    limits = (min(freedom.limits[0] - value, 0.0), max(freedom.limits[1] - value, 0.0))
    moved = replace(
        openable.object,
        R_world_object=pose.R.float(),
        t_world_object=pose.t.float(),
        freedom=replace(freedom, limits=limits),
    )
    return replace(openable, object=moved, closed=openable.closed - value, opened=openable.opened - value)


def _mesh(kind: str, parts: list[Part]):
    return piece_mesh(Piece(kind, (1.0, 1.0), (0.0, 1.0), tuple(parts)))


def _box_outline(x: tuple[float, float], y) -> Float[np.ndarray, "4 2"]:
    return np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])


def direction(heading: float) -> Float[np.ndarray, "2"]:
    """Unit vector of a heading (rad)."""
    return turn(heading)[:, 0]
