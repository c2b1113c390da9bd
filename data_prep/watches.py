"""Two watches' logs and a head camera's trajectory, with the calibration of wearcap calibrate steps=watches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from data_prep.shared.engine import Splits, Task
from data_prep.trajectory import log_task
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.io.conventions import AUTO
from wearcap.io.devices.watch_log import read_watch_log
from wearcap.io.formats.trajectory import read_trajectory_file
from wearcap.prepare.logs import TrajectorySettings, head_of, origin_of
from wearcap.recording.recording import Recording
from wearcap.sensors.clock import require_overlap
from wearcap.sensors.monocular_slam import clean_track
from wearcap.sensors.watch_calibration import WatchSession, read_watch_calibration
from wearcap.sensors.watches import watch_gaps

VERSION = 1
"""Version of the conversion, increased when the same source and settings yield another recording."""


def _watches(camera: Path, name: str, about: dict[str, str], settings: "WatchesSettings") -> Recording:
    """The head's path and both watches, calibrated where a calibration is given."""
    watches = {joint: read_watch_log(path, joint) for joint, path in settings.logs().items()}
    way = settings.camera
    fps = None if way.fps is None else float(way.fps)
    read = read_trajectory_file(camera, way.time_unit, fps)
    recording, notes = Recording(name, skeleton=way.skeleton(), **about), []
    if settings.calibration is not None:
        found = read_watch_calibration(settings.calibration)
        slam = read.trajectory
        if found.camera is not None:
            slam, kept, _ = clean_track(
                slam, float(way.outliers.max_acceleration) / found.camera.scale, float(way.outliers.max_burst_s)
            )
            notes += [f"{int((~kept).sum())} outliers of {len(kept)} camera poses removed"] if not kept.all() else []
        recording = WatchSession(watches, slam).added_to(recording, found)
        notes.append(f"calibrated by {Path(settings.calibration).name}")
    else:
        recording = replace(recording, imu=watches)
        notes.append(
            "watches not calibrated: their heading and how they sit on the wrists are taken as they are "
            "(wearcap calibrate steps=watches)"
        )
    if recording.head is None:
        head, alignment, note = head_of(read, way, str(camera))
        recording = replace(recording, head=head, origin=origin_of(read, alignment))
        notes.insert(0, note)
    assert recording.head is not None
    fix = "Calibrate their clocks (wearcap calibrate steps=watches … swings=[…]), or take the logs of one session."
    require_overlap(
        {**{joint: imu.timestamps for joint, imu in recording.imu.items()}, "camera": recording.head.timestamps}, fix
    )
    for gap in watch_gaps(recording.imu, recording.head.timestamps):
        notes.append(gap)
    return replace(recording, note="; ".join(notes))


@dataclass(frozen=True)
class WatchesSettings:
    """The logs of two watches, their calibration, and how the camera's trajectory is read."""

    left: str
    right: str
    calibration: str | None
    camera: TrajectorySettings

    def logs(self) -> dict[str, Path]:
        """Both logs by joint."""
        return dict(zip(WRISTS, (Path(self.left), Path(self.right))))


def watches_tasks(
    left: str,  # log of the left watch (SensorLog's CSV, WristMotion.csv), and of the right
    right: str,
    camera: str | Path,  # the head camera's trajectory, of any format that prepare trajectory reads
    splits: Splits,
    calibration: str | None = None,  # calibration.json; null: clocks, headings and mounts are taken as they are
    subject: str = "wearer",
    license: str = "the recording's own",
    # of the wearer (m); null: from how high the head is carried, when it is captured
    height: float | int | None = None,
    up: str = AUTO,  # as in prepare trajectory, where the calibration does not cover the camera; also axes, time_unit …
    axes: str = AUTO,
    time_unit: str | None = None,
    fps: float | int | None = None,
    unit: str | float | int = AUTO,
    T_head_device: Sequence[float | int] | None = None,
) -> list[Task]:
    """The one recording of two watches and a head camera; hashed by all files."""
    path = TrajectorySettings(up, axes, time_unit, fps, unit, T_head_device, height)
    settings = WatchesSettings(left, right, calibration, path)
    others = [*settings.logs().values(), *([Path(settings.calibration)] if settings.calibration else [])]
    files = [Path(camera), *others, *settings.camera.files()]
    if missing := [str(file) for file in files if not file.exists()]:
        raise WearcapError("no such file", where=missing[0], fix="Give left=CSV right=CSV camera=TRAJECTORY.")
    return [log_task("watches", VERSION, Path(camera), _watches, splits, subject, license, settings, files[1:])]
