"""A box as a mesh, for tests that need something with sides."""

import numpy as np

from wearcap.geometry.mesh import Mesh

BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]], np.int32
)  # fmt: skip
"""Counter-clockwise from outside, of `box_corners`."""


def box_corners(low, high) -> np.ndarray:
    """Corners between two opposite ones (m), z running fastest."""
    return np.array(np.meshgrid(*zip(low, high), indexing="ij")).reshape(3, 8).T.astype(np.float32)


def box_mesh(low, high) -> Mesh:
    return Mesh(box_corners(low, high), BOX_FACES, np.ones(3, np.float32))
