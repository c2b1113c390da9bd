"""Scans of NavVis' trolleys, as the HPS data set has them (unzipped): a cloud, photos of a fisheye rig and their calibration.

`info/00000-info.json` gives the pose of each camera of the rig in the scan's world, along OpenCV's axes of the picture as
stored (the trolley's cameras are mounted on their side: right in the picture may be down in the room).
"""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.formats.ocamcalib import read_sensor_frame
from wearcap.io.formats.poses import NORM_TOLERANCE
from wearcap.scene.scan import Photo

CLOUD, CALIBRATION = "pointcloud.ply", "sensor_frame.xml"
_PHOTO = re.compile(r"(\d+)-(cam\d+)\.jpe?g", re.IGNORECASE)


def is_navvis_scan(folder: str | Path) -> bool:
    """Whether a folder has the layout of a NavVis scan: a calibration and poses of pictures."""
    return (Path(folder) / CALIBRATION).is_file() and (Path(folder) / "info").is_dir()


def read_navvis_scan(folder: str | Path) -> tuple[Path, list[Photo]]:
    """(path of the cloud, photos in order of frame and camera); the cloud itself is read by `io.formats.scene_folder.read_scan`.

    Pictures whose frame was found invalid by the scanner are left out. Raises WearcapError for a missing cloud,
    calibration or picture folder, a picture without pose or calibration, and what those readers refuse.
    """
    folder = Path(folder)
    if folder.suffix == ".zip":
        raise WearcapError("a packed scan", folder, "its folder", "Unzip it first.")
    for part in (CLOUD, CALIBRATION, "cam", "info"):
        if not (folder / part).exists():
            raise WearcapError(f"no {part}", folder, f"a scan with {CLOUD}, {CALIBRATION}, cam/, info/")
    cameras = {
        name: model.camera(f"{folder / CALIBRATION}, camera {name!r}")
        for name, model in read_sensor_frame(folder / CALIBRATION).items()
    }
    named = [(match, path) for path in sorted((folder / "cam").iterdir()) if (match := _PHOTO.fullmatch(path.name))]
    if not named:
        raise WearcapError("no pictures", folder / "cam", "files such as 00000-cam0.jpg")
    photos, read_info = [], lru_cache(maxsize=1)(read_json)  # all pictures of a frame share a file
    for match, path in named:
        frame, name = match.groups()
        info_path = folder / "info" / f"{frame}-info.json"
        info = read_info(info_path)
        if not isinstance(info, dict) or name not in info:
            raise WearcapError(f"no pose of {name}", info_path, f"one for {path.name}")
        if name not in cameras:
            raise WearcapError(f"no intrinsics of {name}", folder / CALIBRATION, f"one for {path.name}")
        if str(info.get("valid", "true")).lower() == "false":
            continue
        quat_wxyz, position = read_pose(info[name], f"{info_path}, {name}")
        R = matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz))
        photos.append(Photo(path, cameras[name], Rigid(R.float(), torch.from_numpy(position).float())))
    return folder / CLOUD, photos


def read_pose(row: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(quaternion w x y z, position) of {"position": …, "quaternion": …}; anything else raises WearcapError."""
    with understood("no pose", where, '{"position": [x, y, z], "quaternion": [w, x, y, z]}'):
        quat_wxyz = np.asarray(row["quaternion"], np.float64).reshape(4)
        position = np.asarray(row["position"], np.float64).reshape(3)
    if not (np.abs(position) < 1e6).all() or not abs(np.linalg.norm(quat_wxyz) - 1) < NORM_TOLERANCE:
        what = f"position {position.tolist()}, quaternion {quat_wxyz.tolist()}"
        raise WearcapError(what, where, "metres, and a quaternion of length 1")
    return quat_wxyz, position
