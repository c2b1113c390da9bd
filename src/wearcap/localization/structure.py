"""Structure from motion over an ordered row of pictures, through COLMAP (needs the extra: `pip install "wearcap[track]"`).

All results are in one folder: `database.db` (features and matches), `sparse/` (what was mapped) and, once
that is finished, `model/`. A run that was stopped goes on where it was.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.extras import required
from wearcap.geometry.camera import Camera

Advance = Callable[[str, int, int], None]
"""Progress callback: the step's name, the amount done, and the total."""
MODEL = "model"
_CHUNK = 8
_LENSES = {("pinhole", 0): "PINHOLE", ("opencv", 4): "OPENCV", ("fisheye", 4): "OPENCV_FISHEYE"}
"""COLMAP's camera model for each of ours, by the number of coefficients."""


@dataclass(frozen=True)
class MappingSettings:
    """Settings of matching and mapping."""

    overlap: int = 10
    """Number of following images that each image is matched with, besides some at growing distances."""
    max_keypoints: int = 4096
    max_size: int = 1600
    """Images with a longer side (px) are shrunk for feature extraction."""
    lens: str = "SIMPLE_RADIAL"
    """COLMAP's model where no camera is given and it calibrates itself; OPENCV_FISHEYE for very wide lenses."""
    threads: int = -1
    seed: int = 0


def map_pictures(
    names: Sequence[str], images: Path, folder: Path, camera: Camera | None, settings: MappingSettings, advance: Advance
) -> Path:
    """Map pictures `images`/NAME in their order; returns the folder of the largest model, which io/colmap reads.

    A given camera is kept as it is; otherwise one that all pictures share is calibrated meanwhile. Unit and axes are
    arbitrary. Raises WearcapError when the extra is missing, for a camera that COLMAP has no model of, and when no
    two pictures could be put together.
    """
    if (folder / MODEL / "images.bin").is_file():
        return folder / MODEL
    lens = None if camera is None else colmap_camera(camera)
    colmap = required("pycolmap", "structure from motion", "give a finished COLMAP model: from_model=DIR")
    colmap.logging.minloglevel = 2  # its errors come as exceptions, we report its progress
    folder.mkdir(parents=True, exist_ok=True)
    _extract(colmap, names, images, folder / "database.db", lens, settings, advance)
    advance("matching", 0, 1)
    # Each picture is matched with those that follow; pairs that are in the database are not matched again.
    pairing, matching = colmap.SequentialPairingOptions(), colmap.FeatureMatchingOptions()
    pairing.overlap, pairing.num_threads, matching.num_threads = settings.overlap, settings.threads, settings.threads
    _run_step(colmap.match_sequential, folder / "database.db", matching_options=matching, pairing_options=pairing)
    advance("matching", 1, 1)
    return _map(colmap, len(names), images, folder, lens is not None, settings, advance)


def colmap_camera(camera: Camera) -> tuple[str, str]:
    """COLMAP's name of a camera's model, and its parameters (pixel centres at .5) as COLMAP writes them."""
    name = _LENSES.get((camera.model, len(camera.distortion)))
    if name is None:
        what = f"COLMAP has no camera {camera.model!r} with {len(camera.distortion)} coefficients"
        fix = "Undistort the video, or leave the camera to be calibrated."
        raise WearcapError(what, expected="pinhole, opencv (4) or fisheye (4)", fix=fix)
    values = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *camera.distortion)
    return name, ",".join(f"{value:.12g}" for value in values)


def _extract(
    colmap: Any,
    names: Sequence[str],
    images: Path,
    database: Path,
    lens: tuple[str, str] | None,
    settings: MappingSettings,
    advance: Advance,
) -> None:
    """Extract the features of all images, a few at a time; existing ones stay, and all share the database's camera."""
    reader, options = colmap.ImageReaderOptions(), colmap.FeatureExtractionOptions()
    reader.camera_model, reader.camera_params = lens or (settings.lens, "")
    options.num_threads, options.max_image_size = settings.threads, settings.max_size
    options.sift.max_num_features = settings.max_keypoints
    for start in range(0, len(names), _CHUNK):
        advance("features", start, len(names))
        if database.is_file():
            with colmap.Database.open(database) as opened:
                cameras = opened.read_all_cameras()
            reader.existing_camera_id = cameras[0].camera_id if cameras else -1
        # The first picture brings the camera that the others share.
        first = _CHUNK if start or reader.existing_camera_id >= 0 else 1
        for part in (names[start : start + first], names[start + first : start + _CHUNK]):
            if part:
                _run_step(
                    colmap.extract_features,
                    database,
                    images,
                    image_names=list(part),
                    reader_options=reader,
                    camera_mode=colmap.CameraMode.SINGLE,
                    extraction_options=options,
                )
                with colmap.Database.open(database) as opened:
                    reader.existing_camera_id = opened.read_all_cameras()[0].camera_id
    advance("features", len(names), len(names))


def _map(
    colmap: Any, count: int, images: Path, folder: Path, calibrated: bool, settings: MappingSettings, advance: Advance
) -> Path:
    """Incremental mapping; the model with most images is moved into place when it is complete."""
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = settings.threads, settings.seed, 3
    if calibrated:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    done = 2

    def one_more() -> None:
        nonlocal done
        done += 1
        advance("mapping", min(done, count), count)

    advance("mapping", 0, count)
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    (folder / "sparse").mkdir()
    models = _run_step(
        colmap.incremental_mapping,
        folder / "database.db",
        images,
        folder / "sparse",
        options=options,
        next_image_callback=one_more,
    )
    advance("mapping", count, count)
    if not models:
        what = f"no two of {count} pictures could be put together"
        expected = "a textured, still scene, seen from places some way apart"
        fix = "Move the camera instead of turning it on the spot, or take more pictures a second (fps=…)."
        raise WearcapError(what, where=images, expected=expected, fix=fix)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    written = folder / "sparse" / "best"  # removed with the folder by the next run, if this one is killed
    written.mkdir()
    best.write(written)
    (folder / MODEL).mkdir(exist_ok=True)
    # images.bin marks a complete model, so it is moved last.
    for path in sorted(written.iterdir(), key=lambda path: path.name == "images.bin"):
        path.replace(folder / MODEL / path.name)
    return folder / MODEL


def _run_step(step: Callable, database: Path, *arguments: Any, **options: Any) -> Any:
    """Run a COLMAP step; its exceptions become WearcapErrors with a fix."""
    try:
        return step(database, *arguments, **options)
    except (RuntimeError, ValueError) as error:
        fix = "Remove the folder and run again."
        raise WearcapError(f"COLMAP stopped ({' '.join(str(error).split())})"[:300], where=database, fix=fix) from error
