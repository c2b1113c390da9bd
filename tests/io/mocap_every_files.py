"""A capture folder as MocapEvery lays it out: a camera that is carried along a board's edges and then walks a circle."""

import pickle
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from test_watch_log import moved, sensor_log

from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.video import write_frames

SCALE = 2.5
"""Metres per unit of SLAM."""
SHUTTER_S = 1.7e9
BOARD_M = (0.4, 0.6)
HEIGHT_M = 0.8
FIX = Rotation.from_euler("xyz", [100.0, 20.0, -35.0], degrees=True)
"""R_slam_world: SLAM's axes are those of its first camera."""
SHIFT = np.array([0.3, -2.0, 1.0])


def truth(seconds: float = 8.0) -> tuple[np.ndarray, Rotation]:
    """Positions (m) and orientations (OpenCV camera) in the world: x, then y along the board, then a circle, level."""
    time = np.arange(int(seconds * 30)) / 30
    board = np.clip(time, 0, 1)[:, None] * [BOARD_M[0], 0, 0] + np.clip(time - 1.5, 0, 1)[:, None] * [0, BOARD_M[1], 0]
    angle = np.clip(time - 3.0, 0, None)
    circle = np.stack([np.sin(angle), 1 - np.cos(angle), 0.3 * np.sin(angle / 2)], 1)
    looking = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # ahead along x, upright
    position = board + circle - [BOARD_M[0], 0, 0] + [0, 0, HEIGHT_M]
    return position, Rotation.from_rotvec(angle[:, None] * [[0, 0, 1]]) * looking


def cloud() -> np.ndarray:
    """Points of a floor (m)."""
    return np.stack([*np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9)), np.zeros((9, 9))], -1).reshape(-1, 3)


def write_capture(folder: Path, *, leave_out: tuple[str, ...] = (), order: str = "xyzw", seconds: float = 8.0) -> None:
    """Write the folder but for the files named in `leave_out`."""
    (folder / "sfm" / "pointcloud").mkdir(parents=True, exist_ok=True)
    (folder / "video").mkdir(exist_ok=True)
    t, R = truth(seconds)
    poses = np.concatenate([FIX.apply(t - SHIFT) / SCALE, (FIX * R).as_quat()], 1)
    if order == "wxyz":
        poses[:, 3:] = (R[0].inv() * R).as_quat()[:, [3, 0, 1, 2]]
    (folder / "cam_traj.pkl").write_bytes(pickle.dumps(poses.astype(np.float32)))
    marks = {"shutter": SHUTTER_S, "clap": [SHUTTER_S + 3, SHUTTER_S + 4]}
    marks |= {"x": [SHUTTER_S, SHUTTER_S + 1.2], "y": [SHUTTER_S + 1.3, SHUTTER_S + 2.8]}
    (folder / "camera_calib.pkl").write_bytes(pickle.dumps(marks))
    (folder / "config.yaml").write_text(
        f"cam_scale_origin:\n  dist: [{BOARD_M[0]}, {BOARD_M[1]}]\n  height: {HEIGHT_M}\n"
    )
    write_ply(Ply((FIX.apply(cloud() - SHIFT) / SCALE).astype(np.float32)), folder / "sfm/pointcloud/pcd_results.ply")
    (folder / "sfm/undistort_calib.txt").write_text("300.5 301.0 291.0 162.0")
    (folder / "sfm/calib.txt").write_text("210.0 211.0 159.5 89.5 -0.1 0.02 0.001 0.002")
    write_frames(folder / "video/ego_video.MP4", np.zeros((12, 180, 320, 3), np.uint8), 30.0)
    for number in (1, 2):
        sensor_log(moved(), folder / f"watch_sensorlog_{number}.csv")
    for name in leave_out:
        (folder / name).unlink()


def world_of(points: np.ndarray) -> torch.Tensor:
    """World positions as the board alone can say them: from the floor under the start of y."""
    start = truth()[0][45] * [1, 1, 0]
    return torch.from_numpy(points - start).float()
