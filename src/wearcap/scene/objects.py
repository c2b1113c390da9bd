"""Objects of an interactive environment: shape, initial pose and degrees of freedom (thesis §5.2), validation of their
meshes; the object nearest to a hand; and motion with the hands that hold an object (thesis §5.3.3, eq. 5.3–5.7)."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError, require_choice
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.triangle_distance import BodiesIndex, TriangleIndex

FREEDOMS = {
    "plane": "slides on the floor",
    "axis": "slides along an axis",
    "hinge": "turns about a hinge",
    "free": "is carried",
}
"""Kinds of freedom, in words."""
CONTACT_CLASSES = ("sliding", "hinged")
"""Kinds of interaction that have a contact network each (thesis §5.3.2)."""
UNKNOWN_CLASS = ""
"""Kind of an interaction that nobody named: any object may be in contact."""
EXTENTS_M = (0.01, 5.0)
"""Longest side of the box around an object that a person handles (m)."""
MAX_OFF_CENTER = 1.0
"""How far the origin may lie from the box around the mesh, as a share of the box's longest side."""


@dataclass(frozen=True)
class Freedom:
    """How an object moves from its initial pose. Raises WearcapError for a kind without what it needs.

    "plane": slides and turns on the floor; "axis": slides along a line; "hinge": turns about a vertical axis;
    "free": is carried. World axes.
    """

    kind: str
    pivot: tuple[float, float, float] | None = None
    """A point of the hinge's axis (m)."""
    axis: tuple[float, float, float] | None = None
    """Direction of sliding, a unit vector."""
    limits: tuple[float, float] | None = None
    """Least and greatest angle (rad, counter-clockwise from above) or displacement along the axis (m); initially 0."""

    def __post_init__(self):
        require_choice(self.kind, FREEDOMS, f"no degree of freedom {self.kind!r}")
        if (self.kind == "hinge") != (self.pivot is not None):
            what = f"a {self.kind} {'with' if self.pivot else 'without'} a pivot"
            raise WearcapError(what, expected="a hinge and a point of its axis together")
        if (self.kind == "axis") != (self.axis is not None):
            what = f"{self.kind!r} {'with' if self.axis else 'without'} an axis"
            raise WearcapError(what, expected="a slide along an axis and its direction together")
        if self.axis is not None and abs(float(np.linalg.norm(self.axis)) - 1.0) > 1e-3:
            raise WearcapError(f"axis {self.axis}", expected="a unit vector")
        if self.limits is not None and not self.limits[0] <= 0.0 <= self.limits[1]:
            raise WearcapError(f"limits {self.limits}", expected="least ≤ 0 ≤ greatest: 0 is the initial pose")

    @property
    def contact_class(self) -> str:
        """Contact network responsible for the object: "hinged" or "sliding"."""
        return "hinged" if self.kind == "hinge" else "sliding"

    def clamped(self, value: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Angle or displacement, clamped to the limits."""
        return value if self.limits is None else value.clamp(*self.limits)

    def moved(self, T_world_object: Rigid, value: Float[Tensor, "*batch"]) -> Rigid:
        """Pose of an object with initial pose `T_world_object` at a hinge angle (rad) or axis displacement (m)."""
        if self.kind == "hinge":
            R = rotation.about_axis("z", value)
            pivot = torch.tensor(self.pivot, dtype=value.dtype)
            arm = T_world_object.t.to(value.dtype) - pivot
            return Rigid(R @ T_world_object.R.to(value.dtype), pivot + (R @ arm[..., None])[..., 0])
        if self.kind == "axis":
            shift = value[..., None] * torch.tensor(self.axis, dtype=value.dtype)
            R = T_world_object.R.to(value.dtype).expand(*value.shape, 3, 3)
            return Rigid(R, T_world_object.t.to(value.dtype) + shift)
        raise ValueError(f"{self.kind!r} has no single value")


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A movable object: a mesh (or a cloud: no faces) in its own axes, and its initial pose."""

    name: str
    category: str
    """"door", "window", "drawer", "sofa", "table", "chair", "box", …"""
    mesh: Mesh
    R_world_object: Float[Tensor, "3 3"]
    t_world_object: Float[Tensor, "3"]
    freedom: Freedom

    @property
    def T_world_object(self) -> Rigid:
        return Rigid(self.R_world_object, self.t_world_object)

    def reachable(self, T_world_object: Rigid, middle: Float[Tensor, "3"]) -> Rigid:
        """The nearest pose that the object's freedom allows, by its `middle` (m, in the mesh's axes): on its hinge or axis
        within the limits, or upright at its height on the floor. A free object may be anywhere."""
        kind, start = self.freedom.kind, self.T_world_object.to(torch.float64)
        if kind == "free":
            return T_world_object
        found = T_world_object.to(torch.float64)
        here, there = start.t + start.R @ middle.double(), found.t + (found.R @ middle.double()[:, None])[..., 0]
        if kind == "plane":
            turn = (found.R @ start.R.mT)[..., :2, :2]
            yaw = torch.atan2(turn[..., 1, 0] - turn[..., 0, 1], turn[..., 0, 0] + turn[..., 1, 1])
            R = rotation.about_axis("z", yaw) @ start.R
            t = there - (R @ middle.double()[:, None])[..., 0]
            place = Rigid(R, torch.cat([t[..., :2], start.t[2].expand_as(t[..., :1])], -1))
        elif kind == "axis":
            value = ((there - here) * torch.tensor(self.freedom.axis, dtype=torch.float64)).sum(-1)
            place = self.freedom.moved(start, self.freedom.clamped(value))
        else:
            pivot = torch.tensor(self.freedom.pivot, dtype=torch.float64)[:2]
            arm, found_arm = (here[:2] - pivot).expand_as(there[..., :2]), there[..., :2] - pivot
            cross = arm[..., 0] * found_arm[..., 1] - arm[..., 1] * found_arm[..., 0]
            angle = torch.atan2(cross, (arm * found_arm).sum(-1))
            place = self.freedom.moved(start, self.freedom.clamped(angle))
        return Rigid(place.R.to(T_world_object.R), place.t.to(T_world_object.t))

    def displaced(
        self, turn: Float64[Tensor, "3 3"], about: Float64[Tensor, "3"], to: Float64[Tensor, "3"]
    ) -> "SceneObject":
        """The object turned about a point (m) that goes to another place, its hinge or axis with it."""
        freedom = self.freedom

        def place(point: Float64[Tensor, "3"]) -> Float64[Tensor, "3"]:
            return to + turn @ (point - about)

        if freedom.pivot is not None:
            pivot = place(torch.tensor(freedom.pivot, dtype=torch.float64))
            freedom = replace(freedom, pivot=tuple(pivot.tolist()))
        if freedom.axis is not None:
            axis = turn @ torch.tensor(freedom.axis, dtype=torch.float64)
            freedom = replace(freedom, axis=tuple(axis.tolist()))
        R = (turn @ self.R_world_object.double()).to(self.R_world_object)
        t = place(self.t_world_object.double()).to(self.t_world_object)
        return replace(self, R_world_object=R, t_world_object=t, freedom=freedom)

    @property
    def points_world(self) -> Float64[np.ndarray, "vertex 3"]:
        """Vertices in the world (m) at the initial pose."""
        R, t = self.R_world_object.double().numpy(), self.t_world_object.double().numpy()
        return self.mesh.vertices.astype(np.float64) @ R.T + t

    @property
    def box_world(self) -> Float64[np.ndarray, "2 3"]:
        """Minimum and maximum corner (m) of the bounding box at the initial pose, in the world."""
        points = self.points_world
        return np.stack([points.min(0), points.max(0)])

    @property
    def hinge_gap_m(self) -> float:
        """Horizontal distance of the hinge from the bounding box; 0 for objects without a hinge."""
        if self.freedom.pivot is None:
            return 0.0
        low, high = self.box_world[:, :2]
        pivot = np.array(self.freedom.pivot[:2])
        return float(np.linalg.norm(np.maximum(np.maximum(low - pivot, pivot - high), 0.0)))

    def check(self, where: str | Path) -> None:
        """`check_object_mesh` of an environment's object; one on a hinge or axis may be in the axes of its mount."""
        check_object_mesh(self.mesh, where, self.freedom.kind not in ("hinge", "axis"))


def centered(mesh: Mesh) -> tuple[Mesh, Float64[np.ndarray, "3"]]:
    """The mesh with the mean of its vertices at the origin, and where that mean was in its former axes.

    Raises WearcapError for a mesh without vertices.
    """
    if not len(mesh.vertices):
        raise WearcapError("a mesh without vertices", expected="at least one triangle")
    center = mesh.vertices.astype(np.float64).mean(0)
    return replace(mesh, vertices=(mesh.vertices - center).astype(np.float32)), center


def check_object_mesh(mesh: Mesh, where: str | Path, own_axes: bool = True) -> None:
    """Raise WearcapError unless a mesh can be an object's, in metres and in axes of its own.

    Refused, each with its own message: no vertices, coordinates that are NaN or infinite, no faces, faces of vertices
    that are not there, a longest side outside `EXTENTS_M` (millimetres), and an origin further from the box around the
    mesh than `MAX_OFF_CENTER` of its longest side (a mesh that was left in a scan's or a capture's axes). Without
    `own_axes` the origin may be anywhere.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    if not len(vertices):
        raise WearcapError("the object's mesh has no vertices", where=where, expected="at least one triangle")
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        what = f"{int(bad.sum())} vertices of the object's mesh are NaN or infinite, the first is {int(bad.argmax())}"
        raise WearcapError(what, where=where, expected="finite coordinates (m)", fix="Export the mesh again.")
    if not len(faces):
        what = "the object's mesh has no faces"
        fix = "Export it as a triangle mesh."
        raise WearcapError(what, where=where, expected="triangles, not a point cloud", fix=fix)
    if faces.min() < 0 or faces.max() >= len(vertices):
        what = f"a face of the object's mesh names vertex {faces.max()}, there are {len(vertices)}"
        raise WearcapError(what, where=where, expected="faces of its own vertices")
    low, high = vertices.min(0), vertices.max(0)
    extent, (least, greatest) = float((high - low).max()), EXTENTS_M
    if not least <= extent <= greatest:
        millimetres = extent > greatest and least <= extent / 1000 <= greatest
        what = f"the object's mesh is {extent:.4g} m long"
        fix = "It looks like millimetres: divide by 1000." if millimetres else "Bring it to metres."
        raise WearcapError(what, where=where, expected=f"{least:g} to {greatest:g} m", fix=fix)
    off = float(np.linalg.norm(np.maximum(np.maximum(low, -high), 0.0)))
    if own_axes and off > MAX_OFF_CENTER * (high - low).max():
        what = f"the object's mesh is not centred: its origin lies {off:.2f} m outside of the box around it"
        expected = "axes of its own, with the origin in or near the object"
        fix = "Subtract the mean of its vertices, and place its poses accordingly."
        raise WearcapError(what, where=where, expected=expected, fix=fix)


@dataclass(frozen=True)
class Nearest:
    """The object nearest to each of some points of the world."""

    object_index: Int64[Tensor, "query"]
    """Index in `Environment.objects`; -1 where none is within reach."""
    distance: Float[Tensor, "query"]
    """Distance (m) from the point to the object's surface; infinity where none is within reach."""


@dataclass(frozen=True, eq=False)
class Environment:
    """An interactive environment: objects with unique names. Raises WearcapError for repeated names."""

    objects: tuple[SceneObject, ...]

    def __post_init__(self):
        repeated = [name for name, count in Counter(item.name for item in self.objects).items() if count > 1]
        if repeated:
            raise WearcapError(f"several objects are named {repeated[0]!r}", expected="unique names")

    def __len__(self) -> int:
        return len(self.objects)

    def by_name(self, name: str) -> SceneObject:
        """The object of that name. Raises WearcapError where there is none."""
        return self.objects[self.index(name)]

    def index(self, name: str) -> int:
        """Index of the object of that name. Raises WearcapError where there is none."""
        if name not in self._index:
            raise WearcapError(f"no object {name!r}", expected=f"one of {', '.join(self._index) or 'none'}")
        return self._index[name]

    @cached_property
    def _index(self) -> dict[str, int]:
        return {item.name: k for k, item in enumerate(self.objects)}

    @cached_property
    def _at_rest(self) -> tuple[list[TriangleIndex], BodiesIndex, np.ndarray, np.ndarray]:
        """Tree of each object, shared by those of one mesh; index of all; their initial rotations and positions."""
        meshes = list({id(item.mesh): item.mesh for item in self.objects}.values())
        of_body = np.array([[mesh is item.mesh for mesh in meshes].index(True) for item in self.objects], np.int64)
        shapes = [TriangleIndex.of(mesh) for mesh in meshes]
        R = np.array([item.R_world_object.tolist() for item in self.objects], np.float64)
        t = np.array([item.t_world_object.tolist() for item in self.objects], np.float64)
        return [shapes[k] for k in of_body], BodiesIndex.build(shapes, of_body), R, t

    def nearest(
        self,
        points_world: Float[Tensor, "query 3"],
        T_world_object: dict[str, Rigid] | None = None,
        contact_class: str | None = None,
        reach_m: float = float("inf"),
    ) -> Nearest:
        """The nearest object to each point, by exact distance to triangles (to points, in a cloud).

        Objects are at `T_world_object` where it names them, else at their initial pose; with a `contact_class` only
        objects of that class count. A point with NaN has no nearest object.
        """
        if contact_class is not None:
            require_choice(contact_class, CONTACT_CLASSES, f"no contact class {contact_class!r}")
        moved = {self.index(name): pose for name, pose in (T_world_object or {}).items()}
        chosen = np.flatnonzero([contact_class in (None, item.freedom.contact_class) for item in self.objects])
        if not len(chosen):
            nothing = torch.full((len(points_world),), -1)
            return Nearest(nothing, torch.full_like(nothing, torch.inf, dtype=points_world.dtype))
        _, bodies, R, t = self._at_rest
        R, t = R.copy(), t.copy()
        for k, pose in moved.items():
            R[k], t[k] = pose.R.numpy(), pose.t.numpy()
        index, distance = bodies.nearest(
            points_world.double().contiguous().numpy(), chosen, R[chosen], t[chosen], float(reach_m)
        )
        return Nearest(torch.from_numpy(index), torch.from_numpy(distance).to(points_world.dtype))

    def distance(
        self, name: str, points_world: Float[Tensor, "time 3"], T_world_object: Rigid
    ) -> tuple[Float[Tensor, "time"], Float[Tensor, "time 3"]]:
        """Distance (m) of a point to one object over time, and the object's closest point in the world.

        `T_world_object` is the object's pose at each time, or one pose for all. NaN where the point is NaN.
        """
        shape, R, t = self._at_rest[0][self.index(name)], T_world_object.R.double(), T_world_object.t.double()
        local = (R.mT @ (points_world.double() - t)[..., None])[..., 0]
        distance, point = shape.nearest(local.contiguous().numpy())
        closest = (R @ torch.from_numpy(point)[..., None])[..., 0] + t
        return torch.from_numpy(distance).to(points_world.dtype), closest.to(points_world.dtype)


ANCHORS = ("right", "middle")
"""Reference point of an object held by two hands: the right hand (thesis), or the middle of both (ours)."""
_LEAST_APART_M = 0.05
"""Smallest distance between the hands that defines a direction; below it the last angle is kept."""


@dataclass(frozen=True)
class ObjectState:
    """Pose of an object, and its hinge angle or displacement."""

    T_world_object: Rigid
    value: float = 0.0
    """Hinge angle (rad) or displacement along the axis (m) from the initial pose; 0 for other kinds."""


def follow_hands(
    item: SceneObject,
    state: ObjectState,
    palms_world: Float[Tensor, "time hand 3"],
    holds: Bool[Tensor, "hand"],
    anchor: str = "middle",
) -> tuple[Rigid, Float[Tensor, "time"]]:
    """Poses of an object from the frame of the grasp (in `state`) on, and its angle or displacement (0 for others).

    `palms_world` holds the palm centres of the left and the right hand (m); `holds` marks the hands that hold the
    object. A hinge or axis stays within its limits; an object that slides in the plane keeps its height.
    """
    palms = palms_world[:, holds].double()
    kind = item.freedom.kind
    if kind in ("hinge", "axis"):
        if kind == "hinge":  # signed angle of the palms about the hinge (eq. 5.6, 5.4), averaged over hands
            arm = palms[..., :2] - torch.tensor(item.freedom.pivot, dtype=palms.dtype)[:2]
            change = _turned(arm.transpose(0, 1)).mean(0)
        else:
            change = ((palms - palms[:1]) @ torch.tensor(item.freedom.axis, dtype=palms.dtype)).mean(1)
        value = item.freedom.clamped(state.value + change)
        return item.freedom.moved(item.T_world_object, value), value
    # O* = R^α (O − h) + h + t, α the turn of the vector from the right hand to the left (eq. 5.3–5.5, 5.7). h is the
    # right hand or the middle of both, t its translation; a single hand gives a translation only.
    alone = palms.shape[1] == 1
    point = palms[:, -1] if alone or anchor == "right" else palms.mean(1)
    angle = palms.new_zeros(len(palms)) if alone else _turned((palms[:, 0] - palms[:, -1])[None, :, :2])[0]
    R = rotation.about_axis("z", angle)
    start = state.T_world_object
    t = point + (R @ (start.t.to(palms) - point[0])[:, None])[..., 0]
    if kind == "plane":
        t[:, 2] = start.t[2].to(t)
    return Rigid(R @ start.R.to(palms), t), torch.zeros(len(palms), dtype=torch.float64)


def _turned(vectors: Float[Tensor, "hand time 2"]) -> Float[Tensor, "hand time"]:
    """Signed angle (rad) from the first vector to each one, unwrapped over time; short vectors keep the last angle.

    Before the first vector that is long enough the angle is 0.
    """
    long = vectors.norm(dim=-1) > _LEAST_APART_M
    first = long.long().argmax(-1, keepdim=True)
    frame = torch.where(long, torch.arange(vectors.shape[1]), first).cummax(-1).values
    kept = vectors.gather(1, frame[..., None].expand_as(vectors))
    before, after = kept[:, :-1], kept[:, 1:]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    step = torch.atan2(cross, (before * after).sum(-1))
    return torch.nn.functional.pad(step, (1, 0)).cumsum(-1)
