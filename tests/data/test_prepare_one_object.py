"""BEHAVE and OMOMO to data sets: level ground, one clock for body and object, environments, rates, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from data_prep.behave import _ground_rotation
from data_prep.omomo import _check_rate, read_omomo
from data_prep.shared.engine import Splits, check_recording
from wearcap.cli.conf import splits_dir
from wearcap.cli.main import run_verb
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.environment import read_environment
from wearcap.recording.store import RecordingStore


@pytest.fixture
def files(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    import one_object_files

    return one_object_files


def prepared(name: str, root: Path, *more: str) -> RecordingStore:
    arguments = [name, f"source={root / 'in'}", f"output={root / 'out'}", "jobs=1", *more]
    assert run_verb("prepare", arguments) == 0
    return RecordingStore.open(root / "out")


def check_take(store: RecordingStore, name: str, object_name: str, files) -> None:
    """What every recording of these data sets has: a level floor, and the object half a metre before the pelvis."""
    recording = store.load(name)
    check_recording(recording)
    motion, path = recording.motion, recording.object_motion[object_name]
    assert motion is not None
    assert recording.head is not None
    assert recording.floor is not None
    assert recording.contacts is not None
    assert recording.interactions is None
    assert motion.skeleton.name == "xsens23"
    assert motion.fps == pytest.approx(30.0)
    assert motion.timestamps[0] == 0.0
    assert torch.equal(path.timestamps, motion.timestamps)
    height = motion.t_world_root[:, 2].mean().item()
    assert height == pytest.approx(motion.skeleton.root_height, abs=0.05)
    box_height = files.standing_about().skeleton.root_height + 0.1
    assert path.t_world_body[:, 2].mean().item() == pytest.approx(box_height, abs=0.03)
    beside = (path.t_world_body - motion.t_world_root)[:, :2].norm(dim=-1)
    assert (beside - 0.5).abs().max() < 0.03
    at = int(0.5 * 30)
    assert recording.contacts.contact[:at].all()
    environment = read_environment(store.root / (recording.environment or ""))
    (item,) = environment.objects
    assert (item.name, item.category, item.freedom.kind) == (object_name, "box", "free")
    np.testing.assert_allclose(item.mesh.vertices, files.CORNERS - files.CORNERS.mean(0), atol=1e-6)
    torch.testing.assert_close(item.t_world_object, path.t_world_body[0], atol=1e-6, rtol=0)


def test_behave_becomes_a_data_set(tmp_path, files):
    files.write_behave(tmp_path / "in")
    files.write_behave(tmp_path / "in", name="Date01_Sub01_boxlarge_lift")
    store = prepared("behave", tmp_path)
    assert store.names("test") == [files.BEHAVE_NAME]
    assert store.names("train") == ["Date01_Sub01_boxlarge_lift"]
    entry = store.entries[files.BEHAVE_NAME]
    assert (entry.context.subject, entry.context.location, entry.context.activity, entry.fps) == (
        "Sub04",
        "Date03",
        "boxlarge_hand",
        30.0,
    )
    assert "non-commercial" in entry.context.license
    check_take(store, files.BEHAVE_NAME, "boxlarge", files)
    assert store.load(files.BEHAVE_NAME).source == "BEHAVE"


def test_what_is_current_is_left_and_what_changed_is_made_again(tmp_path, files, capsys):
    files.write_behave(tmp_path / "in")
    prepared("behave", tmp_path)
    prepared("behave", tmp_path)
    assert "0 written, 1 current" in capsys.readouterr().out
    files.write_behave(tmp_path / "in", body={"betas": np.zeros((180, 10))})
    prepared("behave", tmp_path)
    assert "1 written, 0 current" in capsys.readouterr().out


def test_a_camera_that_looks_down_is_levelled_by_the_feet(tmp_path, files):
    files.write_behave(tmp_path / "in", tilt_deg=12.0)
    store = prepared("behave", tmp_path)
    motion = store.load(files.BEHAVE_NAME).motion
    assert motion is not None
    assert float(motion.provenance["tilt_deg"]) == pytest.approx(12.0, abs=1.0)
    check_take(store, files.BEHAVE_NAME, "boxlarge", files)


def test_a_ground_that_is_a_wall_is_refused(tmp_path, files, capsys):
    files.write_behave(tmp_path / "in", tilt_deg=42.0)
    with pytest.raises(SystemExit):
        prepared("behave", tmp_path)
    assert "the ground below the feet is tilted by" in capsys.readouterr().err


def test_the_ground_is_found_among_steps_that_are_off_it():
    generator = torch.Generator().manual_seed(0)
    points = torch.cat(
        [3 * torch.rand(600, 2, generator=generator), 0.01 * torch.randn(600, 1, generator=generator)], 1
    )
    points[:90, 2] += 0.35  # feet on a chair's rung
    tilted = rotation.exp(torch.tensor([0.1, -0.15, 0.0]))
    level = _ground_rotation(points @ tilted.T) @ tilted
    assert torch.rad2deg(torch.arccos(level[2, 2].clamp(max=1.0))) < 0.5
    assert torch.equal(_ground_rotation(points[:3]), torch.eye(3))
    one_place = torch.tensor([[0.0, 0.0, 0.0]]).repeat(50, 1)
    torch.testing.assert_close(_ground_rotation(one_place), torch.eye(3))


def test_long_gaps_are_cut_and_short_ones_bridged(tmp_path, files, capsys):
    body, handled = files.behave_arrays()
    kept = np.r_[0:30, 33:110, 140:180]
    cut = [{key: value[kept] for key, value in part.items() if value.ndim} for part in (body, handled)]
    files.write_behave(tmp_path / "in", body=cut[0], handled=cut[1])
    store = prepared("behave", tmp_path)
    motion = store.load(files.BEHAVE_NAME).motion
    assert motion is not None
    assert len(motion) == 110
    assert "kept frames 0 to 106 of 147: 1 gaps of more than 0.2 s" in capsys.readouterr().out
    steps = motion.timestamps.diff()
    torch.testing.assert_close(steps, torch.full_like(steps, 1 / 30))


def test_omomo_becomes_a_data_set(tmp_path, files):
    files.write_omomo(tmp_path / "in")
    files.write_omomo(tmp_path / "in", files.omomo_entry(name="sub3_largebox_001"), split="train")
    store = prepared("omomo", tmp_path)
    assert store.names("test") == [files.OMOMO_NAME]
    assert store.names("train") == ["sub3_largebox_001"]
    entry = store.entries[files.OMOMO_NAME]
    assert (entry.context.subject, entry.context.activity, entry.fps) == ("sub16", "largebox_007", 30.0)
    assert "research" in entry.context.license
    check_take(store, files.OMOMO_NAME, "largebox", files)
    assert store.load(files.OMOMO_NAME).source == "OMOMO"


def test_omomo_at_another_rate_is_brought_to_30(tmp_path, files):
    files.write_omomo(tmp_path / "in", files.omomo_entry(fps=120.0))
    store = prepared("omomo", tmp_path, "source_fps=120")
    assert store.entries[files.OMOMO_NAME].frames == 180
    check_take(store, files.OMOMO_NAME, "largebox", files)


def walker(files, fps: float) -> dict:
    """Someone who walks at 1.1 m/s and swings the legs, 30 frames per second at the true rate of 30."""
    entry = files.omomo_entry(fps=fps)
    count = len(entry["trans"])
    seconds = np.arange(count) / fps
    entry["trans"] = entry["trans"].copy()
    entry["trans"][:, :2] = np.stack([1.1 * seconds, 0 * seconds], 1) + files.TRANS2JOINT[:2]
    swing = 0.5 * np.sin(2 * np.pi * seconds)
    entry["pose_body"] = entry["pose_body"].copy()
    entry["pose_body"][:, 0], entry["pose_body"][:, 3] = swing, -swing  # both hips, about SMPL's x
    upright = np.full((count, 3), 2.0944 / math.sqrt(3))  # SMPL's y and z to the world's z and x
    entry["root_orient"] = upright.astype(np.float32)
    return entry


@pytest.mark.parametrize(("true", "stated", "advice"), [(30.0, 120, "is lower"), (120.0, 30, "is higher")])
def test_a_rate_at_which_nobody_walks_is_refused(tmp_path, files, true, stated, advice):
    files.write_omomo(tmp_path, walker(files, true))
    sequences = read_omomo(tmp_path)
    _check_rate(sequences, tmp_path, true)
    with pytest.raises(WearcapError, match=f"at {stated} frames per second people walk at .*{advice}"):
        _check_rate(sequences, tmp_path, stated)


def test_rates_that_are_none_and_sequences_that_fail_alone(tmp_path, files, capsys):
    files.write_omomo(tmp_path / "in", files.omomo_entry(), files.omomo_entry(name="sub1_spaceship_000"))
    assert (
        run_verb("prepare", ["omomo", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "source_fps=0"]) == 2
    )
    assert "a frame rate of 0 Hz" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        prepared("omomo", tmp_path)
    printed = capsys.readouterr().err
    assert "failed: sub1_spaceship_000: " in printed
    assert "no mesh of spaceship" in printed
    assert RecordingStore.open(tmp_path / "out").names() == [files.OMOMO_NAME]


def test_an_object_of_no_class_is_refused(tmp_path, files, capsys):
    files.write_behave(tmp_path / "in", name="Date01_Sub01_spaceship", cat="spaceship")
    with pytest.raises(SystemExit):
        prepared("behave", tmp_path)
    assert "no class for the object 'spaceship'" in capsys.readouterr().err


def test_a_body_on_its_head_is_refused(tmp_path, files, capsys):
    body, _ = files.behave_arrays()
    poses = body["poses"].copy()
    poses[:, :3] = 0.0  # SMPL's y is up, the camera's is down
    files.write_behave(tmp_path / "in", body={"poses": poses})
    with pytest.raises(SystemExit):
        prepared("behave", tmp_path)
    assert "below the feet" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["behave", "omomo"])
def test_a_folder_without_sequences_is_one_error(tmp_path, name, capsys):
    assert run_verb("prepare", [name, f"source={tmp_path}", f"output={tmp_path / 'out'}"]) == 2
    assert "no sequences" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_official_splits():
    behave, omomo = (Splits.read(splits_dir() / f"{name}.csv") for name in ("behave", "omomo"))
    assert [behave.of(name) for name in ("Date03_Sub05_stool", "Date04_Sub05_stool")] == ["test", "train"]
    assert [number for number in range(1, 18) if omomo.of(f"sub{number}") == "test"] == [16, 17]
