"""Checks of a scene's folder: its scan (unit, colour, density, up axis), the database photos, and the map."""

from pathlib import Path

import numpy as np
import safetensors
import torch
from jaxtyping import Float32

from wearcap.doctor.report import Finding, refusal
from wearcap.errors import WearcapError
from wearcap.io.datasets.hps import CLOUD, is_hps_scene, read_hps_scene
from wearcap.io.formats.camera_json import PHOTOS_FILE, read_photos
from wearcap.io.formats.scene_folder import read_scan
from wearcap.io.formats.video import open_image
from wearcap.localization.visual_map import VisualMap
from wearcap.recording import PointCloud, Recording
from wearcap.recording.photo import Photo
from wearcap.scene.scan import Scan

SPARSE_M = 0.03
"""Spacing (m) beyond which pictures rendered from a scan have holes at arm's length."""
_CELL_M = 0.1
_FEW_KEYPOINTS = 30
_LOOKED_AT = 40
"""Most photos whose files are opened."""
_MARGIN_M = 1.0
"""Largest distance (m) of photos from the scan's bounding box."""
_POINTS = 50_000
"""Number of points of the scan that are projected into photos."""

NO_PHOTOS = Finding(
    "error",
    "photos",
    "no photos",
    "a map of this scene would be empty",
    "List pictures with their cameras and poses in photos.json.",
)


def is_scene(folder: Path) -> bool:
    """Whether a folder holds a scan with photos: wearcap's (photos.json) or NavVis' (sensor_frame.xml)."""
    return (folder / PHOTOS_FILE).is_file() or (folder / CLOUD).is_file() or is_hps_scene(folder)


def _is_navvis(folder: Path) -> bool:
    return is_hps_scene(folder) and not (folder / PHOTOS_FILE).is_file()


def read_scene(folder: Path) -> tuple[Recording, list[Finding]]:
    """The scan as points, with all findings about scan and photos, including errors of reading them."""
    findings: list[Finding] = []
    scan, photos = None, None
    try:
        scan = read_scan(folder / CLOUD)
        findings += check_scan(scan)
    except WearcapError as error:
        missing = Finding(
            "error", "scan", "the scan is missing", str(folder / CLOUD), "Export the scene's cloud there."
        )
        findings.append(refusal(error, "scan") if (folder / CLOUD).is_file() else missing)
    try:
        photos = read_hps_scene(folder)[1] if _is_navvis(folder) else read_photos(folder)
        findings += check_photos(photos, scan)
    except WearcapError as error:
        listed = (folder / PHOTOS_FILE).is_file() or _is_navvis(folder)
        findings.append(refusal(error, "photos") if listed else NO_PHOTOS)
    shown = torch.zeros(0, 3) if scan is None else torch.from_numpy(_thinned(scan.points))
    return Recording(folder.resolve().name, points=PointCloud(shown) if len(shown) else None), findings


def is_map(path: Path) -> bool:
    """Whether a .safetensors file is marked as a visual map."""
    try:
        with safetensors.safe_open(str(path), framework="numpy") as file:
            return "wearcap_map" in (file.metadata() or {})
    except (safetensors.SafetensorError, OSError, RuntimeError):
        return False


def read_map(path: Path) -> tuple[Recording, list[Finding]]:
    """A visual map's landmarks, with findings about whether cameras can be localised in it."""
    visual_map = VisualMap.load(path)
    points, pictures = visual_map.landmarks.points_world, len(visual_map)
    if not len(points) or not pictures:
        return Recording(path.name), [
            Finding(
                "error",
                "map",
                "the map is empty",
                f"{pictures} pictures, {len(points)} landmarks",
                "Build it from photos that show the scene: wearcap scene.",
            )
        ]
    seen = np.diff(visual_map.first)
    evidence = (
        f"{pictures} pictures, {len(points)} landmarks, {np.median(seen):.0f} keypoints in half of the pictures or more"
    )
    bare = float((seen < _FEW_KEYPOINTS).mean())
    found = Finding("ok", "map", "holds landmarks", evidence)
    if bare > 0.3:
        found = Finding(
            "warning",
            "map",
            "pictures with hardly a keypoint",
            f"{100 * bare:.0f} % of them; {evidence}",
            "Pictures of bare walls help nobody: take others, or larger ones.",
        )
    return Recording(path.name, points=PointCloud(torch.from_numpy(_thinned(points.astype(np.float32))))), [found]


def check_scan(scan: Scan) -> list[Finding]:
    """Extent, colour, density and up axis of a scan that is in metres."""
    extent = np.ptp(scan.points, axis=0)
    size = " x ".join(f"{side:.1f}" for side in extent)
    findings = [Finding("ok", "scan", "in metres", f"{len(scan.points)} points, {size} m")]
    if scan.colors is None:
        findings.append(
            Finding(
                "error",
                "scan: colour",
                "the scan has no colour",
                f"{len(scan.points)} points",
                "Export it with red, green, blue: pictures are drawn from it.",
            )
        )
    elif scan.colors.std() < 1:
        findings.append(
            Finding(
                "error",
                "scan: colour",
                "all points have one colour",
                f"{scan.colors[0].tolist()}",
                "Export it with the scanner's colours: nothing can be recognised in it.",
            )
        )
    spacing = _spacing_m(scan.points)
    evidence = f"points about {100 * spacing:.1f} cm apart"
    if spacing > SPARSE_M:
        findings.append(
            Finding(
                "warning",
                "scan: density",
                "the scan is sparse",
                evidence,
                "Pictures drawn from it have holes: export it at 1 cm or less.",
            )
        )
    else:
        findings.append(Finding("ok", "scan: density", "dense", evidence))
    if extent[2] > 1.5 * extent[:2].max():
        findings.append(
            Finding(
                "warning",
                "scan: up axis",
                "the scan is taller than wide",
                f"{size} m",
                "z should point up: turn the scan and its photos' poses together.",
            )
        )
    return findings


def check_photos(photos: list[Photo], scan: Scan | None) -> list[Finding]:
    """Photos exist, have their calibration's size, and see the scan."""
    if not photos:
        return [
            Finding("error", "photos", "no photos", "a map of this scene would be empty", "List them in photos.json.")
        ]
    missing = [photo.file.name for photo in photos if not photo.file.is_file()]
    if missing:
        return [
            Finding(
                "error",
                "photos",
                "image files are missing",
                f"{len(missing)} of {len(photos)}, as {missing[:3]}",
                "Put them at the paths in photos.json.",
            )
        ]
    cameras = len({photo.camera for photo in photos})
    findings = [Finding("ok", "photos", f"{len(photos)} photos", f"{cameras} calibrations")]
    findings += _sizes(photos[:: -(-len(photos) // _LOOKED_AT)])
    return findings if scan is None else [*findings, _sight(photos[:: -(-len(photos) // _LOOKED_AT)], scan)]


def _sizes(photos: list[Photo]) -> list[Finding]:
    for photo in photos:
        try:
            with open_image(photo.file) as image:
                size = image.size
        except WearcapError as error:
            return [
                Finding(
                    "error",
                    "photos: files",
                    "a photo cannot be read",
                    f"{photo.file.name}: {error.what}",
                    "Fetch it again.",
                )
            ]
        if size != (photo.camera.width, photo.camera.height):
            return [
                Finding(
                    "error",
                    "photos: size",
                    "image size and calibration differ",
                    f"{photo.file.name} has {size[0]}x{size[1]} pixels, its camera {photo.camera.width}x{photo.camera.height}",
                    "Use the pictures that were calibrated, or scale the intrinsics (Camera.scaled).",
                )
            ]
    return [Finding("ok", "photos: size", "as calibrated", f"{len(photos)} opened")]


def _sight(photos: list[Photo], scan: Scan) -> Finding:
    """Whether photos were taken within the scan, and have points of it within 10 m in view."""
    points = torch.from_numpy(_thinned(scan.points))
    low, high = points.amin(0) - _MARGIN_M, points.amax(0) + _MARGIN_M
    shares = torch.zeros(len(photos))
    for k, photo in enumerate(photos):
        if not ((photo.T_world_cam.t >= low) & (photo.T_world_cam.t <= high)).all():
            continue
        near = points[(points - photo.T_world_cam.t).norm(dim=-1) < 10.0]
        if len(near) > 20:
            shares[k] = photo.camera.project(photo.T_world_cam.inverse() @ near)[1].float().mean()
    blind = int((shares < 0.01).sum())
    evidence = (
        f"half of {len(photos)} photos have at least {100 * shares.median():.0f} % of the points within 10 m in view"
    )
    if blind > len(photos) / 2:
        return Finding(
            "error",
            "photos: poses",
            "photos do not see the scan",
            f"{blind} of {len(photos)} were taken outside it, or have none of it in view",
            "Poses are of OpenCV's camera in the scan's world, in metres; perhaps they are inverted.",
        )
    if blind > len(photos) / 10:
        return Finding(
            "warning",
            "photos: poses",
            "some photos do not see the scan",
            f"{blind} of {len(photos)}",
            "They add nothing to a map.",
        )
    return Finding("ok", "photos: poses", "photos see the scan", evidence)


def _thinned(points: Float32[np.ndarray, "point 3"]) -> Float32[np.ndarray, "chosen 3"]:
    return np.ascontiguousarray(points[:: len(points) // _POINTS + 1])


def _spacing_m(points: Float32[np.ndarray, "point 3"]) -> float:
    """Distance (m) of neighbouring points on a surface, from the points per occupied cell."""
    cells = np.floor((points - points.min(0)) / _CELL_M).astype(np.int64)
    sides = cells.max(0) + 1
    _, counts = np.unique((cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2], return_counts=True)
    return float(_CELL_M / np.sqrt(np.median(counts)))
