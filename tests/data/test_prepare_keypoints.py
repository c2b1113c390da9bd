"""Keypoints beside a data set's recordings: simulated, recorded and followed in the pictures, found by a detector."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data_prep import keypoints
from data_prep.keypoint_detectors import Keypoint
from data_prep.keypoints import Found, Recorded, Simulated, keypoints_dataset
from keypoint_files import write_keypoints
from wearcap.cli import prepare
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.video import write_frames
from wearcap.recording import CameraStream, Cue, Recording, RecordingStore
from wearcap_testing import small_dataset
from wearsim.sensors.keypoints import ACTION_CAMERA

FRAMES, JOINT = 30, "left_wrist"


def way() -> torch.Tensor:
    """Pixels of the wrist: a spot that moves over a still picture."""
    frame = torch.arange(FRAMES).float()
    return torch.stack([30 + 2.0 * frame, 40 + 8 * (frame / 4).sin()], -1)


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    spots = rng.integers(0, 255, (12, 12)).astype(np.uint8)
    patch = cv2.resize(spots, (31, 31), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    shown = []
    for x, y in way().tolist():
        shift = np.array([[1, 0, x - 15], [0, 1, y - 15]])
        grey = cv2.warpAffine(patch, shift, (128, 96), borderMode=cv2.BORDER_CONSTANT, borderValue=128)
        shown.append(np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, 2))
    return shown


@pytest.fixture
def filmed(tmp_path) -> RecordingStore:
    """Recordings r0 to r2; r0 and r1 with a video of the spot."""
    store = small_dataset(tmp_path / "made", frames=(70, 80, 90))
    for name in ("r0", "r1"):
        write_frames(store.root / f"videos/{name}.mp4", pictures(), 30, crf=5)
        times = torch.arange(FRAMES, dtype=torch.float64) / 30
        camera = CameraStream(
            times, Camera.pinhole(128, 96, 70), torch.eye(3), torch.zeros(3), video=f"videos/{name}.mp4"
        )
        recording = replace(store.load(name), camera=camera, session="s")
        store.add(recording, split=store.entries[name].split, config_hash="made")
    return store


def only(store: RecordingStore, *names: str) -> RecordingStore:
    for name in set(store.names()) - set(names):
        del store.entries[name]
    store.register({})
    return store


def written(folder: Path, store: RecordingStore, rows: slice = slice(None)) -> Path:
    """The spot's path for r0 and r1, at some frames."""
    for name in ("r0", "r1"):
        camera = store.load(name).camera
        cue = Cue(camera.timestamps[rows], JOINT, way()[rows], torch.ones(FRAMES)[rows])
        write_keypoints({JOINT: cue}, folder / f"{name}.csv")
    return folder


def assert_followed(recording: Recording) -> None:
    cue = recording.cues[JOINT]
    assert len(cue.timestamps) == FRAMES
    assert (cue.points - way()).norm(dim=-1).max() < 1.0


def test_simulated_keypoints_come_with_a_camera(filmed, tmp_path):
    report = keypoints_dataset(
        filmed.root, tmp_path / "new", Simulated(joints=("left_toe", "left_wrist", "left_hand"), noise_px=0, drop=0)
    )
    assert report.written == ["r0", "r1", "r2"]
    store = RecordingStore.open(tmp_path / "new")
    assert all(wrong is None for _, wrong in store.verify())
    bare, with_camera = store.load("r2"), store.load("r0")
    assert bare.camera.camera == ACTION_CAMERA
    assert len(bare.camera.timestamps) == 45
    assert with_camera.camera.camera.width == 128
    assert with_camera.session == "s"
    assert (store.root / with_camera.camera.video).samefile(filmed.root / "videos/r0.mp4")
    for recording in (bare, with_camera):
        T_world_cam = recording.motion.joint("head")
        for joint, cue in recording.cues.items():
            rows = torch.searchsorted(recording.motion.timestamps, cue.timestamps - 1e-6)
            p_head = T_world_cam.inverse()[rows] @ recording.motion.joint(joint).t[rows]
            p_cam = (p_head - recording.camera.t_head_cam) @ recording.camera.R_head_cam
            pixels, seen = recording.camera.camera.project(p_cam)
            assert seen.all()
            assert (pixels - cue.points).abs().max() < 0.1
    entry, old = store.entries["r1"], filmed.entries["r1"]
    assert (entry.split, entry.context.subject) == (old.split, old.context.subject)
    again = keypoints_dataset(
        filmed.root, store.root, Simulated(joints=("left_toe", "left_wrist", "left_hand"), noise_px=0, drop=0)
    )
    assert (len(again.current), again.written) == (3, [])


def test_recorded_keypoints_are_followed_where_pictures_are(filmed, tmp_path):
    only(filmed, "r0", "r1")
    folder = written(tmp_path / "csv", filmed, slice(0, None, 10))
    keypoints_dataset(filmed.root, tmp_path / "new", Recorded(str(folder)))
    store = RecordingStore.open(tmp_path / "new")
    for name in ("r0", "r1"):
        assert_followed(store.load(name))
    (folder / "r1.csv").write_text("timestamp,joint,x,y,z,confidence\n0.1,head,0,0,1.7,1\n")
    report = keypoints_dataset(filmed.root, tmp_path / "new", Recorded(str(folder)))
    assert (report.current, report.written) == (["r0"], ["r1"])
    assert RecordingStore.open(tmp_path / "new").load("r1").cues["head"].points.shape == (1, 3)


def test_a_detector_is_shown_every_picture(filmed, tmp_path, monkeypatch):
    class Every7th:
        joints = (JOINT,)

        def __init__(self, model):
            self.shown = 0

        def __call__(self, picture, time_s):
            assert picture.shape == (96, 128, 3)
            self.shown += 1
            x, y = way()[self.shown - 1].tolist()
            return {JOINT: Keypoint(x, y, 0.9)} if self.shown % 7 == 1 else {}

        def fingers(self):
            return {}

    monkeypatch.setattr(keypoints, "MediaPipeHands", Every7th)
    (tmp_path / "m.task").write_bytes(b"")
    report = keypoints_dataset(filmed.root, tmp_path / "new", Found(str(tmp_path / "m.task")), backend="threading")
    assert report.written == ["r0", "r1"]
    assert "no head camera" in report.failed["r2"]
    assert_followed(RecordingStore.open(tmp_path / "new").load("r0"))


def test_what_cannot_be_is_refused(filmed, tmp_path):
    for output, source, message in (
        (filmed.root, Simulated(), "would replace the old one"),
        (tmp_path / "new", Recorded(None), "Give file=PATH"),
        (tmp_path / "new", Recorded(str(written(tmp_path / "csv", filmed) / "r0.csv")), "for 3 recordings"),
        (tmp_path / "new", Found(str(tmp_path / "none.task")), "no model of MediaPipe's hands"),
    ):
        with pytest.raises(WearcapError, match=message):
            keypoints_dataset(filmed.root, output, source)
    report = keypoints_dataset(filmed.root, tmp_path / "new", Recorded(str(tmp_path / "csv")))
    assert "r2.csv: no such file" in report.failed["r2"]


def test_the_command(filmed, tmp_path, capsys):
    arguments = ["keypoints", f"dataset={filmed.root}", f"output={tmp_path}/new", "jobs=1"]
    prepare.main([*arguments, "detector=simulated", "joints=[left_toe]", "drop=0"])
    assert "3 written, 0 current, 0 failed" in capsys.readouterr().out
    only(filmed, "r0", "r1")
    folder = written(tmp_path / "csv", filmed, slice(0, None, 10))
    prepare.main([*arguments, "detector=recorded", f"file={folder}", "flow.reach=0"])
    assert "2 written" in capsys.readouterr().out
    assert len(RecordingStore.open(tmp_path / "new").load("r0").cues[JOINT].timestamps) == 3
    with pytest.raises(WearcapError, match="detector"):
        prepare.main([*arguments, "detector=recoded"])
    with pytest.raises(WearcapError, match="dataset has no value"):
        prepare.main(["keypoints"])
