"""DROID-SLAM's reconstruction folder: keyframes' poses, and points from their disparities.

`poses.npy` (N, 7) holds tx ty tz qx qy qz qw of the world in the camera's axes (OpenCV), `tstamps.npy` (N) the numbers
of SLAM's input frames, `disps.npy` (N, H, W) inverse depths, `intrinsics.npy` (N, 4) fx fy cx cy at an eighth
of the pictures' size. Unit and axes of the world are SLAM's own: neither metres nor gravity.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.npz import map_npy, require
from wearcap.io.formats.poses import check_finite, check_rising, checked_trajectory
from wearcap.recording import PointCloud

REDUCED = 8
"""Factor by which SLAM's internal pictures are smaller; its intrinsics refer to them."""


@dataclass(frozen=True)
class DroidPoints:
    """Selection of the keyframes' pixels that become points; our values, modelled on DROID-SLAM's own viewer."""

    stride: int = 4
    """Stride (pixels) along rows and columns."""
    neighbors: int = 3
    """Number of keyframes on either side that a point is compared with."""
    agreement: float = 0.05
    """Largest relative difference of depth at which a neighbour agrees."""
    min_agreeing: int = 2
    min_disparity: float = 0.25
    """Smallest disparity, as a share of the mean: far points are noise."""


@dataclass(frozen=True)
class DroidTrack:
    """Keyframes of a reconstruction in SLAM's own world."""

    T_world_cam: Trajectory
    camera: Camera
    """Pinhole camera of SLAM's input pictures, at the size of the disparities."""
    points: PointCloud | None
    """Points; `confidence` is the share of neighbours that agree, `first_seen` the time of a point's own keyframe."""


def read_droid(folder: str | Path, stamps_per_s: float, points: DroidPoints | None = DroidPoints()) -> DroidTrack:
    """Read a reconstruction; `stamps_per_s` is the rate of SLAM's input frames (a 30 Hz video at stride 3: 10).

    Without `points`, only the size of the disparities is read. Raises WearcapError for missing files, arrays of objects, wrong
    shapes, NaN, stamps that do not rise, quaternions far from unit norm, and intrinsics of no such picture.
    """
    folder = Path(folder)
    if not (np.isfinite(stamps_per_s) and stamps_per_s > 0):
        raise WearcapError(f"{stamps_per_s} stamps per second", where=folder, expected="a positive number")
    arrays = {name: _load(folder / f"{name}.npy") for name in ("poses", "tstamps", "intrinsics")}
    arrays = {name: np.array(array) for name, array in arrays.items()}
    if arrays["poses"].shape[:1] == (0,):
        raise WearcapError("no keyframes", where=folder / "poses.npy")
    require(arrays, folder, poses=("keyframe", 7), tstamps=("keyframe",), intrinsics=("keyframe", 4))
    track = _trajectory(arrays["poses"], arrays["tstamps"] / stamps_per_s, folder)
    disparity = _load(folder / "disps.npy")
    if disparity.ndim != 3 or len(disparity) != len(track) or disparity.dtype.kind != "f":
        raise WearcapError(
            f"{disparity.dtype} of shape {disparity.shape}",
            where=folder / "disps.npy",
            expected=f"floats of shape ({len(track)}, height, width)",
        )
    camera = _camera(arrays["intrinsics"], disparity.shape[2], disparity.shape[1], folder)
    cloud = None if points is None else _points(track, disparity, camera, points, folder)
    return DroidTrack(track, camera, cloud)


def _load(path: Path) -> np.ndarray:
    """A memory-mapped .npy file, whose size is checked before memory is allocated."""
    if not path.exists():
        raise WearcapError(
            "no such file",
            where=path,
            expected="a reconstruction of DROID-SLAM",
            fix="Run it with --reconstruction_path.",
        )
    return map_npy(path)


def _trajectory(poses: np.ndarray, seconds: np.ndarray, folder: Path) -> Trajectory:
    path = folder / "poses.npy"
    check_rising(seconds, folder / "tstamps.npy")
    T_cam_world = checked_trajectory(seconds, poses[:, :3], poses[:, [6, 3, 4, 5]], path)
    T_world_cam = T_cam_world.T_world_body.inverse()
    return Trajectory(T_cam_world.timestamps, T_world_cam.R, T_world_cam.t)


def _camera(intrinsics: np.ndarray, width: int, height: int, folder: Path) -> Camera:
    """Intrinsics at the disparities' size, which is the pictures' own or, without upsampling, an eighth of it."""
    path = folder / "intrinsics.npy"
    fx, fy, cx, cy = np.median(intrinsics, axis=0).tolist()
    if np.abs(intrinsics - [fx, fy, cx, cy]).max() > 0.01 * abs(fx):
        raise WearcapError("intrinsics that change", where=path, expected="one camera")
    for scale in (1, REDUCED):
        if 0.3 < scale * cx / width < 0.7 and 0.3 < scale * cy / height < 0.7 and fx > 0 and fy > 0:
            return Camera("pinhole", width, height, *(scale * value for value in (fx, fy, cx, cy)))
    raise WearcapError(
        f"fx fy cx cy = {fx:.1f} {fy:.1f} {cx:.1f} {cy:.1f} for disparities of {width}x{height}",
        where=path,
        expected=f"a principal point near the middle of these pixels, or of an {REDUCED}th of them",
    )


def _points(
    track: Trajectory, disparity: np.ndarray, camera: Camera, settings: DroidPoints, folder: Path
) -> PointCloud:
    """Pixels whose depth enough neighbouring keyframes confirm, keyframe by keyframe."""
    floor = settings.min_disparity * _mean(disparity, folder)
    grid = torch.meshgrid(
        torch.arange(0, camera.width, settings.stride), torch.arange(0, camera.height, settings.stride), indexing="xy"
    )
    column, row = (axis.flatten() for axis in grid)
    ray = camera.unproject(torch.stack([column, row], -1).float())
    ray = ray / ray[:, 2:]
    T = track.T_world_body
    clouds, confidences, counts = [], [], []
    for frame in range(len(track)):
        seen = torch.from_numpy(np.array(disparity[frame], np.float32))[row, column]
        near = seen > floor
        points = T[frame] @ (ray[near] / seen[near, None])
        others = [
            k
            for k in range(frame - settings.neighbors, frame + settings.neighbors + 1)
            if k != frame and 0 <= k < len(track)
        ]
        agreeing = sum(
            (_agrees(points, T[k], disparity[k], camera, settings.agreement).long() for k in others),
            torch.zeros(len(points), dtype=torch.int64),
        )
        sure = agreeing >= settings.min_agreeing
        clouds.append(points[sure])
        confidences.append(agreeing[sure].float() / max(len(others), 1))
        counts.append(int(sure.sum()))
    first_seen = track.timestamps.repeat_interleave(torch.tensor(counts))
    return PointCloud(torch.cat(clouds), torch.cat(confidences), first_seen)


def _mean(disparity: np.ndarray, folder: Path) -> float:
    means = np.array([frame.mean(dtype=np.float64) for frame in disparity])
    check_finite({"disparity": means}, folder / "disps.npy")
    return float(means.mean())


def _agrees(
    points: Float[Tensor, "point 3"], T_world_cam: Rigid, disparity: np.ndarray, camera: Camera, within: float
) -> Tensor:
    """Mask of points (world) whose depth in another keyframe agrees with that keyframe's own disparity."""
    points_cam: Tensor = T_world_cam.inverse() @ points  # pyright: ignore[reportAssignmentType]
    pixels, visible = camera.project(points_cam)
    column, row = pixels.round().long().unbind(-1)
    there = torch.from_numpy(np.array(disparity, np.float32))
    there = there[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return visible & ((points_cam[:, 2] * there - 1).abs() < within)
