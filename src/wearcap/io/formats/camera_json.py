"""A camera's calibration as JSON: {"camera": {model, width, height, fx, fy, cx, cy, distortion}, "calibration": {…}}."""

import json
import math
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry.camera import Camera
from wearcap.io.formats.json_text import read_json

_NUMBERS = ("fx", "fy", "cx", "cy")
EXAMPLE = (
    '{"camera": {"model": "opencv", "width": …, "height": …, "fx": …, "fy": …, "cx": …, "cy": …, "distortion": […]}}'
)


def camera_row(camera: Camera) -> dict[str, Any]:
    """A camera as plain numbers."""
    names = ("model", "width", "height", *_NUMBERS)
    return {name: getattr(camera, name) for name in names} | {"distortion": list(camera.distortion)}


def camera_from_row(row: Any, where: str | Path) -> Camera:
    """Camera from the dict of `camera_row`. Raises WearcapError naming `where` when numbers are missing or invalid."""
    try:
        if not all(math.isfinite(float(value)) for value in (row["cx"], row["cy"], *row["distortion"])):
            raise ValueError("numbers that are not finite")
        return Camera(
            str(row["model"]),
            int(row["width"]),
            int(row["height"]),
            *(float(row[key]) for key in _NUMBERS),
            tuple(map(float, row["distortion"])),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise WearcapError(f"no intrinsics ({what})", where=where, expected=EXAMPLE) from error
    except WearcapError as error:
        raise WearcapError(error.what, where=where, expected=error.expected) from error


def write_camera(camera: Camera, path: str | Path, calibration: dict[str, Any] | None = None) -> None:
    """Write a camera and the metadata of its calibration (numbers, text, lists) atomically."""
    content = {"camera": camera_row(camera)} | ({"calibration": calibration} if calibration else {})
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_camera(path: str | Path) -> Camera:
    """Read what `write_camera` wrote. Raises WearcapError when it is missing, no JSON, or holds no intrinsics."""
    content = read_json(path)
    row = content.get("camera", content) if isinstance(content, dict) else None
    return camera_from_row(row, path)
