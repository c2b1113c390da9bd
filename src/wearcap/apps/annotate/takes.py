"""A recording as shown in the annotator (thesis §5.4.1): points of the body over time, a video, objects; its labels on disk.

Labels are written atomically, never over other content, with backups.
"""

import hashlib
import json
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64

from wearcap.body.kinematics import site_positions
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, write_text
from wearcap.io.formats.contact_labels import LabelClock, Labels, annotation_of, hcontact_text, labels_of, parse_labels
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.motion_npz import read_motion
from wearcap.io.formats.video import video_info
from wearcap.recording.motion import HANDS, Interactions, Motion
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingStore, dataset_folder, load_recording
from wearcap.systems.ireplica.object_tracker import ContactSettings, active, contact_intervals


def _label_path(output: str | Path, name: str) -> Path:
    """OUTPUT/<recording>.contacts.json. Raises WearcapError for a name that is no plain file name."""
    if not name or Path(name).name != name or name.startswith("."):
        raise WearcapError(f"{name!r} cannot name a file of labels", expected="a plain file name")
    return Path(output) / f"{name}.contacts.json"


class Conflict(WearcapError):
    """Raised if the file is not the one that the labels were made from."""


class AnnotationFile:
    """The file at `label_path`. Each of its states has a revision; "" if there is no file."""

    def __init__(self, output: str | Path, clock: LabelClock):
        self.path, self.clock = _label_path(output, clock.name), clock
        self._lock = threading.Lock()
        self._writer = ("", "")
        self._ours: set[str] = set()

    def read(self) -> tuple[Labels, str]:
        """Labels and their revision. Raises WearcapError when the file is damaged or of another recording."""
        with self._lock:
            revision = self._revision()
            if not revision:
                return parse_labels({"contacts": {"left_hand": [], "right_hand": []}}, self.clock, where=self.path), ""
            return parse_labels(read_json(self.path), self.clock, where=self.path), revision

    def save(self, content: Any, base: str, *, client: str = "", force: bool = False) -> str:
        """Write labels (as `annotation_of` makes them) that were made from revision `base`, and return theirs.

        A state that was not written by this session is copied to `backups/` first. Raises WearcapError for
        impossible labels, and Conflict when the file has changed since `base` by another than `client`, unless
        forced.
        """
        labels = parse_labels(content, self.clock, where="labels")
        text = json.dumps(annotation_of(labels, self.clock), indent=1, ensure_ascii=False) + "\n"
        new = _digest(text.encode())
        with self._lock:
            there = self._revision()
            if there == new:
                return new
            if not (force or there == base or (there and self._writer == (client, there))):
                raise Conflict(
                    "the labels on disk were changed by another window or program",
                    where=self.path,
                    expected="the state that this page loaded or saved last",
                )
            if there and there not in self._ours:
                copy = self.path.parent / "backups" / f"{self.clock.name}.{there}.contacts.json"
                if not copy.exists():
                    with atomic_path(copy) as temporary:
                        temporary.write_bytes(self.path.read_bytes())
            write_text(self.path, text)
            self._writer = (client, new)
            self._ours.add(new)
            return new

    def _revision(self) -> str:
        try:
            return _digest(self.path.read_bytes())
        except FileNotFoundError:
            return ""


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def starting_labels(source: str | Path, recording: Recording, clock: LabelClock) -> Labels:
    """Labels of a label file (.json), of a captured motion (.npz), or for "recording" the recording's own.

    Raises WearcapError if the source has no contacts, or impossible ones.
    """
    if str(source) == "recording":
        if recording.interactions is None:
            what = "no interactions to start from"
            fix = "Start from a label file (.json), from a captured motion (.npz), or from nothing."
            raise WearcapError(what, where=recording.name, expected="a recording that has them", fix=fix)
        return labels_of(recording.interactions, clock)
    if Path(source).suffix == ".json":
        return parse_labels(read_json(source), clock, where=source)
    motion = read_motion(source)
    found = motion.interactions or _predicted(motion)
    if found is None:
        expected = "one that a pipeline with a contact network captured"
        raise WearcapError("a motion without contacts of the hands", where=source, expected=expected)
    return labels_of(found, clock)


def _predicted(motion: Motion) -> Interactions | None:
    """Contacts of each hand by itself, from probabilities with short gaps filled."""
    prob = motion.hand_contact_prob
    if prob is None:
        return None
    if prob.shape != (len(motion), len(HANDS)):
        raise WearcapError(f"hand contacts of shape {tuple(prob.shape)}", expected=f"({len(motion)}, {len(HANDS)})")
    contact = active(prob, motion.timestamps, ContactSettings(0.3, 0.15, 0.5))
    # Start times of frames, and the end of the last.
    edges = torch.cat([motion.timestamps, motion.timestamps[-1:] + motion.timestamps.diff().median()])
    rows = []
    for hand in range(len(HANDS)):
        alone = contact & (torch.arange(len(HANDS)) == hand)
        for held in contact_intervals(alone):
            rows.append((edges[held.start].item(), edges[held.stop].item(), held.hands, "", ""))
    return Interactions.of(rows)


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

    @classmethod
    def of(cls, recording: Recording, folder: Path, motion: Motion | None = None, video: Video | None = None) -> "Take":
        """Data of a recording with its true motion, else the suit's, and its camera's video; `motion` and `video` replace these.

        `folder` is the data set's. Raises WearcapError without a motion, or for a body without hands.
        """
        shown = motion or recording.motion or recording.suit
        if shown is None:
            what = f"recording {recording.name!r} has no motion"
            raise WearcapError(what, expected="one to look at", fix="Give a captured one with --motion.")
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
        return cls(
            clock,
            shown.timestamps.numpy(),
            points,
            _floor(recording, shown, points),
            names,
            bones,
            tuple(  # the palm, else the wrist
                names.index(f"{hand}_palm") if f"{hand}_palm" in names else shown.skeleton.index(f"{hand}_wrist")
                for hand in HANDS
            ),
            _objects(recording, folder),
            video,
            notice,
        )

    def header(self) -> dict:
        """All data except the numbers per frame, for JSON."""
        return asdict(self.clock) | {
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


def _floor(recording: Recording, motion: Motion, points: np.ndarray) -> Float32[np.ndarray, "time"]:
    """Height (m) of the floor at each frame: as recorded, else slightly below nearly all of the body."""
    if recording.floor is not None and len(recording.floor.height):
        heights = np.interp(motion.timestamps, recording.floor.timestamps, recording.floor.height)
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
        where: str | Path,
        output: Path | None = None,
        motion: Motion | None = None,
        video: Path | None = None,
        video_start_s: float | None = None,
    ):
        """A recording, or all of a data set's; labels go to `output` or outputs/annotate/<data set>.

        A motion and a video require a single recording. Raises WearcapError if there is nothing to annotate.
        """
        self.where, folder = where, dataset_folder(where)
        places: list[str | Path] = [where]
        if (Path(where) / "manifest.json").is_file():
            places = [Path(where) / name for name in RecordingStore.open(where).names()]
        if not places:
            raise WearcapError("a data set without recordings", where=where, fix="Prepare some first.")
        if len(places) > 1 and (motion is not None or video is not None):
            expected = f"one recording, such as {places[0]}"
            raise WearcapError("a motion or a video for several recordings", where=where, expected=expected)

        def open_take(index: int) -> Take:
            recording = self.recording(index)
            shown = motion or recording.motion or recording.suit
            start = video_start_s if video_start_s is not None else float(shown.timestamps[0]) if shown else 0.0
            film = None
            if video is not None:  # its first picture was taken at `start`; from there on it is on the same clock
                info = video_info(video)
                length = max(info.frames, 1) / info.fps
                film = Video(video, np.array([[start, 0.0], [start + length, length]]))
            return Take.of(recording, folder, motion, film)

        self.recording = lru_cache(maxsize=2)(lambda index: load_recording(places[index]))
        self.take = lru_cache(maxsize=2)(open_take)
        self.names = tuple(Path(place).name for place in places)
        if len(places) == 1:
            self.names = (self.recording(0).name,)
        self.output = output or Path("outputs") / "annotate" / folder.resolve().name
        self._files: dict[int, AnnotationFile] = {}
        self._lock = threading.Lock()

    def path(self, name: str) -> Path:
        """Path of the labels of a recording of that name, which need not exist yet."""
        return _label_path(self.output, name)

    def file(self, index: int) -> AnnotationFile:
        """The recording's file of labels."""
        with self._lock:
            if index not in self._files:
                self._files[index] = AnnotationFile(self.output, self.take(index).clock)
            return self._files[index]

    def start_from(self, source: str) -> None:
        """Write labels to start from (see `starting_labels`). Raises WearcapError where there are labels already."""
        if len(self.names) > 1 and source != "recording":
            raise WearcapError(f"labels from {source} for {len(self.names)} recordings", expected="one recording")
        for index in range(len(self.names)):
            file = self.file(index)
            if file.path.exists():
                fix = "Leave out --from to go on with them, or give another --output."
                raise WearcapError("there are labels already, which are never replaced", where=file.path, fix=fix)
            labels = starting_labels(source, self.recording(index), file.clock)
            file.save(annotation_of(labels, file.clock), "")

    def export(self, to: Path | None) -> Iterator[tuple[Path, int, int]]:
        """Write the labels as H-contact's JSON, to a file, or to NAME.json in a folder (None: the current one).

        Yields the files with their numbers of contacts of the left and of the right hand. Raises WearcapError without
        labels, and if a file would replace the labels it comes from.
        """
        annotated = [index for index, name in enumerate(self.names) if self.path(name).is_file()]
        if not annotated:
            expected = self.path(self.names[0]).name
            fix = f"Make them with `wearcap annotate {self.where}`."
            raise WearcapError("no labels to export", where=self.output, expected=expected, fix=fix)
        for index in annotated:
            file, target = self.file(index), Path(f"{self.names[index]}.json")
            labels, _ = file.read()
            if to is not None:
                target = to / target if len(self.names) > 1 or to.is_dir() else to
            if target.resolve() == file.path.resolve():
                raise WearcapError("the export would replace the labels it comes from", where=target)
            write_text(target, hcontact_text(labels, file.clock))
            yield target, len(labels["left"]), len(labels["right"])
