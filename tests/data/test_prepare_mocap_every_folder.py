"""Capture folders become recordings in metres, z up, without SLAM's outliers."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from wearcap.boundary.pickles import read_pickle
from wearcap.cli import prepare as verb
from wearcap.cli.main import run_verb
from wearcap.recording import RecordingStore


@pytest.fixture
def files(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    import mocap_every_files

    return mocap_every_files


def prepared(tmp_path: Path, *more: str):
    verb.main(["mocap_every_folder", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1", *more])
    return RecordingStore.open(tmp_path / "out")


def test_the_board_aligns_and_outliers_are_gone(tmp_path, files):
    files.write_capture(tmp_path / "in" / "walk")
    path = tmp_path / "in/walk/cam_traj.pkl"
    poses = read_pickle(path)
    poses[[150, 151, 200], 1] += 0.2
    path.write_bytes(pickle.dumps(poses))
    store = prepared(tmp_path)
    assert store.entries["walk"].split == "test"
    recording = store.load("walk")
    expected = files.world_of(files.truth()[0])
    assert (recording.head.t_world_device - expected).norm(dim=-1).max() < 0.01
    assert recording.head.timestamps[0] == files.SHUTTER_S
    assert set(recording.imu) == {"left_wrist", "right_wrist"}
    assert (recording.points.points_world[:, 2]).abs().max() < 1e-3
    before = store.entries["walk"].config_hash
    path.write_bytes(pickle.dumps(poses[:-1]))
    assert prepared(tmp_path).entries["walk"].config_hash != before


def test_with_a_given_scale_the_first_pose_is_level(tmp_path, files):
    files.write_capture(tmp_path / "in", leave_out=("config.yaml",))
    recording = prepared(tmp_path, f"scale={files.SCALE}", "height_m=1.7").load("in")
    t, _ = files.truth()
    head = recording.head.t_world_device
    assert head[0].tolist() == pytest.approx([0, 0, 1.7], abs=1e-5)
    assert torch.allclose(head - head[0], torch.from_numpy(t - t[0]).float(), atol=1e-3)
    assert np.allclose(recording.head.R_world_device[0], np.eye(3), atol=1e-5)


def test_what_is_missing_is_named(tmp_path, files, capsys):
    files.write_capture(tmp_path / "in", leave_out=("config.yaml",))
    arguments = ["mocap_every_folder", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"]
    with pytest.raises(SystemExit):
        verb.main(arguments)
    assert "give scale=METRES_PER_UNIT" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        verb.main([*arguments, "scale=-1"])
    (tmp_path / "none").mkdir()
    assert run_verb("prepare", ["mocap_every_folder", f"source={tmp_path / 'none'}", f"output={tmp_path / 'o'}"]) == 2
    assert "no capture" in capsys.readouterr().err
