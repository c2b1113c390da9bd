"""MocapEvery's capture folders (cam_traj.pkl, sfm/, video/, watch_sensorlog_1.csv and _2.csv); bring your own captures.

Camera poses are of an OpenCV camera in SLAM's own world, whose unit and axes are arbitrary until the calibration board
fixes them (appendix C.2): the wearer's camera was carried along the board's x and y edges, whose lengths are known.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.hps import nominal_mount
from data_prep.shared.engine import Splits, Task, source_folder
from wearcap.body.skeleton import WRISTS
from wearcap.boundary.arrays import array_of, require
from wearcap.boundary.opening import understood
from wearcap.boundary.pickles import read_pickle, read_pickled_dict
from wearcap.boundary.texts import finite_floats, read_text, read_yaml_object
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.watch_log import read_watch_log
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.poses import checked_trajectory
from wearcap.io.formats.video import video_info
from wearcap.recording import CameraStream, HeadStream, ImuStream, PointCloud, Recording
from wearcap.sensors.monocular_slam import clean_track

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""
FPS = 30.0
"""Frame rate (Hz) of SLAM's input pictures."""
TRAJECTORY, CONFIG, MARKS = "cam_traj.pkl", "config.yaml", "camera_calib.pkl"
POINTS, VIDEO = "sfm/pointcloud/pcd_results.ply", "video/ego_video.MP4"
UNDISTORTED, LENS = "sfm/undistort_calib.txt", "sfm/calib.txt"
LOGS = ("watch_sensorlog_1.csv", "watch_sensorlog_2.csv")
"""Logs of the left and the right wrist."""
_SLAM_PIXELS = 384 * 512
"""Approximate number of pixels to which DROID-SLAM shrinks pictures; it crops both sides to multiples of 8."""


@dataclass(frozen=True)
class _BoardWalks:
    """Paths of the camera over the calibration board: start and end (SLAM's units), and the measured lengths."""

    x_slam: Float[Tensor, "end 3"]
    y_slam: Float[Tensor, "end 3"]
    length_m: tuple[float, float]
    """Lengths of the paths along x and along y."""
    height_m: float
    """Height of the camera above the floor at the start of the path along y."""

    def align(self) -> tuple[float, Rigid]:
        """Scale (m per unit) and T_world_slam: p_world = T_world_slam @ (scale · p_slam).

        The scale is the mean of both edges' (appendix C.2). The rotation aligns the walks with the world's x and y,
        equally weighted, in closed form where the paper optimises; the origin is on the floor below the start of y.
        Raises WearcapError for walks that are far from a right angle.
        """
        displacements = torch.stack([end[1] - end[0] for end in (self.x_slam, self.y_slam)]).double()
        length = displacements.norm(dim=1)
        if not (length > 0).all() or abs((displacements[0] @ displacements[1] / length.prod()).item()) > 0.5:
            what = "the camera's paths along the board's edges are not at a right angle"
            fix = "Check the times of the walks along x and y."
            raise WearcapError(what, where="camera on the board", expected="about 90°", fix=fix)
        scale = (torch.tensor(self.length_m, dtype=torch.float64) / length).mean().item()
        axes = torch.eye(3, dtype=torch.float64)[:2]
        R = rotation.nearest_rotation(axes.T @ (displacements / length[:, None]))
        start = torch.tensor([0.0, 0.0, self.height_m], dtype=torch.float64)
        return scale, Rigid(R, start - R @ (scale * self.y_slam[0].double())).to(torch.float32)


@dataclass(frozen=True)
class MocapEveryFolder:
    """Content of a capture folder, in SLAM's own world."""

    name: str
    T_slam_cam: Trajectory
    """Camera poses at 30 Hz from the shutter's time (s since 1970, the watches' clock), or from 0 where none is noted."""
    camera: Camera | None = None
    """Pinhole camera of SLAM's input pictures, which are undistorted and small."""
    lens: Camera | None = None
    """Camera of the video itself, with distortion."""
    points_slam: Float[Tensor, "point 3"] | None = None
    video: Path | None = None
    imu: dict[str, ImuStream] | None = None
    board: _BoardWalks | None = None


def is_mocap_every_folder(folder: str | Path) -> bool:
    """Whether a folder holds the camera trajectory of a capture."""
    return (Path(folder) / TRAJECTORY).is_file()


def mocap_every_files(folder: str | Path) -> list[Path]:
    """Files of a folder that are read."""
    names = (TRAJECTORY, CONFIG, MARKS, POINTS, UNDISTORTED, LENS, *LOGS, VIDEO)
    return [path for name in names if (path := Path(folder) / name).is_file()]


def read_mocap_every_folder(folder: str | Path) -> MocapEveryFolder:
    """Read a capture folder; everything but the trajectory may be missing.

    Raises WearcapError for a trajectory that is no (T, 7) array of position and unit quaternion (x, y, z, w), for
    pickles that hold anything but data, and for any other file that is there and not as documented.
    """
    folder = Path(folder)
    config = read_yaml_object(folder / CONFIG) if (folder / CONFIG).is_file() else {}
    # Times (s) of the calibration movements along x and y (start, stop), and of the shutter
    marks = read_pickled_dict(folder / MARKS, "a dict of times") if (folder / MARKS).is_file() else {}
    noted = marks.get("shutter")
    noted = config.get("cam_shutter_timestamp") if noted is None else noted
    shutter_s = 0.0 if noted is None else _numbers([noted], 1, "the shutter's time", folder)[0]
    path = folder / TRAJECTORY
    content = read_pickle(path)
    table = array_of(content, path)
    require({"poses": table}, path, poses=("time", 7))
    if not len(table):
        raise WearcapError("no poses", path, "a row of 7 numbers per picture")
    if abs(table[0, 3]) > 0.9999 > abs(table[0, 6]):
        what = "the first quaternion is the identity with the scalar first"
        raise WearcapError(what, path, "x y z, then qx qy qz qw", "Move the scalar to the end of the rows.")
    times = shutter_s + np.arange(len(table)) / FPS
    track = checked_trajectory(times, table[:, :3], table[:, [6, 3, 4, 5]], path)
    video = folder / VIDEO if (folder / VIDEO).is_file() else None
    size = None if video is None else (video_info(video).width, video_info(video).height)
    points = read_ply(folder / POINTS).points if (folder / POINTS).is_file() else None
    undistorted = None  # SLAM's pictures, whose size follows from the video's, else from the principal point
    if (path := folder / UNDISTORTED).is_file():
        fx, fy, cx, cy = _intrinsics(path, (4,))
        width, height = round(cx / 4) * 8, round(cy / 4) * 8
        if size is not None:
            shrink = np.sqrt(_SLAM_PIXELS / (size[0] * size[1]))
            width, height = (int(side * shrink) // 8 * 8 for side in size)
        if not (0.25 * width < cx < 0.75 * width and 0.25 * height < cy < 0.75 * height):
            what = f"principal point {cx:.1f}, {cy:.1f}"
            raise WearcapError(what, path, f"one near the middle of {width}x{height} pixels")
        undistorted = Camera("pinhole", width, height, fx, fy, cx, cy)
    return MocapEveryFolder(
        folder.resolve().name,
        track,
        undistorted,
        _lens(folder / LENS, size),
        None if points is None else torch.from_numpy(points),
        video,
        {joint: read_watch_log(folder / log, joint) for joint, log in zip(WRISTS, LOGS) if (folder / log).is_file()},
        _board(track, config, marks, folder),
    )


def mocap_every_recording(folder: MocapEveryFolder, scale: float = 1.0, T_world_slam: Rigid | None = None) -> Recording:
    """Recording in the world p_world = T_world_slam @ (scale · p_slam); by default in SLAM's own world.

    The device is at the camera's position with the head's axes (x forward, y left, z up), mounted on the head as in
    `hps.nominal_mount`. Watches are as read: their headings, mounts and clocks are not calibrated.
    """
    T_world_slam = T_world_slam or Rigid.identity()
    track = folder.T_slam_cam
    T_world_cam = T_world_slam @ Rigid(track.R_world_body, scale * track.t_world_body)
    R_head_cam, t_head_cam = nominal_mount()
    points = folder.points_slam
    cloud = None if points is None else PointCloud(T_world_slam @ (scale * points))  # pyright: ignore[reportArgumentType]
    camera = None  # of the video with its lens where both exist, else of SLAM's pictures
    if folder.video is not None and folder.lens is not None:
        info = video_info(folder.video)
        count = int((track.timestamps[-1] - track.timestamps[0]).item() * info.fps + 1.5)
        count = min(count, info.frames) if info.frames else count
        times = track.timestamps[0] + torch.arange(count, dtype=torch.float64) / info.fps
        camera = CameraStream(times, folder.lens, R_head_cam, t_head_cam, video=str(folder.video.resolve()))
    elif folder.camera is not None:
        camera = CameraStream(track.timestamps, folder.camera, R_head_cam, t_head_cam)
    return Recording(
        folder.name,
        head=HeadStream(track.timestamps, T_world_cam.R @ R_head_cam.mT, T_world_cam.t, torch.eye(3), t_head_cam),
        imu=folder.imu or {},
        camera=camera,
        points=cloud,
        source="MocapEvery capture folder",
    )


def _board(track: Trajectory, config: dict[str, Any], marks: dict[Any, Any], folder: Path) -> _BoardWalks | None:
    measured = config.get("cam_scale_origin")
    if measured is None or not {"x", "y"} <= marks.keys():
        return None
    if not isinstance(measured, dict) or not {"dist", "height"} <= measured.keys():
        raise WearcapError("cam_scale_origin lacks a number", folder / CONFIG, "dist: [x, y] and height (m)")
    length = _numbers(measured["dist"], 2, "cam_scale_origin.dist", folder / CONFIG)
    (height,) = _numbers([measured["height"]], 1, "cam_scale_origin.height", folder / CONFIG)
    if min(*length, height) <= 0:
        raise WearcapError(f"distances {length} and height {height}", folder / CONFIG, "metres above 0")
    ends = []
    for name in ("x", "y"):
        times = torch.tensor(_numbers(marks[name], 2, name, folder / MARKS), dtype=torch.float64)
        if not ((times >= track.timestamps[0] - 1) & (times <= track.timestamps[-1] + 1)).all():
            expected = (
                f"{track.timestamps[0].item():.3f} s to {track.timestamps[-1].item():.3f} s, as the camera's path"
            )
            raise WearcapError(f"{name} at {times.tolist()} s", folder / MARKS, expected)
        ends.append(track.t_world_body[(track.timestamps[None] - times[:, None]).abs().argmin(1)])
    return _BoardWalks(ends[0], ends[1], (length[0], length[1]), height)


def _numbers(values: Any, count: int, what: str, where: Path) -> list[float]:
    try:
        found = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        found = []
    if len(found) != count or not np.isfinite(found).all():
        raise WearcapError(f"{what} is {str(values)[:60]}", where, f"{count} finite numbers")
    return found


def _intrinsics(path: Path, counts: tuple[int, ...]) -> list[float]:
    with understood("not a list of numbers", path, "fx fy cx cy"):
        values = finite_floats(read_text(path).split()).tolist()
    if len(values) not in counts:
        what = f"{len(values)} numbers"
        raise WearcapError(what, path, f"{' or '.join(map(str, counts))}: fx fy cx cy and distortion")
    return values


def _lens(path: Path, video: tuple[int, int] | None) -> Camera | None:
    """Calibration of the video's own pictures (OpenCV: k1 k2 p1 p2 [k3]); None where the file is missing."""
    if not path.is_file() or video is None:
        return None
    fx, fy, cx, cy, *bent = _intrinsics(path, (4, 8, 9))
    return Camera("opencv" if bent else "pinhole", *video, fx, fy, cx, cy, tuple(bent))


@dataclass(frozen=True)
class MocapEverySettings:
    """Settings of the conversion of a capture folder to a recording in metres, z up."""

    scale: float | int | None
    height_m: float | int
    max_acceleration: float | int
    max_burst_s: float | int

    def alignment(self, read: MocapEveryFolder, folder: Path) -> tuple[float, Rigid]:
        """Scale and T_world_slam from the calibration board, or from a given scale and a level first pose."""
        if self.scale is None:
            if read.board is None:
                what = "it does not define the length of a unit of SLAM"
                expected = "cam_scale_origin in config.yaml, and x and y in camera_calib.pkl"
                fix = "Measure it, and give scale=METRES_PER_UNIT."
                raise WearcapError(what, where=folder, expected=expected, fix=fix)
            return read.board.align()
        if self.scale <= 0:
            raise WearcapError(f"scale={self.scale}", expected="metres per unit of SLAM, above 0")
        R_world_cam, _ = nominal_mount()
        R_world_slam = R_world_cam @ read.T_slam_cam.R_world_body[0].mT
        first = self.scale * read.T_slam_cam.t_world_body[0]
        start = torch.tensor([0.0, 0.0, self.height_m])
        return float(self.scale), Rigid(R_world_slam, start - R_world_slam @ first)


def _mocap_every(folder: Path, name: str, subject: str, settings: MocapEverySettings, license: str) -> Recording:
    """A recording without outlier poses, which are detected in metres before the world is changed."""
    read = read_mocap_every_folder(folder)
    scale, T_world_slam = settings.alignment(read, folder)
    clean, _, _ = clean_track(read.T_slam_cam, settings.max_acceleration / scale, settings.max_burst_s)
    recording = mocap_every_recording(replace(read, T_slam_cam=clean), scale, T_world_slam)
    return replace(recording, name=name, subject=subject, license=license)


def mocap_every_folder_tasks(
    source: str | Path,  # a capture folder, or one that holds such folders
    splits: Splits,
    subject: str = "wearer",
    license: str = "the recording's own",
    # metres per unit of SLAM, the first camera pose taken as level; null: from the board
    scale: float | int | None = None,
    height_m: float | int = 1.6,  # height of the first camera pose above the floor, if scale is given
    max_acceleration: float | int = 40.0,  # camera poses that accelerate more (m/s²) are outliers, and interpolated
    max_burst_s: float | int = 1.0,  # a longer stretch that deviates is no burst of outliers
) -> list[Task]:
    """One task per capture folder at or below `source`; hashed by all files read, a video by its size."""
    source, settings = source_folder(source), MocapEverySettings(scale, height_m, max_acceleration, max_burst_s)
    folders = [path for path in sorted([source, *source.rglob("*")]) if is_mocap_every_folder(path)]
    if not folders:
        raise WearcapError("no capture", where=source, expected="folders with cam_traj.pkl")
    tasks = []
    for folder in folders:
        name, files = folder.resolve().name, mocap_every_files(folder)
        small = [path for path in files if path.suffix.lower() != ".mp4"]
        sizes = [path.stat().st_size for path in files if path not in small]
        key = content_hash(name, subject, vars(settings), license, VERSION, sizes, *small)
        make = partial(_mocap_every, folder, name, subject, settings, license)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks
