"""A recording as shown in the annotator (thesis §5.4.1): points of the body over time, a video, objects, labels."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearcap.io.formats.contact_labels import LabelClock
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.video import video_info
from wearcap.recording.interactions import HANDS
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingStore, dataset_folder, load_recording
from wearcap.viewer.annotation_file import AnnotationFile, label_path

_DRAWN_SITES = ("heel", "toe_tip", "fingertip")
_NOSE = torch.tensor([0.13, 0.0, 0.09])
"""Point in front of the head joint (m) that shows the viewing direction."""


@dataclass(frozen=True)
class Video:
    """A video file synchronised with the motion."""

    path: Path
    times: Float64[np.ndarray, "point 2"]
    """Rising pairs of recording time and video time (s), interpolated linearly."""


@dataclass(frozen=True)
class Take:
    """Data of one recording for the page."""

    clock: LabelClock
    timestamps: Float64[np.ndarray, "time"]
    points_world: Float32[np.ndarray, "time point 3"]
    floor_z: Float32[np.ndarray, "time"]
    point_names: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    hands: tuple[int, ...]
    """Index of the point of each of `HANDS`."""
    objects: dict[str, str]
    """Names of objects that can be touched, each with its contact class ("" if unknown)."""
    video: Video | None = None
    notice: str = ""
    """Notice for the annotator, such as a missing video."""

    def header(self) -> dict:
        """All data except the numbers per frame, for JSON."""
        clock = self.clock
        return {
            "name": clock.name,
            "frames": clock.frames,
            "start_s": clock.start_s,
            "stop_s": clock.stop_s,
            "points": self.point_names,
            "bones": self.bones,
            "hands": dict(zip(HANDS, self.hands)),
            "objects": self.objects,
            "notice": self.notice,
            "video": None if self.video is None else {"file": self.video.path.name, "times": self.video.times.tolist()},
        }

    def numbers(self) -> bytes:
        """Little-endian bytes of all frames: float64 timestamps, then float32 floor heights, then float32 points."""
        parts = ((self.timestamps, "<f8"), (self.floor_z, "<f4"), (self.points_world, "<f4"))
        return b"".join(np.ascontiguousarray(array, dtype).tobytes() for array, dtype in parts)


def take_of(recording: Recording, folder: Path, motion: Motion | None = None, video: Video | None = None) -> Take:
    """Data of a recording with its true motion, else the suit's, and its camera's video; `motion` and `video` replace these.

    `folder` is the data set's. Raises WearcapError without a motion, or for a body without hands.
    """
    shown = motion or recording.motion or recording.suit
    if shown is None:
        raise WearcapError(
            f"recording {recording.name!r} has no motion",
            expected="one to look at",
            fix="Give a captured one with --motion.",
        )
    clock = LabelClock.of(recording.name, shown.timestamps)
    names, points, bones = _drawn(shown)
    notice = ""
    if video is None and recording.camera is not None and recording.camera.video:
        path = folder / recording.camera.video
        if path.is_file():
            stamps = recording.camera.timestamps.numpy()
            video = Video(path, np.stack([stamps, np.arange(len(stamps)) / video_info(path).fps], 1))
        else:
            notice = f"The video {path} is not there: give it with --video."
    return Take(
        clock,
        shown.timestamps.numpy(),
        points,
        _floor(recording, shown, points),
        names,
        bones,
        _hands(shown, names),
        _objects(recording, folder),
        video,
        notice,
    )


def video_from(path: str | Path, start_s: float) -> Video:
    """A video whose first picture was taken at `start_s` of the recording, on the same clock from there on.

    Raises WearcapError when it is missing or damaged.
    """
    info = video_info(path)
    length = max(info.frames, 1) / info.fps
    return Video(Path(path), np.array([[start_s, 0.0], [start_s + length, length]]))


def _drawn(motion: Motion) -> tuple[tuple[str, ...], Float32[np.ndarray, "time point 3"], tuple]:
    """Joints, and hands, feet and face if the skeleton has them: names, positions, and pairs to connect."""
    skeleton, T = motion.skeleton, motion.T_world_joint
    sites = [name for name in skeleton.sites if name.endswith((*_DRAWN_SITES, "_palm")) or name == "crown"]
    names = [*skeleton.joint_names, *sites]
    parts = [T.t, site_positions(skeleton, T, tuple(sites))] if sites else [T.t]
    bones = [(parent, joint) for joint, parent in enumerate(skeleton.parents) if joint > 0]
    bones += [
        (skeleton.index(skeleton.sites[name].joint), names.index(name)) for name in sites if not name.endswith("_palm")
    ]
    if "head" in skeleton:
        head = skeleton.index("head")
        parts.append((T[:, head] @ _NOSE.to(T.t))[:, None])
        names.append("nose")
        bones.append((head, len(names) - 1))
    return tuple(names), torch.cat(parts, 1).float().numpy(), tuple(bones)


def _hands(motion: Motion, names: tuple[str, ...]) -> tuple[int, ...]:
    """The point that stands for each hand: the palm, else the wrist."""
    return tuple(
        names.index(f"{hand}_palm") if f"{hand}_palm" in names else motion.skeleton.index(f"{hand}_wrist")
        for hand in HANDS
    )


def _floor(recording: Recording, motion: Motion, points: np.ndarray) -> Float32[np.ndarray, "time"]:
    """Height (m) of the floor at each frame: as recorded, else slightly below nearly all of the body."""
    if recording.floor is not None and len(recording.floor.height):
        track = recording.floor
        heights = np.interp(motion.timestamps, track.timestamps, track.height)
        return np.asarray(heights, np.float32)
    lowest = points[:: max(1, len(points) // 5000), :, 2].min(1)
    return np.full(len(points), np.quantile(lowest, 0.05), np.float32)


def _objects(recording: Recording, folder: Path) -> dict[str, str]:
    """Objects that can be touched: the environment's, and those named in the recording."""
    objects = dict.fromkeys(recording.object_motion, "")
    if recording.interactions is not None:
        objects |= dict(zip(recording.interactions.objects, recording.interactions.classes))
    if recording.environment:
        environment = read_environment(folder / recording.environment)
        objects |= {item.name: item.freedom.contact_class for item in environment.objects}
    objects.pop("", None)
    return dict(sorted(objects.items()))


class Desk:
    """The recordings to annotate and the folder of their labels. Recordings are loaded when they are opened."""

    def __init__(
        self,
        names: tuple[str, ...],
        recording: Callable[[int], Recording],
        open_take: Callable[[int], Take],
        output: Path,
    ):
        self.names, self.recording, self.output = names, recording, output
        self._files: dict[int, AnnotationFile] = {}
        self._lock = threading.Lock()
        self.take = lru_cache(maxsize=2)(open_take)

    @classmethod
    def of(
        cls,
        where: str | Path,
        output: Path | None = None,
        motion: Motion | None = None,
        video: Path | None = None,
        video_start_s: float | None = None,
    ) -> "Desk":
        """A recording, or all of a data set's; labels go to `output` or outputs/annotate/<data set>.

        A motion and a video require a single recording. Raises WearcapError if there is nothing to annotate.
        """
        folder = dataset_folder(where)
        places: list[str | Path] = [where]
        if (Path(where) / "manifest.json").is_file():
            places = [Path(where) / name for name in RecordingStore.open(where).names()]
        if not places:
            raise WearcapError("a data set without recordings", where=where, fix="Prepare some first.")
        if len(places) > 1 and (motion is not None or video is not None):
            raise WearcapError(
                "a motion or a video for several recordings",
                where=where,
                expected=f"one recording, such as {places[0]}",
            )
        recordings = lru_cache(maxsize=2)(lambda index: load_recording(places[index]))

        def open_take(index: int) -> Take:
            recording = recordings(index)
            shown = motion or recording.motion or recording.suit
            start = video_start_s if video_start_s is not None else float(shown.timestamps[0]) if shown else 0.0
            return take_of(recording, folder, motion, video_from(video, start) if video else None)

        names = tuple(Path(place).name for place in places)
        if len(places) == 1:
            names = (recordings(0).name,)
        return cls(names, recordings, open_take, output or Path("outputs") / "annotate" / folder.resolve().name)

    def path(self, name: str) -> Path:
        """Path of the labels of a recording of that name, which need not exist yet."""
        return label_path(self.output, name)

    def file(self, index: int) -> AnnotationFile:
        """The recording's file of labels."""
        with self._lock:
            if index not in self._files:
                self._files[index] = AnnotationFile(self.output, self.take(index).clock)
            return self._files[index]
