"""Poses of cameras in JSON: transforms.json of NeRFs and Polycam, metadata.json of Record3D.

Both hold the camera in the world with OpenGL's axes (x right, y up, z backward); here they are turned to OpenCV's.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError

NAMES = ("transforms.json", "transforms_train.json", "metadata.json")
_OPENGL = np.diag([1.0, -1.0, -1.0])


def is_camera_frames(path: str | Path) -> bool:
    """Whether a JSON file is named like one of them and holds poses."""
    path = Path(path)
    if path.suffix != ".json" or not (path.name in NAMES or path.name.startswith("transforms")):
        return False
    content = read_json_object(path)
    return "frames" in content or "poses" in content


def read_camera_frames(path: str | Path) -> tuple[bool, Iterator[tuple[str, tuple[float, ...]]]]:
    """(whether it is Record3D's, whose unit is the metre; name and pose of the world in each camera, OpenCV's axes).

    A pose is qw qx qy qz tx ty tz; a name is the picture's, or the frame's time in seconds. Raises WearcapError for
    other content.
    """
    with understood("no poses of cameras", path, "frames of file_path and transform_matrix, or poses and fps"):
        content = read_json_object(path)
        record3d = "frames" not in content
        if record3d:
            table = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
            rate = float(content.get("fps", 60.0))
            if not rate > 0:
                raise ValueError(f"fps {rate}")
            times = content.get("frameTimestamps") or (np.arange(len(table)) / rate).tolist()
            names, t = [f"{float(time):.6f}" for time in times], table[:, 4:]
            R = Rotation.from_quat(table[:, :4]).as_matrix()
        else:
            frames = content["frames"]
            matrices = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64).reshape(-1, 4, 4)
            timed = all("timestamp" in frame for frame in frames)
            names = [f"{float(f['timestamp']):.9f}" if timed else str(f["file_path"]) for f in frames]
            R, t = matrices[:, :3, :3], matrices[:, :3, 3]
    if len(names) != len(t) or not np.isfinite(t).all():
        raise WearcapError(f"{len(names)} times of {len(t)} poses, or poses that are no numbers", path)
    if not np.allclose(R @ R.swapaxes(1, 2), np.eye(3), atol=0.02) or (np.linalg.det(R) < 0).any():
        raise WearcapError("a transform_matrix is no rotation and translation", path, "rigid poses of cameras")
    back = np.swapaxes(R @ _OPENGL, 1, 2)
    poses = np.concatenate(
        [Rotation.from_matrix(back).as_quat()[:, [3, 0, 1, 2]], -np.einsum("nij,nj->ni", back, t)], 1
    )
    return record3d, ((name, tuple(pose)) for name, pose in zip(names, poses.tolist()))
