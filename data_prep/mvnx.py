"""Xsens takes (MVNX): alone, or with the head camera's video, where it was localised, and the scene's scan."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch

from data_prep.hps import nominal_mount
from data_prep.shared.engine import Splits, Task
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.io.formats.camera_json import read_camera
from wearcap.io.formats.scene_folder import cloud_file, used_files
from wearcap.io.formats.trajectory import read_trajectory
from wearcap.io.formats.video import video_info
from wearcap.prepare.suits import read_suit
from wearcap.reading.any_file import of_name
from wearcap.reading.kinds import below
from wearcap.recording.recording import CameraStream, Localization, Recording
from wearcap.sensors.slam_alignment import pose_of

VERSION = 2
"""Version of the conversion, increased when the same source and settings yield another recording."""


@dataclass(frozen=True)
class SuitSettings:
    """What was recorded beside a suit; all of it may be missing."""

    video: str | None = None
    camera: str | None = None
    video_start_s: float | int = 0.0
    T_head_cam: Sequence[float | int] | None = None
    camera_poses: str | None = None
    time_unit: str | None = None
    fps: float | int | None = None
    scene: str | None = None

    def files(self) -> list[Path]:
        """The other files that a recording is made of; a video counts by its size."""
        return [Path(file) for file in (self.camera, self.camera_poses) if file is not None]

    def localized(self) -> Localization | None:
        """The camera's poses in the scene; every pose of the file is believed."""
        if self.camera_poses is None:
            return None
        track = read_trajectory(self.camera_poses, self.time_unit, None if self.fps is None else float(self.fps))
        times = track.timestamps if self.fps is None else track.timestamps + float(self.video_start_s)
        sure = torch.ones(len(times))
        return Localization(times, track.R_world_body.float(), track.t_world_body.float(), sure)

    def filmed(self, localization: Localization | None) -> CameraStream | None:
        """The head camera, where there is one."""
        if self.camera is None:
            return None
        mount = pose_of(self.T_head_cam, "T_head_cam")
        R, t = nominal_mount() if mount is None else (mount.R, mount.t)
        if self.video is None:
            return (
                None if localization is None else CameraStream(localization.timestamps, read_camera(self.camera), R, t)
            )
        info = video_info(self.video)
        if not info.frames or not info.fps:
            raise WearcapError("a video that does not say how many frames it has", self.video, "a whole video")
        times = float(self.video_start_s) + torch.arange(info.frames, dtype=torch.float64) / float(info.fps)
        return CameraStream(times, read_camera(self.camera), R, t, video=str(Path(self.video).absolute()))


def _suit(path: Path, name: str, about: dict[str, str], settings: SuitSettings) -> Recording:
    """The suit with its camera, localisation and scene. Raises WearcapError where camera and suit share no time."""
    localization = settings.localized()
    camera = settings.filmed(localization)
    recording = read_suit(path)
    assert recording.suit is not None
    suit = recording.suit.timestamps
    for stream in (camera, localization):
        if stream is not None and (stream.timestamps[0] > suit[-1] or stream.timestamps[-1] < suit[0]):
            what = f"the camera from {stream.timestamps[0]:.2f} to {stream.timestamps[-1]:.2f} s"
            expected = f"it and the suit, {suit[0]:.2f} to {suit[-1]:.2f} s, at the same time"
            raise WearcapError(what, settings.video or settings.camera_poses, expected, "Give video_start_s=SECONDS.")
    scene = None if settings.scene is None else str(cloud_file(settings.scene).absolute())
    return replace(recording, name=name, camera=camera, localization=localization, scene=scene, **about)


def mvnx_tasks(
    source: str | Path,  # a take, or a folder of takes
    splits: Splits,
    subject: str = "wearer",
    license: str = "the recording's own",
    video: str | None = None,  # the head camera's video, and its intrinsics (wearcap calibrate source=VIDEO)
    camera: str | None = None,  # camera.json
    video_start_s: float | int = 0.0,  # of its first frame on the suit's clock; claps correct it in the capture
    # camera on the head joint: [x,y,z] or [x,y,z,qw,qx,qy,qz]; null: upright on the forehead
    T_head_cam: Sequence[float | int] | None = None,
    # the camera's poses in the scene (TUM, EuRoC, COLMAP, hloc, DROID-SLAM …), in metres
    camera_poses: str | None = None,
    time_unit: str | None = None,  # of these: s, ms, us, ns; null: from the numbers
    fps: float | int | None = None,  # of the video, for poses with frame numbers or no times
    scene: str | None = None,  # the scene's scan, or its folder
) -> list[Task]:
    """One task per MVNX file: a file, or each in a folder.

    Raises WearcapError where there is none, for a video or localisation of several takes, and for one without intrinsics.
    """
    source = Path(source)
    settings = SuitSettings(video, camera, video_start_s, T_head_cam, camera_poses, time_unit, fps, scene)
    if not source.exists():
        raise WearcapError("no such file or folder", where=source, fix="Give it as source=FILE or source=DIR.")
    if settings.camera is None and (settings.video or settings.camera_poses):
        fix = "Calibrate it: wearcap calibrate source=VIDEO; then camera=camera.json."
        raise WearcapError("a head camera without its intrinsics", settings.video or settings.camera_poses, fix=fix)
    if missing := [path for path in (*settings.files(), Path(settings.video or source)) if not path.exists()]:
        raise WearcapError("no such file", missing[0])
    found = list(below(source, of_name("MVNX"))) if source.is_dir() else [source]
    if not found:
        raise WearcapError("no .mvnx in this folder", source, "takes that MVN exported (plain, .gz or .xz)")
    if len(found) > 1 and (settings.files() or settings.video):
        what = f"{len(found)} takes, but a video or localisation of one"
        raise WearcapError(what, where=source, fix="Prepare that one alone: source=FILE.")
    sizes = [] if settings.video is None else [str(Path(settings.video).stat().st_size)]
    map_beside = [] if settings.scene is None else used_files(cloud_file(settings.scene))[1:]
    tasks = []
    for path in found:
        name = path.name.split(".")[0]
        about = {"subject": subject, "license": license, "source": f"mvnx {path.name}"}
        key = content_hash(name, about, asdict(settings), VERSION, *sizes, path, *settings.files(), *map_beside)
        make = partial(_suit, path, name, about, settings)
        tasks.append(Task(name, make, splits.of(subject), key))
    return tasks
