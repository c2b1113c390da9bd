"""Scans of a scene from PLY and PCD files, with checks of unit, extent and density."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from wearcap.errors import WearcapError
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.scene.scan import Scan

MAX_EXTENT_M = 5000.0
"""Largest extent (m) of a scene that a person walks through in one recording."""
MAX_HEIGHT_M = 500.0
DENSE_FROM = 1000
"""Number of points below which a cloud may be sparse without being in another unit."""
_CELL_M = 0.5
_MIN_PER_CELL = 1.5
"""Points per occupied half-metre cell below which a cloud is no dense scan (at 5 mm spacing a wall puts 10 000 there)."""


def read_scan(path: str | Path, *, needs_colors: bool = False, metres_per_unit: float | None = None) -> Scan:
    """Read a scene's cloud (world axes, z up) from a .ply or .pcd file.

    Its unit times `metres_per_unit` is m; None: it should be m, and is refused where it does not look so. Raises
    WearcapError for another kind of file, what `read_ply` and `read_pcd` refuse, no points, extent or density of a
    cloud that is not in metres, and, with `needs_colors`, a cloud without colour.
    """
    path = Path(path)
    reader = {".ply": read_ply, ".pcd": read_pcd}.get(path.suffix.lower())
    if reader is None:
        raise WearcapError("no scan of a kind that can be read", where=path, expected="a .ply or .pcd file")
    content = reader(path)
    points = content.points if metres_per_unit is None else content.points * np.float32(metres_per_unit)
    if not len(points):
        raise WearcapError("the scan has no points", where=path, expected="a cloud of the scene's surfaces")
    if metres_per_unit is None and (fault := unit_fault(points)):
        raise WearcapError(
            fault,
            where=path,
            expected="metres",
            fix="Give metres_per_unit=0.001 for a scan in millimetres, 1 for one that is sparse.",
        )
    if needs_colors and content.colors is None:
        raise WearcapError(
            "the scan has no colour",
            where=path,
            expected="red, green and blue of every point",
            fix="Export it with colours: pictures of the scene are drawn from them.",
        )
    return Scan(points, content.colors)


def unit_fault(points: Float32[np.ndarray, "point 3"]) -> str | None:
    """Reason why these points cannot be a scene in metres; None if they can.

    Millimetres show in the extent of whole scenes, and in the density of small ones: every point alone in its
    half-metre cell.
    """
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    extent = high - low
    size = " x ".join(f"{side:.4g}" for side in extent)
    if extent.max() > MAX_EXTENT_M or extent[2] > MAX_HEIGHT_M:
        return f"the scan measures {size} of its units: it looks like millimetres"
    if len(points) < DENSE_FROM:
        return None
    cells = np.floor((points - low) / _CELL_M).astype(np.int64)
    sides = cells.max(0) + 1
    per_cell = len(points) / len(np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]))
    if per_cell < _MIN_PER_CELL:
        return (
            f"the scan's {len(points)} points lie over {_CELL_M} of its units apart ({size} in all): "
            "it looks like millimetres"
        )
    return None
