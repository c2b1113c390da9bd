"""A scene's database pictures: `photos.json` beside the image files that it names."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.camera_json import camera_from_row, camera_row
from wearcap.io.formats.json_text import read_json
from wearcap.recording.photo import Photo

FILE_NAME = "photos.json"
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
    path = folder / FILE_NAME
    try:
        rows = read_json(path)["photos"]
        if not isinstance(rows, list):
            raise TypeError("its 'photos' are no list")
    except (KeyError, TypeError) as error:
        raise WearcapError(f"not a readable list of photos ({error})", where=path, expected=_EXAMPLE) from error
    return [_photo(row, folder, f"{path}, photo {number}") for number, row in enumerate(rows)]


def write_photos(photos: list[Photo], folder: str | Path) -> None:
    """Write `photos.json`. Raises WearcapError for an image file outside the folder."""
    folder = Path(folder)
    rows = []
    for photo in photos:
        file = Path(photo.file)
        if file.is_absolute() or file.is_relative_to(folder):
            if not file.is_relative_to(folder):
                raise WearcapError("this photo is outside its scene", where=file, expected=f"in {folder}")
            file = file.relative_to(folder)
        rows.append(
            {
                "file": file.as_posix(),
                "camera": camera_row(photo.camera),
                "R_world_cam": photo.T_world_cam.R.double().tolist(),
                "t_world_cam": photo.T_world_cam.t.double().tolist(),
            }
        )
    write_text(folder / FILE_NAME, json.dumps({"photos": rows}, indent=1) + "\n")


def _photo(row: Any, folder: Path, where: str) -> Photo:
    try:
        file, camera = Path(row["file"]), row["camera"]
        R, t = (np.array(row[key], np.float64) for key in ("R_world_cam", "t_world_cam"))
    except (ValueError, KeyError, TypeError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise WearcapError(f"unreadable ({what})", where=where, expected=_EXAMPLE) from error
    lens = camera_from_row(camera, where)
    if file.is_absolute() or ".." in file.parts:
        raise WearcapError(f"file {str(file)!r} is outside the scene's folder", where=where)
    if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise WearcapError(f"a pose of shapes {R.shape} and {t.shape}", where=where, expected="finite 3x3 and 3")
    if np.abs(R @ R.T - np.eye(3)).max() > _NOT_ORTHONORMAL or np.linalg.det(R) < 0:
        raise WearcapError("R_world_cam is no rotation", where=where, expected="an orthonormal 3x3 matrix")
    return Photo(folder / file, lens, Rigid(torch.from_numpy(R).float(), torch.from_numpy(t).float()))
