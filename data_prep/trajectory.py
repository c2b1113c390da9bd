"""A head device's trajectory, known by its content: TUM, EuRoC, COLMAP, hloc, DROID-SLAM, MPS, KITTI, ARKit, NeRF."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from data_prep.shared.engine import Splits, Task
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.conventions import AUTO
from wearcap.prepare.logs import Evidence, HeadVideo, Outliers, TrajectorySettings, log_name, read_path
from wearcap.reading.any_file import of_name
from wearcap.reading.kinds import known
from wearcap.recording.recording import Recording

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


def trajectory_tasks(
    source: str | Path,  # a file, a folder of COLMAP, DROID-SLAM or MPS, or a folder of such files
    splits: Splits,
    subject: str = "wearer",
    license: str = "the recording's own",
    # of the wearer (m); null: from how high the head is carried, when it is captured
    height: float | int | None = None,
    up: str = AUTO,  # the world's up axis: z, y, -y, x, -x, -z
    axes: str = AUTO,  # of the device: camera (x right, y down), head (x forward, z up), openxr (x right, y up)
    time_unit: str | None = None,  # s, ms, us, ns; null: from the numbers
    fps: float | int | None = None,  # of the video, for files with frame numbers or no times
    # of length: m, cm, mm …, or metres per unit; auto: 1, or from points, head_imu or walks
    unit: str | float | int = AUTO,
    # device on the head joint: [x,y,z] or [x,y,z,qw,qx,qy,qz]; null: glasses, [0.09,0,0.075]
    T_head_device: Sequence[float | int] | None = None,
    points: str | None = None,  # .ply, .pcd or a table x, y, z in the trajectory's world
    # [from,to] (s from the first pose) upright; with points and camera_height_m the floor gives scale and vertical
    standing: Sequence[float | int] | None = None,
    camera_height_m: float | int | None = None,  # height of the camera above the floor while standing
    head_imu: str | None = None,  # log of an inertial sensor on the camera, on its clock: scale and vertical
    T_cam_imu: Sequence[float | int] | None = None,  # its pose in the camera, as T_head_device; null: the same axes
    walks: Sequence[Sequence[float | int]] | None = None,  # straight walks: [[from,to,metres],…], for the scale
    video: str | None = None,  # the head camera's video, and its intrinsics (wearcap calibrate)
    camera: str | None = None,  # camera.json
    video_start_s: float | int = 0.0,  # time of its first frame after the first pose
    max_acceleration: float | int = 40.0,
    max_burst_s: float | int = 1.0,
) -> list[Task]:
    """One task per trajectory: a file, a folder that is one, or each trajectory in a folder.

    Poses that accelerate more than `max_acceleration` (m/s²) are outliers, and interpolated, unless they last longer than
    `max_burst_s`.
    Raises WearcapError where there is none, and for points, a video or an inertial log of several trajectories.
    """
    source = Path(source)
    evidence = Evidence(points, standing, camera_height_m, head_imu, T_cam_imu, walks)
    clean = Outliers(max_acceleration, max_burst_s)
    path = up, axes, time_unit, fps, unit, T_head_device, height
    settings = TrajectorySettings(*path, evidence, HeadVideo(video, camera, video_start_s), clean)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, fix="Give it as source=FILE or source=DIR.")
    kinds, found = [*of_name("trajectory"), *of_name("MPS")], [source]
    if source.is_dir() and not known(source, kinds):
        found = [path for path in sorted(source.iterdir()) if known(path, kinds)]
    if not found:
        raise WearcapError("no trajectory in this folder", source, "a file that wearcap doctor knows as one")
    if len(found) > 1 and (settings.files() or settings.video.video):
        what = f"{len(found)} trajectories, but points, video or head_imu of one"
        raise WearcapError(what, where=source, fix="Prepare that one alone: source=FILE.")
    files = settings.files()
    return [
        log_task("trajectory", VERSION, path, read_path, splits, subject, license, settings, files) for path in found
    ]


def log_task(
    kind: str,
    version: int,
    path: Path,
    make: Callable[..., Recording],
    splits: Splits,
    subject: str,
    license: str,
    settings: Any,
    files: Sequence[Path] = (),
) -> Task:
    """A task that is hashed by its files and settings, and named after its file or folder."""
    name = log_name(path)
    read = [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.is_file()]
    small = [file for file in (*read, *files) if file.stat().st_size < 1 << 30]
    key = content_hash(kind, name, subject, license, asdict(settings), version, *small)
    about = {
        "subject": subject,
        "license": license,
        "source": f"{kind} {path.name if path.suffix != '.bsor' else name}",
    }
    return Task(name or kind, partial(make, path, name or kind, about, settings), splits.of(subject), key)
