"""Objects as conditions of networks: point clouds of their surfaces."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh

POINTS = 1500
"""Number of points of a cloud."""


def object_cloud(mesh: Mesh, count: int = POINTS, seed: int = 0) -> Float[Tensor, "point 3"]:
    """`count` points (m) spread evenly by area over a surface, or sampled from the vertices if there are no faces.

    Deterministic for a seed. Raises WearcapError for a mesh without vertices, or with some that are not finite.
    """
    if not len(mesh.vertices) or not np.isfinite(mesh.vertices).all():
        what = f"a mesh of {len(mesh.vertices)} vertices, some perhaps NaN or infinite, has no cloud"
        raise WearcapError(what, expected="at least one vertex, all of them finite (m)")
    rng = np.random.default_rng(seed)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    if not area.sum() > 0:
        shuffled = rng.permutation(len(mesh.vertices))
        return torch.from_numpy(mesh.vertices[np.resize(shuffled, count)].astype(np.float32))
    # evenly along the faces' areas laid end to end: each face gets its share to within one point
    at = (np.arange(count) + rng.random(count)) / count * area.sum()
    face = np.minimum(np.searchsorted(area.cumsum(), at, side="right"), len(area) - 1)
    along, across = rng.random((2, count, 1))
    root = np.sqrt(along)
    points = (1 - root) * a[face] + root * (1 - across) * b[face] + root * across * c[face]
    return torch.from_numpy(points.astype(np.float32))
