"""Meshes of handled objects: centring in their own axes, and validation of meshes from files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.scene.objects import SceneObject

EXTENTS_M = (0.01, 5.0)
"""Longest side of the box around an object that a person handles (m)."""
MAX_OFF_CENTER = 1.0
"""How far the origin may lie from the box around the mesh, as a share of the box's longest side."""


def centered(mesh: Mesh) -> tuple[Mesh, Float64[np.ndarray, "3"]]:
    """The mesh with the mean of its vertices at the origin, and where that mean was in its former axes.

    Raises WearcapError for a mesh without vertices.
    """
    if not len(mesh.vertices):
        raise WearcapError("a mesh without vertices", expected="at least one triangle")
    center = mesh.vertices.astype(np.float64).mean(0)
    return replace(mesh, vertices=(mesh.vertices - center).astype(np.float32)), center


def check_object(item: SceneObject, where: str | Path) -> None:
    """`check_object_mesh` of an environment's object. Objects on a hinge or axis may be in the axes of their mount,
    with the origin anywhere."""
    check_object_mesh(item.mesh, where, item.freedom.kind not in ("hinge", "axis"))


def check_object_mesh(mesh: Mesh, where: str | Path, own_axes: bool = True) -> None:
    """Raise WearcapError unless a mesh can be an object's, in metres and in axes of its own.

    Refused, each with its own message: no vertices, coordinates that are NaN or infinite, no faces, faces of vertices
    that are not there, a longest side outside `EXTENTS_M` (millimetres), and an origin further from the box around the
    mesh than `MAX_OFF_CENTER` of its longest side (a mesh that was left in a scan's or a capture's axes).
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    if not len(vertices):
        raise WearcapError("the object's mesh has no vertices", where=where, expected="at least one triangle")
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        raise WearcapError(
            f"{int(bad.sum())} vertices of the object's mesh are NaN or infinite, the first is {int(bad.argmax())}",
            where=where,
            expected="finite coordinates (m)",
            fix="Export the mesh again.",
        )
    if not len(faces):
        raise WearcapError(
            "the object's mesh has no faces",
            where=where,
            expected="triangles, not a point cloud",
            fix="Export it as a triangle mesh.",
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise WearcapError(
            f"a face of the object's mesh names vertex {faces.max()}, there are {len(vertices)}",
            where=where,
            expected="faces of its own vertices",
        )
    low, high = vertices.min(0), vertices.max(0)
    _check_unit(float((high - low).max()), where)
    off = float(np.linalg.norm(np.maximum(np.maximum(low, -high), 0.0)))
    if own_axes and off > MAX_OFF_CENTER * (high - low).max():
        raise WearcapError(
            f"the object's mesh is not centred: its origin lies {off:.2f} m outside of the box around it",
            where=where,
            expected="axes of its own, with the origin in or near the object",
            fix="Subtract the mean of its vertices, and place its poses accordingly.",
        )


def _check_unit(extent: float, where: str | Path) -> None:
    least, greatest = EXTENTS_M
    if least <= extent <= greatest:
        return
    millimetres = extent > greatest and least <= extent / 1000 <= greatest
    guess = "It looks like millimetres: divide by 1000." if millimetres else "Bring it to metres."
    raise WearcapError(
        f"the object's mesh is {extent:.4g} m long", where=where, expected=f"{least:g} to {greatest:g} m", fix=guess
    )
