"""A scanned scene: dense coloured points, and the surface they lie on."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, UInt8

from wearcap.geometry.surface import SurfaceIndex


@dataclass(frozen=True, eq=False)
class Scan:
    """A dense cloud of the scene's surfaces (world axes, m), coloured where the scanner had cameras."""

    points: Float32[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"] | None = None

    @cached_property
    def surface(self) -> SurfaceIndex:
        """For nearest points and local planes; built at first use (about 1 s per 5 M points)."""
        return SurfaceIndex.build(self.points)
