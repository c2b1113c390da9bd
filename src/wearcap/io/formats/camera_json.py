"""Cameras as JSON: a calibration, and a scene's database pictures, whose `photos.json` is beside the files that it names.

{"camera": {model, width, height, fx, fy, cx, cy, distortion}, "calibration": {…}}
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wearcap.boundary.opening import path_inside, placed, understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.poses import are_rotations
from wearcap.scene.scan import Photo

_NUMBERS = ("fx", "fy", "cx", "cy")
EXAMPLE = (
    '{"camera": {"model": "opencv", "width": …, "height": …, "fx": …, "fy": …, "cx": …, "cy": …, "distortion": […]}}'
)


def camera_row(camera: Camera) -> dict[str, Any]:
    """A camera as plain numbers."""
    names = ("model", "width", "height", *_NUMBERS)
    return {name: getattr(camera, name) for name in names} | {"distortion": list(camera.distortion)}


def _camera_from_row(row: Any, where: str | Path) -> Camera:
    """Camera from the dict of `camera_row`. Raises WearcapError naming `where` when numbers are missing or invalid."""
    with understood("no intrinsics", where, EXAMPLE), placed(where):
        if not all(math.isfinite(float(value)) for value in (row["cx"], row["cy"], *row["distortion"])):
            raise ValueError("numbers that are not finite")
        return Camera(
            str(row["model"]),
            int(row["width"]),
            int(row["height"]),
            *(float(row[key]) for key in _NUMBERS),
            tuple(map(float, row["distortion"])),
        )


def write_camera(camera: Camera, path: str | Path, calibration: dict[str, Any] | None = None) -> None:
    """Write a camera and the metadata of its calibration (numbers, text, lists) atomically."""
    content = {"camera": camera_row(camera)} | ({"calibration": calibration} if calibration else {})
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_camera(path: str | Path) -> Camera:
    """Read what `write_camera` wrote. Raises WearcapError when it is missing, no JSON, or holds no intrinsics."""
    content = read_json(path)
    row = content.get("camera", content) if isinstance(content, dict) else None
    return _camera_from_row(row, path)


PHOTOS_FILE = "photos.json"
_NOT_ORTHONORMAL = 1e-3
_EXAMPLE = (
    '{"photos": [{"file": "photos/00000-cam0.jpg", "camera": {"model": "fisheye", "width": …, "height": …, '
    '"fx": …, "fy": …, "cx": …, "cy": …, "distortion": […]}, "R_world_cam": 3x3, "t_world_cam": [x, y, z]}]}'
)


def read_photos(folder: str | Path) -> list[Photo]:
    """Photos of a scene's folder, with files as paths; whether these exist is checked when they are opened.

    Raises WearcapError when `photos.json` is missing or not as `write_photos` writes it, naming the photo.
    """
    folder = Path(folder)
    path = folder / PHOTOS_FILE
    with understood("not a readable list of photos", path, _EXAMPLE, errors=(KeyError, TypeError)):
        rows = read_json(path)["photos"]
        if not isinstance(rows, list):
            raise TypeError("its 'photos' are no list")
    return [_photo(row, folder, f"{path}, photo {number}") for number, row in enumerate(rows)]


def write_photos(photos: list[Photo], folder: str | Path) -> None:
    """Write `photos.json`. Raises WearcapError for an image file outside the folder."""
    folder = Path(folder)
    rows = []
    for photo in photos:
        file = Path(photo.file)
        if file.is_absolute() or file.is_relative_to(folder):
            if not file.is_relative_to(folder):
                raise WearcapError("this photo is outside its scene", file, f"in {folder}")
            file = file.relative_to(folder)
        rows.append(
            {
                "file": file.as_posix(),
                "camera": camera_row(photo.camera),
                "R_world_cam": photo.T_world_cam.R.double().tolist(),
                "t_world_cam": photo.T_world_cam.t.double().tolist(),
            }
        )
    write_text(folder / PHOTOS_FILE, json.dumps({"photos": rows}, indent=1) + "\n")


def _photo(row: Any, folder: Path, where: str) -> Photo:
    with understood("unreadable", where, _EXAMPLE):
        file, camera = row["file"], row["camera"]
        R, t = (np.array(row[key], np.float64) for key in ("R_world_cam", "t_world_cam"))
    lens = _camera_from_row(camera, where)
    if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise WearcapError(f"a pose of shapes {R.shape} and {t.shape}", where, "finite 3x3 and 3")
    if not are_rotations(torch.from_numpy(R), _NOT_ORTHONORMAL):
        raise WearcapError("R_world_cam is no rotation", where, "an orthonormal 3x3 matrix")
    return Photo(
        path_inside(folder, file, where), lens, Rigid(torch.from_numpy(R).float(), torch.from_numpy(t).float())
    )
