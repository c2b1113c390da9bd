"""The examples run on small files that other programs could have written."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from hps_walk import hps_dataset, hps_recording
from scipy.spatial.transform import Rotation

from wearcap.io.formats.motion_npz import read_motion
from wearcap_testing import PROJECT, swaying_motion


def run(monkeypatch, name: str, *arguments: object) -> None:
    monkeypatch.setattr("sys.argv", [name, *map(str, arguments)])
    runpy.run_path(str(PROJECT / "examples" / f"{name}.py"), run_name="__main__")


def tum(path: Path, times: np.ndarray, R: torch.Tensor, t: torch.Tensor) -> Path:
    quat_xyzw = Rotation.from_matrix(R.double().numpy()).as_quat()
    np.savetxt(path, np.column_stack([times, t.double().numpy(), quat_xyzw]), fmt="%.7f")
    return path


@pytest.fixture
def walk():
    return swaying_motion(240, fps=60.0)


def test_head_device(walk, tmp_path, monkeypatch):
    head = walk.joint("head")
    path = tum(tmp_path / "path.txt", walk.timestamps.numpy(), head.R, head @ torch.tensor([0.09, 0.0, 0.09]))
    run(monkeypatch, "head_device", path, tmp_path / "motion.npz", 1.68)
    motion = read_motion(tmp_path / "motion.npz")
    assert len(motion) == 240
    assert motion.skeleton.stature == pytest.approx(1.68, abs=1e-3)


def test_suit_and_scan(tmp_path, monkeypatch, capsys):
    hps_dataset(tmp_path / "data", hps_recording("walk", 6.0))
    run(monkeypatch, "suit_and_scan", tmp_path / "data" / "walk", tmp_path / "motion.npz")
    assert read_motion(tmp_path / "motion.npz").provenance["pipeline"] == "hps"
    assert "than the suit alone believes" in capsys.readouterr().out


def test_two_watches(walk, tmp_path, monkeypatch):
    kit = tmp_path / "kit"
    kit.mkdir()
    head = walk.joint("head")
    tum(kit / "camera.txt", walk.timestamps.numpy(), head.R, head @ torch.tensor([0.09, 0.0, 0.09]))
    for side in ("left", "right"):
        wrist = walk.joint(f"{side}_wrist")
        R, acc = (
            wrist.R.double().numpy(),
            np.gradient(np.gradient(wrist.t.double().numpy(), 1 / 60, axis=0), 1 / 60, axis=0),
        )
        free = np.einsum("tji,tj->ti", R, acc)
        gravity = np.einsum("tji,j->ti", R, [0.0, 0.0, -9.80665])
        turn = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec() * 60
        turn = np.concatenate([turn, turn[-1:]])
        quat = Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]
        names = [f"{name}{axis}" for name in ("rotationRate", "gravity", "acceleration") for axis in "XYZ"]
        names += [f"quaternion{axis}" for axis in "WXYZ"]
        table = np.column_stack([turn, gravity / 9.80665, free / 9.80665, quat])
        rows = [
            f"{round(1e9 * time)}," + ",".join(f"{value:.9f}" for value in row)
            for time, row in zip(walk.timestamps.tolist(), table)
        ]
        (kit / f"{side}.csv").write_text("\n".join([",".join(["time", *names]), *rows]) + "\n")
    run(monkeypatch, "two_watches", kit, tmp_path / "motion.npz", 1.75)
    motion = read_motion(tmp_path / "motion.npz")
    assert motion.provenance["pipeline"] == "mocap_every"
    assert motion.timestamps[-1] - motion.timestamps[0] > 3.0
