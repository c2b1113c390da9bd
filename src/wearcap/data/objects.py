"""Objects as conditions of networks: point clouds of their surfaces, and the classes of the data sets' names."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError, nearest
from wearcap.geometry.mesh import Mesh

POINTS = 1500
"""Number of points of a cloud."""

_NAMES: dict[str, tuple[str, ...]] = {
    "backpack": (),
    "ball": ("basketball", "yogaball"),
    "bottle": (),
    "box": ("boxlarge", "boxlong", "boxmedium", "boxsmall", "boxtiny", "largebox", "plasticbox", "smallbox"),
    "cabinet_door": (),
    "chair": ("chairblack", "chairwood", "whitechair", "woodchair"),
    "clothesstand": (),
    "container": ("plasticcontainer",),
    "door": (),
    "drawer": (),
    "floorlamp": (),
    "keyboard": (),
    "monitor": (),
    "mop": (),
    "sofa": (),
    "stool": (),
    "suitcase": (),
    "table": ("largetable", "smalltable", "tablesmall", "tablesquare"),
    "tool": (),
    "toolbox": (),
    "trashcan": ("trashbin",),
    "tripod": (),
    "vacuum": (),
    "window": (),
    "yogamat": (),
}
"""All classes in alphabetical order, with BEHAVE's and OMOMO's other names for them."""

OBJECT_CLASSES: tuple[str, ...] = tuple(_NAMES)
"""A class's index is its position here."""

_CLASS_OF = {name: kind for kind, others in _NAMES.items() for name in (kind, *others)}


def object_class(name: str) -> str:
    """The class (of `OBJECT_CLASSES`) of an object by a data set's name, such as "largebox".

    Raises WearcapError, which lists the accepted names, for any other.
    """
    if name not in _CLASS_OF:
        near = nearest(name, _CLASS_OF)
        hint = near if near.startswith("Did you mean") else ""
        expected = f"one of {', '.join(sorted(_CLASS_OF))}"
        fix = f"{hint} A new name belongs into data/objects.py.".strip()
        raise WearcapError(f"no class for the object {name!r}", expected=expected, fix=fix)
    return _CLASS_OF[name]


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
