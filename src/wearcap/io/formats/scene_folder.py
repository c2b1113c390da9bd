"""Scenes on disk in any supported layout: database photos, the geometry that lifts their keypoints to 3D, and scans.

Scans are PLY and PCD files, whose unit, extent and density are checked.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from wearcap.boundary.opening import path_inside, understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.camera_json import PHOTOS_FILE, read_photos
from wearcap.io.formats.colmap import Tracks, read_colmap
from wearcap.io.formats.glb import read_glb
from wearcap.io.formats.navvis import is_navvis_scan, read_navvis_scan
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.wavefront import read_obj
from wearcap.scene.scan import Photo, Scan

SURFACES: dict[str, Callable[[Path], Mesh]] = {
    ".ply": lambda path: read_ply(path).mesh,
    ".obj": read_obj,
    ".glb": read_glb,
}
"""What reads a scene's surface as it is shown, by the ending of the file's name; a cloud has no faces."""
MAX_EXTENT_M = 5000.0
"""Largest extent (m) of a scene that a person walks through in one recording."""
MAX_HEIGHT_M = 500.0
DENSE_FROM = 1000
"""Number of points below which a cloud may be sparse without being in another unit."""
_CELL_M = 0.5
_MIN_PER_CELL = 1.5
"""Points per occupied half-metre cell below which a cloud is no dense scan (at 5 mm spacing a wall puts 10 000 there)."""


def read_scan(path: str | Path, *, metres_per_unit: float | None = None) -> Scan:
    """Read a scene's cloud (world axes, z up) from a .ply or .pcd file.

    Its unit times `metres_per_unit` is m; None: it should be m, and is refused where it does not look so. Raises
    WearcapError for another kind of file, what `read_ply` and `read_pcd` refuse, no points, and extent or density of a
    cloud that is not in metres.
    """
    path = Path(path)
    reader = {".ply": read_ply, ".pcd": read_pcd}.get(path.suffix.lower())
    if reader is None:
        raise WearcapError("no scan of a kind that can be read", path, "a .ply or .pcd file")
    content = reader(path)
    points = content.points if metres_per_unit is None else content.points * np.float32(metres_per_unit)
    if not len(points):
        raise WearcapError("the scan has no points", path, "a cloud of the scene's surfaces")
    if metres_per_unit is None:
        # Millimetres show in the extent of whole scenes, and in the density of small ones: every point alone in its
        # half-metre cell.
        low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
        extent, fault = high - low, None
        size = " x ".join(f"{side:.4g}" for side in extent)
        if extent.max() > MAX_EXTENT_M or extent[2] > MAX_HEIGHT_M:
            fault = f"the scan measures {size} of its units"
        elif len(points) >= DENSE_FROM:
            cells = np.floor((points - low) / _CELL_M).astype(np.int64)
            sides = cells.max(0) + 1
            per_cell = len(points) / len(np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]))
            if per_cell < _MIN_PER_CELL:
                fault = f"the scan's {len(points)} points lie over {_CELL_M} of its units apart ({size} in all)"
        if fault is not None:
            fix = "Give metres_per_unit=0.001 for a scan in millimetres, 1 for one that is sparse."
            raise WearcapError(f"{fault}: it looks like millimetres", path, "metres", fix)
    return Scan(points, content.colors)


CLOUD, MAP_NAME = "pointcloud.ply", "map.safetensors"
"""Files of a scene's folder: its scan, and the visual map beside it."""
_SCANS = (".ply", ".pcd", ".glb")


def read_scene(
    folder: str | Path, images: str | Path | None = None, metres_per_unit: float | None = None
) -> tuple[list[Photo], Scan | Tracks]:
    """Photos and geometry of a scene's folder: wearcap's own, a NavVis scan of the HPS data set, or a COLMAP model.

    `images`: folder of a COLMAP model's pictures, where it is not beside it. Raises WearcapError for a folder that is
    none of these, and what the readers refuse.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise WearcapError("no such folder", folder, "a scene's folder")
    if (folder / PHOTOS_FILE).is_file():
        return read_photos(folder), read_scan(folder / CLOUD, metres_per_unit=metres_per_unit)
    if is_navvis_scan(folder):
        cloud, photos = read_navvis_scan(folder)
        return photos, read_scan(cloud, metres_per_unit=metres_per_unit)
    if any((folder / f"images.{ending}").is_file() for ending in ("bin", "txt")):
        model = read_colmap(folder, images)
        return model.photos, model.tracks
    expected = f"{PHOTOS_FILE} with {CLOUD}, a scan of the HPS data set, or a COLMAP model (cameras, images, points3D)"
    raise WearcapError("no scene of a known kind", folder, expected)


def cloud_file(scene: str | Path) -> Path:
    """The cloud of a scene: the file that was named, or the one in the folder. Raises WearcapError without one."""
    path = Path(scene) / CLOUD if Path(scene).is_dir() else Path(scene)
    if not path.is_file():
        raise WearcapError("no scan of a scene here", scene, f"a folder with {CLOUD}, or a .ply or .pcd file")
    return path


def used_files(file: Path) -> list[Path]:
    """A file that a recording names and those that are read with it: a scan's map, and the meshes of an environment."""
    beside = [file.parent / MAP_NAME] if file.suffix.lower() in _SCANS else []
    if file.suffix.lower() == ".json":
        with suppress(WearcapError), understood("not an environment", file):  # what reads it says what is wrong
            beside = [path_inside(file.parent, row["mesh"], file) for row in read_json(file)["objects"]]
    return [file, *(path for path in dict.fromkeys(beside) if path.is_file())]
