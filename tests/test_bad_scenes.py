"""Scenes, clocks, objects and labels that are wrong: one error each that names the fault, and nothing is lost."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import exit_code, files_in
from wearcap.cli import main as cli
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.environment import write_environment
from wearcap.recording import ImuStream, Localization, RecordingStore
from wearcap.scene.objects import Environment, Freedom, SceneObject
from wearcap_testing import recording_of, suited, swaying_motion


@pytest.fixture
def small_scene(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent / "pipelines")
    import small_scene

    return small_scene


def photo_rows(folder: Path, change) -> None:
    path = folder / "photos.json"
    content = json.loads(path.read_text())
    change(content["photos"])
    path.write_text(json.dumps(content))


SCENES = {
    "missing intrinsics": (
        lambda scene, folder: photo_rows(folder, lambda rows: rows[0]["camera"].pop("fx")),
        "lacks 'fx'",
    ),
    "an empty map": (lambda scene, folder: photo_rows(folder, lambda rows: rows.clear()), "no photos"),
    "a cloud without colour": (lambda scene, folder: scene.write_room(folder, colors=False), "no colour"),
    "a scene in millimetres": (lambda scene, folder: scene.write_room(folder, unit=1000), "looks like millimetres"),
    "image size and calibration": (
        lambda scene, folder: photo_rows(folder, lambda rows: rows[0]["camera"].update(width=160)),
        "size and calibration differ",
    ),
}


@pytest.mark.parametrize("row", SCENES)
def test_the_doctor_names_a_scenes_fault_once(row, small_scene, tmp_path, capsys):
    damage, message = SCENES[row]
    small_scene.write_room(tmp_path)
    damage(small_scene, tmp_path)
    assert exit_code(["doctor", "--json", str(tmp_path)]) == 1
    findings = next(iter(json.loads(capsys.readouterr().out)["findings"].values()))
    errors = [finding for finding in findings if finding["severity"] == "error"]
    assert len(errors) == 1
    assert message in errors[0]["what"]
    assert errors[0]["fix"]


def test_contacts_shorter_than_poses(tmp_path, capsys):
    motion = swaying_motion(90)
    recording = recording_of(motion, "r")
    short = replace(motion)
    object.__setattr__(short, "contact_prob", torch.zeros(50, 4))  # the type itself would refuse it here
    RecordingStore(tmp_path).add(replace(recording, suit=short), split="test", config_hash="x")
    assert exit_code(["doctor", "--json", str(tmp_path)]) == 1
    assert "Motion.contact_prob has 50 rows for 90 timestamps" in capsys.readouterr().out


def test_no_clap_is_reported(tmp_path, capsys):
    motion = swaying_motion(600)
    wrist = motion.joint("left_wrist")
    imu = ImuStream(motion.timestamps, "left_wrist", R_world_imu=wrist.R, acc_world=torch.zeros(600, 3))
    found = Localization(motion.timestamps, wrist.R, wrist.t, torch.ones(600))
    recording = replace(recording_of(motion, "r"), imu={"left_wrist": imu}, localization=found)
    RecordingStore(tmp_path).add(recording, split="test", config_hash="x")
    with suppress(SystemExit):
        cli.main(["doctor", "--json", str(tmp_path)])
    findings = json.loads(capsys.readouterr().out)["findings"]["r"]
    assert ["no clap found" in finding["what"] for finding in findings if finding["check"] == "claps"] == [True]


# Objects that can be moved, and contact labels -----------------------------------------------------------------------


def spoiled_environment(folder: Path, change) -> Path:
    """The file of one door, with something changed in it."""
    corners = np.array([[x, y, z] for x in (0.0, 0.8) for y in (0.0, 0.04) for z in (0.0, 2.0)], np.float32)
    mesh = Mesh(corners, np.zeros((0, 3), np.int32), np.ones(3, np.float32))
    door = SceneObject("door", "door", mesh, torch.eye(3), torch.zeros(3), Freedom("hinge", pivot=(0.0, 0.0, 0.0)))
    write_environment(Environment((door,)), folder)
    path = folder / "environment.json"
    content = json.loads(path.read_text())
    change(content["objects"][0])
    path.write_text(json.dumps(content))
    return path


OBJECTS = {
    "an object without degrees of freedom": (lambda row: row.pop("freedom"), "no degree of freedom"),
    "a hinge far from its mesh": (lambda row: row["freedom"].update(pivot=[9.0, 0.0, 0.0]), "8.20 m from its mesh"),
    "a missing mesh": (lambda row: row.update(mesh="objects/none.ply"), "its mesh objects/none.ply is missing"),
}


@pytest.mark.parametrize("row", OBJECTS)
def test_an_environments_fault_is_one_error(row, tmp_path, capsys):
    change, message = OBJECTS[row]
    path = spoiled_environment(tmp_path, change)
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    assert exit_code(["doctor", "--json", str(path)]) == 1
    found = next(iter(json.loads(capsys.readouterr().out)["findings"].values()))
    errors = [finding for finding in found if finding["severity"] == "error"]
    assert len(errors) == 1
    assert message in errors[0]["what"]
    assert errors[0]["fix"]
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before


LABELS = {
    "overlapping labels": (
        {"contacts": {"left_hand": [[0.1, 0.6], [0.4, 0.8]], "right_hand": []}},
        "labels of left_hand overlap",
    ),
    "an end before the start, and more": (
        {"contacts": {"left_hand": [[0.5, 0.2], [0.6, 0.8]], "right_hand": []}},
        "an end before its start means",
    ),
    "an empty label": ({"contacts": {"left_hand": [], "right_hand": [[0.5, 0.5]]}}, "right_hand label 0 is empty"),
    "another recording": (
        {
            "schema_version": 1,
            "recording": {"name": "other", "frames": 9, "start_s": 0.0, "stop_s": 9.0},
            "contacts": {"left_hand": [], "right_hand": []},
        },
        "labels of recording 'other'",
    ),
    "longer than the recording": (
        {"contacts": {"left_hand": [[0.1, 60.0]], "right_hand": []}},
        "outside the recording",
    ),
}


@pytest.mark.parametrize("row", LABELS)
def test_labels_that_cannot_be_are_refused_and_kept(row, tmp_path, capsys):
    content, message = LABELS[row]
    data, output = suited(tmp_path / "data"), tmp_path / "labels"
    output.mkdir()
    file = output / "r.contacts.json"
    file.write_text(json.dumps(content))
    assert exit_code(["annotate", f"{data}/r", "--output", str(output), "--no-browser"]) == 2
    printed = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(printed) == 1
    assert message in printed[0]
    assert json.loads(file.read_text()) == content
    assert files_in(output) == {file.name}
