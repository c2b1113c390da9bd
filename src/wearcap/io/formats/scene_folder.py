"""Scenes on disk in any supported layout: database photos, and the geometry that lifts their keypoints to 3D."""

from pathlib import Path

from wearcap.errors import WearcapError
from wearcap.io.datasets.hps_scene import is_hps_scene, read_hps_scene
from wearcap.io.formats.colmap import Tracks, read_colmap
from wearcap.io.formats.photos import FILE_NAME, read_photos
from wearcap.io.formats.scan import read_scan
from wearcap.recording.photo import Photo
from wearcap.scene.scan import Scan

CLOUD = "pointcloud.ply"


def read_scene(
    folder: str | Path, images: str | Path | None = None, metres_per_unit: float | None = None
) -> tuple[list[Photo], Scan | Tracks]:
    """Photos and geometry of a scene's folder: wearcap's own, a NavVis scan of the HPS data set, or a COLMAP model.

    `images`: folder of a COLMAP model's pictures, where it is not beside it. Raises WearcapError for a folder that is
    none of these, and what the readers refuse.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise WearcapError("no such folder", where=folder, expected="a scene's folder")
    if (folder / FILE_NAME).is_file():
        return read_photos(folder), read_scan(folder / CLOUD, metres_per_unit=metres_per_unit)
    if is_hps_scene(folder):
        cloud, photos = read_hps_scene(folder)
        return photos, read_scan(cloud, metres_per_unit=metres_per_unit)
    if any((folder / f"images.{ending}").is_file() for ending in ("bin", "txt")):
        model = read_colmap(folder, images)
        return model.photos, model.tracks
    raise WearcapError(
        "no scene of a known kind",
        where=folder,
        expected=f"{FILE_NAME} with {CLOUD}, a scan of the HPS data set, or a COLMAP model (cameras, images, points3D)",
    )


def cloud_file(scene: str | Path) -> Path:
    """The cloud of a scene: the file that was named, or the one in the folder. Raises WearcapError without one."""
    path = Path(scene) / CLOUD if Path(scene).is_dir() else Path(scene)
    if not path.is_file():
        raise WearcapError(
            "no scan of a scene here", where=scene, expected=f"a folder with {CLOUD}, or a .ply or .pcd file"
        )
    return path
