"""MocapEvery's capture folders: head path, points and watches, no true body."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.io.datasets.hps import nominal_mount
from wearcap.io.datasets.mocap_every_folder import (
    MocapEveryFolder,
    is_mocap_every_folder,
    mocap_every_files,
    mocap_every_recording,
    read_mocap_every_folder,
)
from wearcap.prepare.engine import Task, content_hash
from wearcap.prepare.splits import Splits
from wearcap.recording.recording import Recording
from wearcap.sensors.camera_alignment import align_by_walks
from wearcap.sensors.slam_track import clean_track

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class MocapEverySettings:
    """Settings of the conversion of a capture folder to a recording in metres, z up."""

    scale: float | int | None
    """Metres per unit of SLAM, with the first camera pose taken as level; None: from the calibration board."""
    height_m: float | int
    """Height (m) of the first camera pose above the floor, used with `scale`."""
    max_acceleration: float | int
    """Acceleration (m/s²) beyond which camera poses are outliers."""
    max_burst_s: float | int


@dataclass(frozen=True)
class MocapEveryCapture:
    """One capture folder; picklable, callable as a task."""

    folder: Path
    name: str
    subject: str
    settings: MocapEverySettings
    license: str

    def __call__(self) -> Recording:
        """Recording without outlier poses, which are detected in metres before the world is changed."""
        read = read_mocap_every_folder(self.folder)
        scale, T_world_slam = _alignment(read, self.settings, self.folder)
        clean = clean_track(read.T_slam_cam, self.settings.max_acceleration / scale, self.settings.max_burst_s)
        recording = mocap_every_recording(replace(read, T_slam_cam=clean.trajectory), scale, T_world_slam)
        return replace(recording, name=self.name, subject=self.subject, license=self.license)


def mocap_every_folder_tasks(
    source: str | Path, splits: Splits, subject: str, settings: MocapEverySettings, license: str
) -> list[Task]:
    """One task per capture folder at or below `source`; hashed by all files read, a video by its size."""
    source = Path(source)
    if not source.is_dir():
        raise WearcapError("no such folder", where=source, fix="Give it as source=DIR.")
    folders = [path for path in sorted([source, *source.rglob("*")]) if is_mocap_every_folder(path)]
    if not folders:
        raise WearcapError("no capture", where=source, expected="folders with cam_traj.pkl")
    tasks = []
    for folder in folders:
        name = folder.resolve().name
        files = mocap_every_files(folder)
        small = [path for path in files if path.suffix.lower() != ".mp4"]
        sizes = [path.stat().st_size for path in files if path not in small]
        digest = content_hash(name, subject, vars(settings), license, VERSION, sizes, *small)
        capture = MocapEveryCapture(folder, name, subject, settings, license)
        tasks.append(Task(name, capture, splits.of(subject), digest))
    return tasks


def _alignment(read: MocapEveryFolder, settings: MocapEverySettings, folder: Path) -> tuple[float, Rigid]:
    """Scale and T_world_slam from the calibration board, or from a given scale and a level first pose."""
    if settings.scale is None:
        if read.board is None:
            raise WearcapError(
                "it does not define the length of a unit of SLAM",
                where=folder,
                expected="cam_scale_origin in config.yaml, and x and y in camera_calib.pkl",
                fix="Measure it, and give scale=METRES_PER_UNIT.",
            )
        board = read.board
        return align_by_walks(board.x_slam, board.y_slam, board.length_m, board.height_m)
    if settings.scale <= 0:
        raise WearcapError(f"scale={settings.scale}", expected="metres per unit of SLAM, above 0")
    R_world_cam, _ = nominal_mount()
    R_world_slam = R_world_cam @ read.T_slam_cam.R_world_body[0].mT
    first = settings.scale * read.T_slam_cam.t_world_body[0]
    start = torch.tensor([0.0, 0.0, settings.height_m])
    return float(settings.scale), Rigid(R_world_slam, start - R_world_slam @ first)
