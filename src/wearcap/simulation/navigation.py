"""Where a walker may stand, and ways between two places: a layered height grid and shortest paths over it.

Each storey is a layer of cells with the height of its floor. Neighbouring cells whose heights differ by no more
than a step are linked, within a layer and between layers, so stairs, ramps and kerbs need no special case.
"""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Bool, Float

STEP_M = 0.25
"""Neighbouring cells are linked up to this difference in height: a stair's rise fits, two do not."""
DROP_M = 0.45
"""A hole deeper than this, or the edge of the world, is kept off like a wall."""
HEADROOM_M = 1.9
CLEARANCE_M = 0.28
WAYPOINT_M = 0.1


@dataclass(frozen=True)
class NavigationGrid:
    """Cell (i, j) of a layer covers origin + cell · [(i, i + 1), (j, j + 1)]."""

    origin: Float[np.ndarray, "2"]
    cell: float
    height: Float[np.ndarray, "layer i j"]
    """Floor height at the cell's middle (m); NaN where the layer has none."""
    clearance: Float[np.ndarray, "layer i j"]
    """Distance to the nearest obstacle or drop (m)."""
    walkable: Bool[np.ndarray, "layer i j"]
    """Cells of the largest connected part in which a walker's middle may be."""
