"""Any file is a recording: files of every kind in, a capture of what they hold out, and one clear line for the rest."""

import pkgutil
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import wearcap
from command_line import exit_code
from mvnx_files import mvnx
from own_bvh import read_bvh
from wearcap.body.skeletons import smplh52
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.amass import read_amass, write_amass
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.camera_json import write_camera
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.reading import read
from wearcap.reading.any_file import kinds
from wearcap.recording import RecordingStore
from wearcap_testing import recording_of, swaying_motion

SECONDS = 1.0


@pytest.fixture
def take(tmp_path) -> Path:
    """A suit's capture as MVN 2018 and earlier export it: without foot contacts."""
    motion = replace(swaying_motion(round(240 * SECONDS), fps=240.0), contact_prob=torch.zeros(round(240 * SECONDS), 4))
    text = mvnx(motion, contacts=[])
    text = text.replace("<footContacts></footContacts>", "").replace(
        "<footContactDefinition></footContactDefinition>", ""
    )
    path = tmp_path / "take.mvnx"
    path.write_text(text)
    return path


@pytest.fixture
def bare_take(take) -> Path:
    """The same without sensors, whose numbers are random."""
    take.write_text(re.sub(r"<(sensor\w+)>[^<]*</\1>", "", take.read_text()))
    return take


def test_a_suit_is_what_was_sensed_and_gets_contacts(take):
    recording = read(take)
    assert recording.motion is None
    assert recording.suit is not None
    assert recording.suit.contact_prob is not None
    assert recording.suit.contact_prob.shape == (round(240 * SECONDS), 4)
    assert set(recording.imu) >= {"pelvis", "head"}


def test_motions_of_every_kind_are_recordings(tmp_path):
    motion = swaying_motion(60)
    write_motion(motion, tmp_path / "a.npz")
    write_bvh(motion, tmp_path / "a.bvh")
    write_amass(swaying_motion(60, skeleton=smplh52()), tmp_path / "a_smplh.npz")
    for name in ("a.npz", "a.bvh", "a_smplh.npz"):
        recording = read(tmp_path / name)
        assert recording.motion is not None
        assert len(recording.motion) == 60


def test_a_data_set_s_recordings_are_found_as_before(tmp_path):
    RecordingStore(tmp_path).add(recording_of(swaying_motion(60), "only"), split="train", config_hash="")
    for where in (tmp_path, tmp_path / "only", tmp_path / "recordings" / "only.safetensors"):
        assert read(where).name == "only"


def test_data_sets_register_their_kinds():
    """Where this fails though the file is right, wearcap was installed before it named this reader: install it again."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = [pkgutil.resolve_name(name) for name in project["entry-points"]["wearcap.readers"].values()]
    names = [kind.name for row in rows for kind in row]
    assert {"ADT", "HPS", "Nymeria", "TotalCapture"} <= set(names)
    assert [kind.name for kind in kinds()][: len(names)] == names


def test_other_files_get_one_line(tmp_path):
    (tmp_path / "marks.c3d").write_bytes(b"x")
    with pytest.raises(WearcapError, match="C3D file"):
        read(tmp_path / "marks.c3d")
    (tmp_path / "a.docx").write_bytes(b"x")
    with pytest.raises(WearcapError, match="not a kind of file that holds a recording"):
        read(tmp_path / "a.docx")
    with pytest.raises(WearcapError, match="no recording here: there is no such file"):
        read(tmp_path / "nothing.bvh")
    (tmp_path / "empty").mkdir()
    with pytest.raises(WearcapError, match="no recording here"):
        read(tmp_path / "empty")


def test_a_suit_becomes_files_without_a_camera(bare_take, tmp_path, monkeypatch):
    take = bare_take
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    command = ["capture", f"recording={take}", f"hydra.run.dir={out}", "video=0.1"]
    assert exit_code(command) == 0
    names = {"motion.npz", "motion.bvh", "motion.glb", "motion.mp4", "motion_smplh.npz"}
    assert {path.name for path in out.glob("motion*")} == names
    suit = read(take).suit
    assert suit is not None
    assert (read_motion(out / "motion.npz").T_world_joint.t - suit.T_world_joint.t).abs().max() < 1e-4
    assert (read_bvh(out / "motion.bvh").t_world_root - suit.t_world_root).abs().max() < 1e-3
    smpl = read_amass(out / "motion_smplh.npz").motion
    assert smpl is not None
    legs = smpl.skeleton.indices("left_hip", "right_hip")
    hips = suit.joint("left_hip").t + suit.joint("right_hip").t
    assert (smpl.T_world_joint.t[:, legs].sum(1) - hips).abs().max() < 0.02
    assert exit_code(["render", str(take), "--out", str(tmp_path / "sheet.png"), "--frames", "2"]) == 0
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_a_pipeline_says_what_the_file_lacks(take):
    with pytest.raises(WearcapError, match="no camera"):
        wearcap.load("hps")(wearcap.read(take))
    with pytest.raises(WearcapError, match="no motion in this recording"):
        wearcap.load("recorded")(replace(read(take), suit=None))


def test_motions_are_saved_by_their_names(tmp_path):
    motion = swaying_motion(10)
    for name in ("a.npz", "a.bvh", "a.glb", "a_smplh.npz", "a.trc", "a.mot", "a_angles.csv"):
        wearcap.save(motion, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 500
    assert read_motion(tmp_path / "a.npz").skeleton == motion.skeleton
    with pytest.raises(WearcapError, match=r"ends with \.npz, \.bvh, _smplh\.npz, \.vrma"):
        wearcap.save(motion, tmp_path / "a.fbx")


def test_numbers_of_a_broken_npz_are_named(tmp_path):
    np.savez(tmp_path / "a.npz", nothing=np.zeros(3))
    with pytest.raises(WearcapError, match="holds no poses"):
        read(tmp_path / "a.npz")


def test_a_take_is_prepared_alone_and_with_a_localised_camera(bare_take, tmp_path, monkeypatch):
    take = bare_take
    monkeypatch.chdir(tmp_path)
    assert exit_code(["prepare", "mvnx", f"source={take}", "output=alone"]) == 0
    alone = read(tmp_path / "alone")
    assert alone.suit is not None
    assert alone.camera is None
    poses = [f"{k / 30:.4f} {0.01 * k} 0 1.7 0.5 -0.5 0.5 -0.5" for k in range(30)]
    (tmp_path / "camera.txt").write_text("\n".join(poses))
    write_camera(Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5), tmp_path / "camera.json", {})
    command = ["prepare", "mvnx", f"source={take}", "output=both", "camera_poses=camera.txt"]
    assert exit_code(command) == 2  # no intrinsics
    assert exit_code([*command, "camera=camera.json"]) == 0
    both = read(tmp_path / "both")
    assert both.localization is not None
    assert both.camera is not None
    assert len(both.localization.timestamps) == 30
    assert torch.allclose(both.localization.t_world_cam[-1], torch.tensor([0.29, 0.0, 1.7]))
    (tmp_path / "camera.txt").write_text("\n".join(f"9{line}" for line in poses))
    assert exit_code([*command, "camera=camera.json"]) == 1
    assert exit_code([*command, "camera=camera.json", "video=nothing.mp4"]) == 2


def test_one_recording_is_scored_where_it_is_true(take, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    RecordingStore(tmp_path / "data").add(recording_of(swaying_motion(90), "only"), split="train", config_hash="")
    given = [
        "evaluate",
        "checkpoint=mocap_every",
        "baselines=false",
        "seeds=[0]",
        "jobs=1",
        f"hydra.run.dir={tmp_path}/out",
    ]
    assert exit_code([*given, f"recording={tmp_path}/data/only"]) == 0
    apart = tmp_path / "apart.safetensors"
    apart.write_bytes((tmp_path / "data" / "recordings" / "only.safetensors").read_bytes())
    assert exit_code([*given, f"recording={apart}", "output=apart/table.json"]) == 0
    capsys.readouterr()
    assert exit_code([*given, f"recording={take}"]) == 2
    assert "nothing to score against" in capsys.readouterr().err
