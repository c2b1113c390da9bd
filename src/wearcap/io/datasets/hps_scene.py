"""A scan of the HPS data set (unzipped): cloud, database photos of a fisheye rig, their calibration.

`info/00000-info.json` gives the pose of each camera of the rig in the scan's world, along OpenCV's axes of the picture
as stored (the trolley's cameras are mounted on their side: right in the picture may be down in the room).
"""

import re
from pathlib import Path

import torch

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.io.datasets.hps import read_hps_pose
from wearcap.io.formats.json_text import read_json
from wearcap.io.formats.ocamcalib import read_sensor_frame
from wearcap.recording.photo import Photo

CLOUD, CALIBRATION = "pointcloud.ply", "sensor_frame.xml"
_PHOTO = re.compile(r"(\d+)-(cam\d+)\.jpe?g", re.IGNORECASE)


def is_hps_scene(folder: str | Path) -> bool:
    """Whether a folder has the layout of a NavVis scan: a calibration and poses of pictures."""
    return (Path(folder) / CALIBRATION).is_file() and (Path(folder) / "info").is_dir()


def read_hps_scene(folder: str | Path) -> tuple[Path, list[Photo]]:
    """(path of the cloud, photos in order of frame and camera); the cloud itself is read by `io.formats.scan.read_scan`.

    Pictures whose frame was found invalid by the scanner are left out. Raises WearcapError for a missing cloud,
    calibration or picture folder, a picture without pose or calibration, and what those readers refuse.
    """
    folder = Path(folder)
    if folder.suffix == ".zip":
        raise WearcapError("a packed scan", where=folder, expected="its folder", fix="Unzip it first.")
    for part in (CLOUD, CALIBRATION, "cam", "info"):
        if not (folder / part).exists():
            raise WearcapError(f"no {part}", where=folder, expected=f"a scan with {CLOUD}, {CALIBRATION}, cam/, info/")
    cameras = {
        name: model.camera(f"{folder / CALIBRATION}, camera {name!r}")
        for name, model in read_sensor_frame(folder / CALIBRATION).items()
    }
    named = [(match, path) for path in sorted((folder / "cam").iterdir()) if (match := _PHOTO.fullmatch(path.name))]
    if not named:
        raise WearcapError("no pictures", where=folder / "cam", expected="files such as 00000-cam0.jpg")
    photos, info, info_path = [], {}, None
    for match, path in named:
        frame, name = match.groups()
        if info_path != folder / "info" / f"{frame}-info.json":
            info_path = folder / "info" / f"{frame}-info.json"
            info = read_json(info_path)
        if not isinstance(info, dict) or name not in info:
            raise WearcapError(f"no pose of {name}", where=info_path, expected=f"one for {path.name}")
        if name not in cameras:
            raise WearcapError(f"no intrinsics of {name}", where=folder / CALIBRATION, expected=f"one for {path.name}")
        if str(info.get("valid", "true")).lower() == "false":
            continue
        quat_wxyz, position = read_hps_pose(info[name], f"{info_path}, {name}")
        R = matrix_from_quat_wxyz(torch.from_numpy(quat_wxyz))
        photos.append(Photo(path, cameras[name], Rigid(R.float(), torch.from_numpy(position).float())))
    return folder / CLOUD, photos
