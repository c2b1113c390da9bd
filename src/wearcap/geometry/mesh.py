"""Triangle meshes as plain arrays, and primitives for pictures and simulated rooms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int32

from wearcap.errors import WearcapError


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices (m), counter-clockwise faces seen from outside, and RGB colour (0…1): one, or per vertex or face."""

    vertices: Float32[np.ndarray, "vertex 3"]
    faces: Int32[np.ndarray, "face 3"]
    color: Float32[np.ndarray, "row 3"] | Float32[np.ndarray, "3"]
    """As many rows as vertices, else as faces."""
    smooth: bool = False
    """Shade with vertex normals (bodies) rather than each face's own (rooms)."""
    casts_shadow: bool = True

    def __post_init__(self):
        if self.color.ndim == 2 and len(self.color) not in (len(self.vertices), len(self.faces)):
            what = f"a mesh of {len(self.vertices)} vertices and {len(self.faces)} faces with {len(self.color)} colours"
            raise WearcapError(what, expected="one colour, or one per vertex or per face")

    @cached_property
    def color_rows(self) -> Int32[np.ndarray, "face 3"]:
        """Row of `color` (as a table) for each corner of each face."""
        if self.color.ndim == 1:
            return np.zeros_like(self.faces)
        if len(self.color) == len(self.vertices):
            return self.faces
        return np.repeat(np.arange(len(self.faces), dtype=np.int32)[:, None], 3, axis=1)

    @cached_property
    def vertex_normals(self) -> Float32[np.ndarray, "vertex 3"]:
        """Unit normals at the vertices: the mean of the faces', weighted by area (zero at loose vertices)."""
        face = face_normals(self.vertices[self.faces])
        total = np.stack(
            [np.bincount(self.faces.ravel(), np.repeat(face[:, axis], 3), len(self.vertices)) for axis in range(3)], -1
        )
        return (total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-20)).astype(np.float32)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several, coloured per vertex; all must agree in `smooth` and `casts_shadow` with the first."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    colors = []
    for mesh in meshes:
        if mesh.color.ndim == 2 and len(mesh.color) != len(mesh.vertices):
            raise WearcapError("meshes coloured per face cannot be merged", expected="one colour or one per vertex")
        colors.append(np.broadcast_to(mesh.color, mesh.vertices.shape))
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first)]).astype(np.int32),
        np.concatenate(colors),
        meshes[0].smooth,
        meshes[0].casts_shadow,
    )


def face_normals(corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 3"]:
    """Normals of triangles (counter-clockwise from outside), as long as twice their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def random_points(corners: Float[np.ndarray, "point 3 3"], rng: np.random.Generator) -> Float[np.ndarray, "point 3"]:
    """A point on each triangle, drawn evenly over its area, in the corners' precision."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v = rng.random((2, len(corners), 1)).astype(corners.dtype)
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a + u * (b - a) + v * (c - a)


def capsules(
    start: Float[np.ndarray, "solid 3"],
    end: Float[np.ndarray, "solid 3"],
    radius_start: Float[np.ndarray, "solid"],
    radius_end: Float[np.ndarray, "solid"],
    color: Float[np.ndarray, "solid 3"],
    segments: int = 16,
) -> Mesh:
    """Rounded sticks between points (m), tapering between their radii; a sphere where the points coincide."""
    axis = end - start
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = np.where(length > 1e-9, axis / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    frame = np.stack([side, np.cross(axis, side), axis], -1)
    rise = np.linspace(0, np.pi / 2, segments // 4 + 1)
    latitude = np.concatenate([rise - np.pi / 2, rise])[:, None]  # the equator twice: the stick between them
    turn = np.arange(segments) * 2 * np.pi / segments
    unit = np.stack([np.cos(latitude) * np.cos(turn), np.cos(latitude) * np.sin(turn), np.sin(latitude) + 0 * turn], -1)
    upper = (np.arange(len(latitude)) >= len(rise))[:, None, None]
    radius = np.where(upper, radius_end[:, None, None, None], radius_start[:, None, None, None])
    center = np.where(upper, end[:, None, None], start[:, None, None])
    points = center + radius * np.einsum("nij,lsj->nlsi", frame, unit)
    count, per_solid = len(start), len(latitude) * segments
    cell = np.arange((len(latitude) - 1) * segments)
    below, right = cell, cell - cell % segments + (cell + 1) % segments
    one = np.concatenate(
        [np.stack([below, right, right + segments], -1), np.stack([below, right + segments, below + segments], -1)]
    )
    faces = (one + per_solid * np.arange(count)[:, None, None]).reshape(-1, 3)
    return Mesh(
        points.reshape(-1, 3).astype(np.float32),
        faces.astype(np.int32),
        np.repeat(color, per_solid, axis=0).astype(np.float32),
        smooth=True,
    )


def checker_floor(
    center: Float[np.ndarray, "3"],
    half_size: float,
    tile: float,
    colors: Float[np.ndarray, "2 3"],
    edge_color: Float[np.ndarray, "3"],
    cells: int = 1,
    height: Callable[[Float[np.ndarray, "point 2"]], Float[np.ndarray, "point"]] | None = None,
) -> Mesh:
    """A chequered square around a point (m), its tiles fixed in the world; it fades at the rim. It is horizontal, or of
    the `height` (m) at the corners of the `cells` x `cells` parts of each tile."""
    cell = tile / cells
    first = cells * np.floor((center[:2] - half_size) / tile).astype(int)
    count = cells * (int(2 * half_size / tile) + 2)
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count)))
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    nodes = np.stack([column, row], -1)[:, None] + corner
    xy = cell * (first + nodes)
    fade = np.clip(np.linalg.norm(xy - center[:2], axis=-1) / half_size, 0, 1)[..., None] ** 2
    odd = ((first + nodes[:, 0]) // cells).sum(-1) % 2
    color = colors[odd][:, None] * (1 - fade) + edge_color * fade
    z = np.full(xy.shape[:2], center[2])
    if height is not None:
        grid = np.stack(np.meshgrid(*(cell * (start + np.arange(count + 1)) for start in first)), -1)
        z = height(grid.reshape(-1, 2)).reshape(count + 1, count + 1)[nodes[..., 1], nodes[..., 0]]
    vertices = np.concatenate([xy, z[..., None]], -1)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(xy))[:, None, None] + quad).reshape(-1, 3)
    return Mesh(
        vertices.reshape(-1, 3).astype(np.float32),
        faces.astype(np.int32),
        color.reshape(-1, 3).astype(np.float32),
        casts_shadow=False,
    )
