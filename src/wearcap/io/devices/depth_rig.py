"""A depth rig's folder: `photos.json` with one row per camera, whose `file` names the camera's folder.

`<camera>/empty/*.png` is the empty scene, `<camera>/depth/*.png` the recording: 16-bit millimetres (Kinect), in
the order of their names. `timestamps.txt` has the recording's times in seconds, one per line: all cameras are
triggered together.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt16
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.bounded import explained
from wearcap.io.formats.image_file import open_image
from wearcap.io.formats.photos import read_photos, write_photos
from wearcap.io.formats.poses import check_rising
from wearcap.io.formats.text import read_text
from wearcap.recording.photo import Photo

_FARTHEST_MM = 20_000
"""Largest depth (mm) of such a camera: images with larger values are not in millimetres."""


@dataclass(frozen=True)
class DepthCameraFiles:
    """One camera: calibration, approximate pose in the scene, and image files."""

    name: str
    camera: Camera
    T_world_cam: Rigid
    empty: tuple[Path, ...]
    depth: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class DepthRigFiles:
    """A recording of all cameras whose images are not read yet: a minute of three cameras is 4 GB."""

    cameras: tuple[DepthCameraFiles, ...]
    timestamps: Float64[np.ndarray, "time"]
    """Times (s) of each camera's `depth` images."""


def read_depth_rig(folder: str | Path) -> DepthRigFiles:
    """Find a rig's files. Raises WearcapError where a camera has no empty frames, or a different number of images than times."""
    folder = Path(folder)
    timestamps = _timestamps(folder / "timestamps.txt")
    cameras = []
    for row in read_photos(folder):
        with explained(row.file):
            empty, depth = (tuple(sorted((row.file / part).glob("*.png"))) for part in ("empty", "depth"))
        if not empty:
            raise WearcapError(
                "no images of the empty scene",
                where=row.file / "empty",
                expected="16-bit PNG files",
                fix="Record the scene without the person.",
            )
        if len(depth) != len(timestamps):
            raise WearcapError(
                f"{len(depth)} depth images for {len(timestamps)} times",
                where=row.file / "depth",
                expected="one per line of timestamps.txt, for every camera",
            )
        cameras.append(DepthCameraFiles(row.file.name, row.camera, row.T_world_cam, empty, depth))
    if not cameras:
        raise WearcapError("no cameras", where=folder / "photos.json", expected="a row for each depth camera")
    return DepthRigFiles(tuple(cameras), timestamps)


def read_depth(path: str | Path, camera: Camera) -> UInt16[np.ndarray, "height width"]:
    """A depth image (mm, 0: no return). Raises WearcapError for a damaged file, colours, 8 bits, another size than
    the calibration's, and values that cannot be millimetres."""
    with open_image(path) as image:
        mode, (width, height) = image.mode, image.size
        if (width, height) != (camera.width, camera.height):
            raise WearcapError(
                f"an image of {width}x{height} pixels",
                where=path,
                expected=f"{camera.width}x{camera.height}, as its camera is calibrated",
            )
        if mode not in ("I;16", "I;16B", "I"):
            raise WearcapError(
                f"not a depth image (mode {mode})", where=path, expected="one channel of 16 bits, millimetres"
            )
        depth = np.asarray(image).astype(np.int64)
    measured = depth[depth > 0]
    if len(measured) and not 100 < np.median(measured) < _FARTHEST_MM:
        raise WearcapError(
            f"its middle depth is {np.median(measured):.0f}", where=path, expected="millimetres, between 0.1 and 20 m"
        )
    return np.clip(depth, 0, 65535).astype(np.uint16)


def read_depths(paths: tuple[Path, ...], camera: Camera) -> UInt16[np.ndarray, "time height width"]:
    """Several images of one camera. Raises WearcapError as `read_depth` does."""
    images = [read_depth(path, camera) for path in paths]
    return np.stack(images) if images else np.zeros((0, camera.height, camera.width), np.uint16)


def write_depth(path: str | Path, depth_mm: UInt16[np.ndarray, "height width"]) -> None:
    """Write a 16-bit PNG of millimetres."""
    with atomic_path(path) as temporary:
        Image.fromarray(depth_mm).save(temporary, format="PNG")


def write_depth_rig(
    folder: str | Path,
    cameras: dict[str, tuple[Camera, Rigid]],
    empty_mm: dict[str, UInt16[np.ndarray, "still height width"]],
    depth_mm: dict[str, UInt16[np.ndarray, "time height width"]],
    timestamps: Float64[np.ndarray, "time"],
) -> None:
    """Write a rig's folder, as `read_depth_rig` reads it, from images by camera name."""
    folder = Path(folder)
    for name in cameras:
        for part, images in (("empty", empty_mm[name]), ("depth", depth_mm[name])):
            for number, image in enumerate(images):
                write_depth(folder / name / part / f"{number:06d}.png", image)
    write_photos([Photo(Path(name), camera, pose) for name, (camera, pose) in cameras.items()], folder)
    write_text(folder / "timestamps.txt", "".join(f"{time:.6f}\n" for time in timestamps))


def _timestamps(path: Path) -> Float64[np.ndarray, "time"]:
    try:
        times = np.array([float(line) for line in read_text(path).split()])
    except ValueError as error:
        raise WearcapError(f"a line is no number ({error})", where=path, expected="seconds, one per line") from error
    if not np.isfinite(times).all():
        raise WearcapError("a time is NaN or infinite", where=path, expected="seconds, one per line")
    check_rising(times, path)
    return times
