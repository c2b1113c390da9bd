"""A wearer's own logs as recordings: a head's trajectory, two watches with a head camera, a headset's log.

Each source has a function that lists its recordings as tasks, preceded by the one that makes a recording of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS, Skeleton, skeleton_of_height
from wearcap.errors import WearcapError, require_choice
from wearcap.files import content_hash
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import swing_between
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.conventions import AUTO, Conventions
from wearcap.io.devices.aria_mps import T_HEAD_DEVICE, head_stream, is_mps_folder, read_mps, read_points
from wearcap.io.devices.axes import CAMERA, DEVICES, UPRIGHT, WORLDS, DeviceAxes, device_axes, to_head_axes
from wearcap.io.devices.headset_log import read_headset_log
from wearcap.io.devices.watch_log import read_inertial_log, read_watch_log
from wearcap.io.formats.camera_json import read_camera
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.io.formats.pcd import read_pcd
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.pose_columns import FIRST_CAMERA
from wearcap.io.formats.poses import check_finite
from wearcap.io.formats.trajectory import TrajectoryFile, read_trajectory_file
from wearcap.io.formats.video import video_info
from wearcap.recording.recording import CameraStream, FloorTrack, HeadStream, ImuStream, PointCloud, Recording
from wearcap.sensors.camera_alignment import SlamAlignment
from wearcap.sensors.slam_alignment import SceneEvidence, align_cleaned, pose_of

Numbers = Sequence[float | int]


@dataclass(frozen=True)
class Evidence:
    """What shows a trajectory's scale and vertical, as files and numbers of the config; times count from the first pose."""

    points: str | None = None
    standing: Numbers | None = None
    camera_height_m: float | int | None = None
    head_imu: str | None = None
    T_cam_imu: Numbers | None = None
    walks: Sequence[Numbers] | None = None

    def cloud(self, read: TrajectoryFile) -> PointCloud | None:
        """The points in the trajectory's world, from which its origin is taken off, too."""
        return None if self.points is None else read_cloud(self.points, read.origin)

    def of(self, read: TrajectoryFile, unit_m: float | None, up: Tensor | None) -> SceneEvidence:
        """What is known of a file whose unit of length and vertical may be known."""
        start_s = read.trajectory.timestamps[0].item()
        cloud = self.cloud(read)
        return SceneEvidence(
            None if cloud is None else cloud.points_world,
            None if self.standing is None else _times(self.standing, 2, "standing", start_s),
            None if self.camera_height_m is None else float(self.camera_height_m),
            None if self.head_imu is None else read_head_imu(self.head_imu),
            pose_of(self.T_cam_imu, "T_cam_imu"),
            tuple((*_times(walk[:2], 2, "walks", start_s), float(walk[2])) for walk in self.walks or ()),
            unit_m if unit_m is not None else 1.0 if read.metric else None,
            up,
        )


@dataclass(frozen=True)
class HeadVideo:
    """The head camera's video, its intrinsics, and the time of its first frame after the first pose (s)."""

    video: str | None = None
    camera: str | None = None
    start_s: float | int = 0.0


@dataclass(frozen=True)
class Outliers:
    """Poses that accelerate more (m/s²) are outliers, and interpolated; a longer stretch that deviates is no burst."""

    max_acceleration: float | int = 40.0
    max_burst_s: float | int = 1.0


@dataclass(frozen=True)
class TrajectorySettings:
    """How a trajectory becomes a head's path in metres, z up; None: from the file's content."""

    up: str = "auto"
    axes: str = "auto"
    time_unit: str | None = None
    fps: float | int | None = None
    unit: str | float | int = AUTO
    T_head_device: Numbers | None = None
    height: float | int | None = None
    evidence: Evidence = Evidence()
    video: HeadVideo = HeadVideo()
    outliers: Outliers = Outliers()

    def files(self) -> list[Path]:
        """The other files that a recording is made of; a video counts by its size."""
        parts = self.evidence.points, self.evidence.head_imu, self.video.camera
        return [Path(file) for file in parts if file is not None]

    def skeleton(self) -> Skeleton | None:
        return None if self.height is None else skeleton_of_height(float(self.height))

    def mount(self) -> Rigid:
        """T_head_device: the given one, else the nominal one of glasses and headsets."""
        return pose_of(self.T_head_device, "T_head_device") or T_HEAD_DEVICE


def _times(values: Numbers, count: int, name: str, start_s: float) -> tuple[float, float]:
    try:
        first, last = (start_s + float(value) for value in values)
    except (TypeError, ValueError) as error:
        raise WearcapError(
            f"{name}={list(values)}", expected=f"{count} numbers in seconds from the first pose"
        ) from error
    return first, last


def read_head_imu(path: str | Path) -> ImuStream:
    """An inertial sensor on the head: a log of a watch, a phone, or x-IMU3."""
    if {"Accelerometer X (g)"} & set(read_header(path)):
        return replace(read_inertial_log(path, "head"), joint="head")
    return replace(read_watch_log(path, WRISTS[0]), joint="head")


def read_cloud(path: str | Path, origin: np.ndarray | None = None) -> PointCloud:
    """Points of a .ply, .pcd, MPS' semi-dense points, or a table with columns x, y, z; `origin` is taken off them.

    Raises WearcapError for any other file.
    """
    suffixes = {suffix.lower() for suffix in Path(path).suffixes}
    shift = np.zeros(3) if origin is None else origin
    if ".ply" in suffixes or ".pcd" in suffixes:
        read = read_ply if ".ply" in suffixes else read_pcd
        return PointCloud(torch.from_numpy(read(path, shift.tolist()).points))
    header = read_header(path)
    if "px_world" in header:
        return read_points(path)
    table = read_columns(path, ["x", "y", "z"])
    columns = {name: table[name] for name in "xyz"}
    check_finite(columns, path)
    return PointCloud(torch.from_numpy(np.stack(list(columns.values()), 1) - shift).float())


def read_path(file: Path, name: str, about: dict[str, str], settings: TrajectorySettings) -> Recording:
    """The head's path, points and camera of one trajectory."""
    if file.is_dir() and is_mps_folder(file):
        read = read_mps(file)
        note = "; ".join(["Aria's MPS folder: nominal glasses", *filter(None, [read.note])])
        return replace(read, name=name, skeleton=settings.skeleton(), note=note, **about)
    unit, fps = settings.time_unit, settings.fps
    read = read_trajectory_file(file, unit, None if fps is None else float(fps))
    head, alignment, note = head_of(read, settings, str(file))
    points = settings.evidence.cloud(read)
    if points is not None:
        points = replace(points, points_world=alignment.points(points.points_world))
    origin = origin_of(read, alignment)
    floor = None
    if settings.evidence.camera_height_m is not None:
        floor = FloorTrack(head.timestamps[:1], torch.zeros(1))
    camera = _camera(settings.video, head)
    skeleton = settings.skeleton()
    return Recording(
        name, head, camera=camera, points=points, floor=floor, skeleton=skeleton, origin=origin, note=note, **about
    )


def origin_of(read: TrajectoryFile, alignment: SlamAlignment) -> Float64[Tensor, "3"] | None:
    """What brings places of the aligned world back to the map's (m, z up): `Recording.origin`."""
    if read.origin is None:
        return None
    return alignment.scale * alignment.R_world_slam @ torch.from_numpy(read.origin) - alignment.t_world_slam


def head_of(read: TrajectoryFile, settings: TrajectorySettings, where: str) -> tuple[HeadStream, SlamAlignment, str]:
    """(the head stream in metres with z up, alignment of the file's world, and what was detected)."""
    if read.format == "MPS":  # Aria's frame is that of a camera on its side: taken to the pupils' midpoint
        worn = head_stream(read.trajectory, fps=60.0, where=where)
        path = Trajectory(worn.timestamps, worn.R_world_device, worn.t_world_device)
        read = replace(read, trajectory=path, of_camera=False)
    axes, up, vertical = _axes(read, settings, where)
    R_device_cam = DEVICES[axes].mT @ CAMERA
    slam = replace(read.trajectory, R_world_body=read.trajectory.R_world_body @ R_device_cam)
    evidence = settings.evidence.of(read, Conventions(unit=settings.unit).unit_m, up)
    limits = float(settings.outliers.max_acceleration), float(settings.outliers.max_burst_s)
    alignment, clean, outliers = align_cleaned(slam, evidence.align, *limits)
    track = to_head_axes(alignment.apply(clean), DeviceAxes("z", "camera", 1.0, ""))
    mount = settings.mount()
    head = HeadStream(track.timestamps, track.R_world_body, track.t_world_body, mount.R, mount.t)
    unit = "in metres" if alignment.scale == 1 else f"a unit is {alignment.scale:.4g} m"
    notes = [f"{read.format}, times in {read.time_unit}", vertical, f"the device has {axes}'s axes", unit]
    return head, alignment, "; ".join([*notes, *read.notes, *([outliers] if outliers else [])])


def _axes(read: TrajectoryFile, settings: TrajectorySettings, where: str) -> tuple[str, Tensor | None, str]:
    """(the device's axes, rotation to a world with z up, how it is known); None where scene or sensor will tell."""
    stated = Conventions(up=settings.up, axes=settings.axes)
    require_choice(stated.axes, (AUTO, *DEVICES), f"a trajectory with axes={stated.axes}")
    given = stated.axes if stated.axes != AUTO or not read.of_camera else "camera"
    known = settings.evidence
    if known.head_imu is not None or (known.points and known.standing and known.camera_height_m):
        device = "camera" if given == "auto" else given
        return device, None, f"vertical by the {'head sensor' if known.head_imu is not None else 'floor'}"
    try:
        axes = device_axes(read.trajectory, stated.up, given, where, read.usual)
    except WearcapError:
        up = -read.trajectory.R_world_body[:, :, 1].double().mean(0)
        if stated.up != AUTO or given != "camera" or up.norm() < UPRIGHT:
            raise
        # Structure from motion has an arbitrary world: a worn camera is upright on average.
        R = swing_between(up / up.norm(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        return (
            "camera",
            R,
            "vertical by the camera's mean tilt, some degrees off (better: head_imu=, or points= of the floor)",
        )
    level = (
        ", as level as its first camera was held" if read.usual == FIRST_CAMERA and axes.up == FIRST_CAMERA[0] else ""
    )
    return axes.device, WORLDS[axes.up], f"{axes.up} is up{level} ({axes.known_by})"


def _camera(of: HeadVideo, head: HeadStream) -> CameraStream | None:
    """The video's camera, which looks along the device's forward axis: its frames begin `start_s` after the first pose."""
    if of.video is None:
        return None
    if of.camera is None:
        fix = "Calibrate it: wearcap calibrate source=VIDEO; then camera=camera.json."
        raise WearcapError("a video without its camera's intrinsics", of.video, fix=fix)
    info, lens = video_info(of.video), read_camera(of.camera)
    if not info.frames or not info.fps:
        raise WearcapError("a video that does not say how many frames it has", of.video, "a whole video")
    start = head.timestamps[0].item() + float(of.start_s)
    times = start + torch.arange(info.frames, dtype=torch.float64) / float(info.fps)
    if times[-1] < head.timestamps[0] or times[0] > head.timestamps[-1]:
        what = f"the video from {times[0]:.2f} to {times[-1]:.2f} s"
        expected = f"it and the path, {head.timestamps[0]:.2f} to {head.timestamps[-1]:.2f} s, at the same time"
        raise WearcapError(what, of.video, expected, "Give video_start_s=SECONDS.")
    R = head.R_head_device @ CAMERA
    return CameraStream(times, lens, R, head.t_head_device, video=str(Path(of.video).absolute()))


@dataclass(frozen=True)
class HeadsetSettings:
    """How a headset's log is read, and who wore it; "auto" and None: from the file's content."""

    unit: str | float | int = AUTO
    axes: str = AUTO
    quaternion: str = AUTO
    hands: str = AUTO
    time_unit: str | None = None
    T_head_device: Numbers | None = None
    height: float | int | None = None

    def read(self, path: Path, name: str, about: dict[str, str]) -> Recording:
        """Head, wrists and floor of a log."""
        how = Conventions(unit=self.unit, axes=self.axes, quaternion=self.quaternion, hands=self.hands)
        log = read_headset_log(path, how, self.time_unit)
        mount = pose_of(self.T_head_device, "T_head_device") or T_HEAD_DEVICE
        head = HeadStream(log.head.timestamps, log.head.R_world_body, log.head.t_world_body, mount.R, mount.t)
        return Recording(
            name,
            head=head,
            tracked=log.wrists,
            fingers=log.fingers,
            floor=FloorTrack(head.timestamps[:1], torch.zeros(1)) if log.floor else None,
            skeleton=None if self.height is None else skeleton_of_height(float(self.height)),
            note="; ".join(log.notes),
            **about,
        )


def log_name(path: Path) -> str:
    """A recording's name: its file's or folder's, or that of the folder above a usual one; replays are named after players."""
    if path.suffix.lower() == ".bsor":
        return f"replay_{content_hash(path)[:8]}"
    name = path.resolve().name.split(".")[0] if path.is_file() else path.resolve().name
    usual = ("images", "data", "poses", "trajectory", "closed_loop_trajectory", "trackers")
    return path.resolve().parent.name if name in usual else name
