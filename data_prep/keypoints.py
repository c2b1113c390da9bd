"""Keypoints of the head camera beside a data set's recordings: dataset=DIR detector=mediapipe, recorded (file=PATH) or simulated.

Videos and scenes of the old data set are linked into the new one.
"""

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.keypoint_detectors import MediaPipeHands, RecordedDetections, find_model, read_keypoints
from data_prep.keypoint_flow import FlowSettings, tracked_cues
from data_prep.shared.engine import Report, Task, prepare
from wearcap.data.pictures import pictures
from wearcap.errors import WearcapError, require_choice
from wearcap.files import content_hash
from wearcap.prepare.files import with_own_files
from wearcap.recording.recording import CameraStream, Recording
from wearcap.recording.store import RecordingFile, RecordingStore
from wearsim.sensors.keypoints import action_camera, camera_path, seen_joints

VERSION = 3
"""Version of the conversion, increased when the same recording and settings yield another one."""
FLOW = FlowSettings()
CAMERA_FPS = 30.0
"""Rate (Hz) of the simulated camera of a recording without one."""


@dataclass(frozen=True)
class Found:
    """Wrists, with their fingers, detected by MediaPipe in the head camera's pictures, tracked by optical flow where detections are missing."""

    model: str | None = None
    flow: FlowSettings = field(default_factory=FlowSettings)

    def __call__(self, recording: Recording, folder: Path) -> Recording:
        camera = _camera(recording)
        detector = MediaPipeHands(self.model)
        cues = tracked_cues(pictures(camera, folder), camera.timestamps, detector, self.flow)
        return replace(recording, cues=recording.cues | cues, fingers=recording.fingers | detector.fingers())

    def settings(self, name: str) -> list[Any]:
        return ["mediapipe", find_model(self.model), asdict(self.flow)]


@dataclass(frozen=True)
class Recorded:
    """Keypoints from files: `file`/NAME.csv for each recording, or `file` itself for a single one."""

    file: str | None
    flow: FlowSettings = field(default_factory=FlowSettings)

    def __call__(self, recording: Recording, folder: Path) -> Recording:
        cues = read_keypoints(self._of(recording.name))
        if all(cue.points.shape[-1] == 2 for cue in cues.values()):
            camera = _camera(recording)
            if self.flow.reach and (camera.video or camera.image_files):
                half_frame = 0.5 * camera.timestamps.diff().median().item()
                detector = RecordedDetections(cues, half_frame)
                cues = tracked_cues(pictures(camera, folder), camera.timestamps, detector, self.flow)
        return replace(recording, cues=recording.cues | cues)

    def settings(self, name: str) -> list[Any]:
        file = self._of(name)
        return ["recorded", file if file.is_file() else None, asdict(self.flow)]

    def _of(self, name: str) -> Path:
        if self.file is None:
            raise WearcapError("no file of recorded keypoints", fix="Give file=PATH, a .csv or a folder of NAME.csv.")
        return Path(self.file) / f"{name}.csv" if Path(self.file).is_dir() else Path(self.file)


@dataclass(frozen=True)
class Simulated:
    """Simulated detections of the true motion; a recording without a head camera gets a simulated action camera."""

    joints: Sequence[str] = ("left_wrist", "right_wrist")
    noise_px: float | int = 4.0
    drop: float | int = 0.1
    seed: int = 0

    def __call__(self, recording: Recording, folder: Path) -> Recording:
        motion = recording.motion
        if motion is None:
            what, expected = "no true motion to simulate keypoints of", "motion capture, or another detector"
            raise WearcapError(what, where=recording.name, expected=expected)
        rng = np.random.default_rng([41, self.seed, zlib.crc32(recording.name.encode())])
        every = max(1, round(motion.fps / CAMERA_FPS))
        stream = recording.camera or action_camera(motion.timestamps[::every].contiguous())
        joints = [joint for joint in self.joints if joint in motion.skeleton]
        path = camera_path(motion, stream)
        cues = seen_joints(motion, path, stream.camera, joints, self.noise_px, self.drop, rng)
        return replace(recording, camera=stream, cues=recording.cues | cues)

    def settings(self, name: str) -> list[Any]:
        return ["simulated", asdict(self)]


Source = Found | Recorded | Simulated
"""Source of keypoints, picklable: called with a recording and its data set's folder, it returns the recording with cues;
`settings(name)` is the content that the cues of the recording of this name depend on (for `engine.content_hash`)."""


def keypoints_rework(
    dataset: str | Path,  # a folder made by `wearcap prepare`; the new data set refers to its videos and scenes
    output: str | Path,
    detector: str = "mediapipe",  # pip install "wearcap[hands]"; recorded: files; simulated: of the true motion
    model: str | None = None,  # for mediapipe: hand_landmarker.task; null: $WEARCAP_HANDS_MODEL
    # for recorded: a folder with NAME.csv (timestamp, joint, x, y[, z], confidence), or one .csv
    file: str | None = None,
    joints: Sequence[str] = ("left_wrist", "right_wrist"),  # for simulated
    noise_px: float | int = 4.0,
    drop: float | int = 0.1,  # share of simulated keypoints that are missed
    seed: int = 0,
    # optical flow where detections are missing: flow.reach (frames; 0: none), flow.window_px
    flow: FlowSettings = FLOW,
    jobs: int = 1,
    backend: str = "loky",
    scheduler: str | None = None,
    overwrite: bool = False,
) -> Report:
    """Keypoints by one of the detectors, added by `keypoints_dataset`. Raises WearcapError for another one."""
    require_choice(detector, ("mediapipe", "recorded", "simulated"), f"no detector {detector!r}")
    source: Source = Simulated(joints, noise_px, drop, seed)
    if detector != "simulated":
        source = Found(model, flow) if detector == "mediapipe" else Recorded(file, flow)
    return keypoints_dataset(
        dataset, output, source, jobs=jobs, backend=backend, scheduler=scheduler, overwrite=overwrite
    )


def keypoints_dataset(
    dataset: str | Path, output: str | Path, detector: Source, *, jobs: int = 1, **options: Any
) -> Report:
    """Make a data set with the recordings of another and their keypoints, in the same splits; `options` as `prepare`'s.

    Raises WearcapError when both are one folder, and for one file of keypoints with several recordings.
    """
    store = RecordingStore.open(dataset)
    if Path(output).resolve() == store.root.resolve():
        raise WearcapError("the new data set would replace the old one", where=output, expected="another folder")
    file = detector.file if isinstance(detector, Recorded) else None
    if file is not None and Path(file).is_file() and len(store.names()) > 1:
        what = f"one file of keypoints for {len(store.names())} recordings"
        raise WearcapError(what, where=file, expected="a folder with NAME.csv for each")
    tasks = []
    for name in store.names():
        entry = store.entries[name]
        make = partial(_with_keypoints, store.root / entry.file, store.root, Path(output), detector)
        tasks.append(Task(name, make, entry.split, content_hash(entry.sha256, VERSION, *detector.settings(name))))
    return prepare(tasks, output, jobs=jobs, **options)


def _camera(recording: Recording) -> CameraStream:
    if recording.camera is None:
        expected = "a recording with one, whose pixels keypoints are"
        raise WearcapError("no head camera", where=recording.name, expected=expected)
    return recording.camera


def _with_keypoints(file: Path, folder: Path, output: Path, source: Source) -> Recording:
    """One recording with its keypoints; the files that it names become the new data set's, too."""
    return with_own_files(source(RecordingFile(file).load(), folder), output, folder)
