"""Triangle meshes as plain arrays."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32


@dataclass(frozen=True)
class Mesh:
    """Vertices (m), counter-clockwise faces seen from outside, and one RGB colour (0…1) or one per vertex."""

    vertices: Float32[np.ndarray, "vertex 3"]
    faces: Int32[np.ndarray, "face 3"]
    color: Float32[np.ndarray, "vertex 3"] | Float32[np.ndarray, "3"]
