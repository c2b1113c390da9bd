"""Editing a scan into an interactive environment: select points, cut out objects, set their freedom, undo.

An object's default freedom comes from its footprint on the floor: likely places of its hinge or slide axis.
"""

import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import ConvexHull, KDTree, QhullError

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap.scene.scan import Box, Scan, SlicedCloud

USUAL_KIND = {
    "door": "hinge",
    "window": "hinge",
    "drawer": "axis",
    "sofa": "plane",
    "table": "plane",
    "chair": "plane",
    "cupboard": "plane",
    "box": "free",
    "other": "plane",
}
"""Default kind of freedom of each offered category."""
FEWEST_POINTS = 20
"""Fewest points of an object."""
_SAME_M = 0.0005
"""Distance within which an object's point and a scan point are the same point."""
_SURFACE_M = 0.02
"""Distance to an object's triangles within which scan points belong to the object."""
_OUTSIDE_M = 0.5
_LAYER_M = 0.02
_AROUND_M = 1.5
_OPEN = (0.0, np.pi / 2)
_PULLED_M = (0.0, 0.4)
_HISTORY = 200
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True, eq=False)
class _Cut:
    item: SceneObject
    points: Int64[np.ndarray, "taken"]
    """Indices of the object's points in the scan, ascending."""


@dataclass(frozen=True, eq=False)
class _State:
    cuts: tuple[_Cut, ...]
    selected: Int64[np.ndarray, "point"]


class ObjectEditing:
    """Editing session: the objects cut out of a scan, the selected points, and the undo history.

    Every method call is one `undo` step; consecutive calls with the same `stroke` (a brush stroke, a dragged slider)
    form one step together. The scan itself never changes.
    """

    def __init__(self, scan: Scan, environment: Environment | None = None):
        """Raises WearcapError for objects outside this scan."""
        self.scan = scan
        self._cloud = SlicedCloud(scan.points)
        objects = environment.objects if environment is not None else ()
        taken = tuple(_Cut(item, self._points_of(item)) for item in objects)
        self._state = _State(taken, np.empty(0, np.int64))
        self._past: list[_State] = []
        self._stroke: object = None

    @property
    def selected(self) -> Int64[np.ndarray, "point"]:
        """Indices of the selected points, ascending."""
        return self._state.selected

    @property
    def environment(self) -> Environment:
        """All objects, in the order in which they were made."""
        return Environment(tuple(cut.item for cut in self._state.cuts))

    @property
    def revision(self) -> object:
        """Token that changes identity whenever the environment changes (not when only the selection does)."""
        return self._state.cuts

    def left(self) -> Bool[np.ndarray, "point"]:
        """Points of the scan that belong to no object."""
        left = np.ones(len(self.scan.points), bool)
        for cut in self._state.cuts:
            left[cut.points] = False
        return left

    def select_box(self, box: Box, add: bool = True) -> None:
        """Add the points in a box to the selection, or remove them."""
        self._select(self._cloud.in_box(box), add)

    def select_ball(
        self, center: Float[np.ndarray, "3"], radius_m: float, add: bool = True, stroke: object = None
    ) -> None:
        """Add the points around a position to the selection, or remove them (brush)."""
        self._select(self._cloud.in_ball(center, radius_m), add, stroke)

    def clear_selection(self) -> None:
        self._select(self.selected, add=False)

    def _select(self, points: Int64[np.ndarray, "inside"], add: bool, stroke: object = None) -> None:
        if add:
            for cut in self._state.cuts:
                points = np.setdiff1d(points, cut.points, assume_unique=True)
            points = np.union1d(self.selected, points)
        else:
            points = np.setdiff1d(self.selected, points, assume_unique=True)
        if len(points) != len(self.selected):
            self._step(replace(self._state, selected=points), stroke)

    def cut(self, name: str, category: str, kind: str | None = None) -> SceneObject:
        """Make the selected points an object, with the default freedom of its category or of the kind.

        Its origin is the middle of its footprint on the floor, its axes are the world's. Raises WearcapError for
        too few points or an invalid name.
        """
        self._check_name(name)
        if len(self.selected) < FEWEST_POINTS:
            what = f"{len(self.selected)} points are selected"
            fix = "Select the object's points with the box or the brush first."
            raise WearcapError(what, expected=f"{FEWEST_POINTS} or more", fix=fix)
        points = self.scan.points[self.selected]
        remaining = self.left()
        remaining[self.selected] = False
        floor = _floor_below(points, self.scan.points[remaining])
        origin = np.array([*Footprint.of(points).center, floor])
        colors = np.full(3, 0.6, np.float32)
        if self.scan.colors is not None:
            colors = self.scan.colors[self.selected].astype(np.float32) / 255
        mesh = Mesh((points - origin).astype(np.float32), np.empty((0, 3), np.int32), colors)
        kind = kind or USUAL_KIND.get(category, "plane")
        item = SceneObject(
            name, category, mesh, torch.eye(3), torch.from_numpy(origin).float(), _usual_freedom(kind, points, floor)
        )
        self._step(_State((*self._state.cuts, _Cut(item, self.selected)), np.empty(0, np.int64)))
        return item

    def free_name(self, category: str) -> str:
        """A name that no object has: "door_1", "door_2", …"""
        names = {cut.item.name for cut in self._state.cuts}
        return next(name for k in range(1, len(names) + 2) if (name := f"{category}_{k}") not in names)

    def rename(self, name: str, new: str) -> None:
        """Rename an object. Raises WearcapError for an invalid name."""
        if new != name:
            self._check_name(new)
            self._change(replace(self._find(name).item, name=new), name)

    def set_freedom(self, name: str, freedom: Freedom, stroke: object = None) -> None:
        self._change(replace(self._find(name).item, freedom=freedom), name, stroke)

    def set_kind(self, name: str, kind: str) -> None:
        """Set the kind of freedom, with its default parameters."""
        item = self._find(name).item
        if kind != item.freedom.kind:
            points, floor = item.points_world, float(item.t_world_object[2])
            self.set_freedom(name, _usual_freedom(kind, points, floor))

    def delete(self, name: str) -> None:
        """Give the object's points back to the scan."""
        gone = self._find(name)
        self._step(replace(self._state, cuts=tuple(cut for cut in self._state.cuts if cut is not gone)))

    def undo(self) -> bool:
        """Undo one step; returns whether there was one."""
        self._stroke = None
        if not self._past:
            return False
        self._state = self._past.pop()
        return True

    def _step(self, state: _State, stroke: object = None) -> None:
        if stroke is None or stroke != self._stroke:
            self._past = [*self._past[-_HISTORY + 1 :], self._state]
        self._state, self._stroke = state, stroke

    def _change(self, item: SceneObject, name: str, stroke: object = None) -> None:
        cuts = (replace(cut, item=item) if cut.item.name == name else cut for cut in self._state.cuts)
        self._step(replace(self._state, cuts=tuple(cuts)), stroke)

    def _find(self, name: str) -> _Cut:
        return self._state.cuts[self.environment.index(name)]

    def _check_name(self, name: str) -> None:
        if not _NAME.fullmatch(name):
            expected = "letters, digits, _ and -: it becomes a file's name"
            raise WearcapError(f"an object cannot be named {name!r}", expected=expected)
        if name.lower() in {cut.item.name.lower() for cut in self._state.cuts}:
            raise WearcapError(f"there is an object {name!r} already", expected="another name")

    def _points_of(self, item: SceneObject) -> Int64[np.ndarray, "taken"]:
        """The scan's points that an object of a file consists of, or that lie on its triangles.

        Raises WearcapError for an object without points, or outside the scan.
        """
        points, scan = item.points_world, self.scan.points
        if not len(points):
            raise WearcapError("an object without a shape", where=item.name, expected="a mesh or a cloud")
        low, high = points.min(0), points.max(0)
        middle = (low + high) / 2
        beyond = float(np.maximum(scan.min(0) - middle, middle - scan.max(0)).max())
        if beyond > _OUTSIDE_M:
            what = f"the object {item.name!r} stands {beyond:.1f} m outside the scan"
            fix = "Give the scan that it was made from, or another environment file."
            raise WearcapError(what, expected="an environment of this scene", fix=fix)
        low, high = low - _SURFACE_M, high + _SURFACE_M
        around = self._cloud.in_box(Box(tuple((low + high) / 2), tuple(high - low)))
        if not len(around):
            return around
        there = scan[around].astype(np.float64)
        if not len(item.mesh.faces):
            return around[KDTree(points).query(there, distance_upper_bound=_SAME_M)[0] <= _SAME_M]
        R, t = item.R_world_object.double().numpy(), item.t_world_object.double().numpy()
        distance, _ = TriangleIndex.of(item.mesh).nearest((there - t) @ R)
        return around[distance <= _SURFACE_M]


@dataclass(frozen=True)
class Footprint:
    """The smallest rectangle around an object seen from above (world axes, m)."""

    center: Float[np.ndarray, "2"]
    long: Float[np.ndarray, "2"]
    """Unit vector along the longer side."""
    half_length: float
    half_width: float

    @property
    def short(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the shorter side, to the left of `long`."""
        return np.array([-self.long[1], self.long[0]])

    @classmethod
    def of(cls, points: Float[np.ndarray, "point 3"]) -> "Footprint":
        """The rectangle of least area around points seen from above; one of its sides lies on the convex hull."""
        plan = points[:, :2].astype(np.float64)
        try:
            corners = plan[ConvexHull(plan).vertices]
        except QhullError:  # fewer than three points, or all on one line
            corners = plan
        edges = np.roll(corners, -1, axis=0) - corners
        length = np.linalg.norm(edges, axis=1)
        along = edges[length > 0] / length[length > 0, None] if (length > 0).any() else np.array([[1.0, 0.0]])
        across = np.stack([-along[:, 1], along[:, 0]], 1)
        low, high = ((reduce(corners @ along.T, 0), reduce(corners @ across.T, 0)) for reduce in (np.min, np.max))
        sides = np.stack([high[0] - low[0], high[1] - low[1]], 1)
        best = int(sides.prod(1).argmin())
        center = (low[0][best] + high[0][best]) / 2 * along[best] + (low[1][best] + high[1][best]) / 2 * across[best]
        length, width = sides[best]
        long = along[best] if length >= width else across[best]
        return cls(center, long, max(length, width) / 2, min(length, width) / 2)


def _floor_below(points: Float[np.ndarray, "point 3"], scene: Float[np.ndarray, "other 3"]) -> float:
    """Height (m) of the floor that an object stands on: the lowest strong layer of the scene's points around it.

    Without scene points below it, the object's own lowest point.
    """
    low, high, bottom = points[:, :2].min(0), points[:, :2].max(0), float(points[:, 2].min())
    around = ((scene[:, :2] > low - _AROUND_M) & (scene[:, :2] < high + _AROUND_M)).all(1)
    heights = scene[around & (scene[:, 2] < bottom + 0.05), 2].astype(np.float64)
    if not len(heights):
        return bottom
    first = heights.min()
    layer = ((heights - first) / _LAYER_M).astype(np.int64)
    counts = np.bincount(layer)
    floor = int(np.argmax(counts >= 0.3 * counts.max()))
    return float(np.median(heights[abs(layer - floor) <= 1]))


def hinge_places(points: Float[np.ndarray, "point 3"], floor: float) -> Float[np.ndarray, "place 3"]:
    """Likely hinges of a door or window: middles of its two ends, then its corners, then the middles of its sides."""
    plan = Footprint.of(points)
    ends, sides = plan.half_length * plan.long, plan.half_width * plan.short
    offsets = [-ends, ends, sides - ends, -sides - ends, ends + sides, ends - sides, sides, -sides]
    # A corner of the rectangle may stand far off what is not rectangular: never outside of its extent.
    places = np.clip(plan.center + np.array(offsets), points[:, :2].min(0), points[:, :2].max(0))
    return np.concatenate([places, np.full((len(places), 1), floor)], 1)


def snapped(
    place: Float[np.ndarray, "3"], places: Float[np.ndarray, "place 3"], reach_m: float
) -> Float[np.ndarray, "3"]:
    """The horizontally nearest of some places if it is within reach; else the place itself, at their height."""
    distance = np.linalg.norm(places[:, :2] - place[:2], axis=1)
    if distance.min() <= reach_m:
        return places[distance.argmin()]
    return np.array([place[0], place[1], places[0, 2]])


def _usual_freedom(kind: str, points: Float[np.ndarray, "point 3"], floor: float) -> Freedom:
    """Default freedom: a hinge at one end, opening to 90°; a slide of 40 cm across the longer side."""
    if kind == "hinge":
        x, y, z = hinge_places(points, floor)[0].tolist()
        return Freedom("hinge", pivot=(x, y, z), limits=_OPEN)
    if kind == "axis":
        x, y = Footprint.of(points).short.tolist()
        return Freedom("axis", axis=(x, y, 0.0), limits=_PULLED_M)
    return Freedom(kind)
