"""H-contact in exactly its layout: bodies, contacts, splits, and files with impossible contents."""

import json
import math

import pytest
import torch
from hoi_files import motion, moved, older, smpl_content, write_json, write_zip
from hypothesis import given

from data_prep.hcontact import (
    about_sequence,
    hcontact_names,
    hcontact_tasks,
    read_hcontact,
    read_hcontact_split,
    read_smpl_json,
)
from data_prep.shared.engine import Splits
from hostile import fuzz, mutated
from wearcap.cli.main import run_verb
from wearcap.errors import WearcapError
from wearcap.recording.store import RecordingStore

DOOR, SOFA = "SUB5_TUB_2OG_door.00", "SUB9_TUB_2OG_sofamove.00"
CONTACTS = {"contacts": {"left_hand": [[0.5, 1.0]], "right_hand": [[0.5, 1.0], [1.5, 0.0]]}}


def write_set(root, names=(DOOR,), contacts=CONTACTS, frames=120):
    for seed, name in enumerate(names):
        write_zip(smpl_content(motion(frames, seed, fps=frames / 2)), root / "body" / f"{name}.json.zip")
        write_json(contacts, root / "contacts" / f"{name}.json")


def test_a_sequence_is_read(tmp_path):
    write_set(tmp_path)
    assert hcontact_names(tmp_path) == [DOOR]
    recording = read_hcontact(tmp_path, DOOR, "hinged")
    assert recording.motion is not None
    assert recording.interactions is not None
    assert recording.motion.skeleton.name == "smplh52"
    assert recording.motion.fps == pytest.approx(60.0)
    assert moved(recording.motion, motion()) < 1e-5
    assert (recording.subject, recording.location, recording.activity) == ("SUB5", "TUB_2OG", "door")
    assert recording.shape == {"beta_0": 0.5, "beta_1": -1.0}
    assert recording.motion.provenance["gender"] == "female"
    assert set(recording.interactions.classes) == {"hinged"}
    assert set(recording.interactions.objects) == {""}
    contact = recording.interactions.hand_contact(recording.motion.timestamps)
    assert contact[:, 0].nonzero()[:, 0].tolist() == list(range(30, 60))
    assert contact[:, 1].nonzero()[:, 0].tolist() == [*range(30, 60), *range(90, 120)], "open at the end"


@pytest.mark.parametrize(("hands", "body"), [(True, 69), (True, 63), (False, 69)])
def test_bodies_of_either_width(tmp_path, hands, body):
    wanted = motion(hands=hands)
    write_zip(smpl_content(wanted, body=body), tmp_path / "a.json.zip")
    read, _ = read_smpl_json(tmp_path / "a.json.zip")
    assert len(read.skeleton) == (52 if hands else 24)
    assert moved(read, wanted) < 1e-5


def test_a_body_of_63_numbers_without_hands_has_flat_ones(tmp_path):
    content = smpl_content(motion(hands=False))
    for frame in content["sequence"]:
        frame["body_pose"] = frame["body_pose"][:63]
    write_zip(content, tmp_path / "a.json.zip")
    read, _ = read_smpl_json(tmp_path / "a.json.zip")
    assert read.skeleton.name == "smpl24"
    flat = read.R_parent_joint[:, read.skeleton.indices("left_hand", "right_hand")]
    torch.testing.assert_close(flat, torch.eye(3).expand_as(flat))


def test_the_older_form_and_bodies_without_a_place(tmp_path):
    wanted = motion(hands=False)
    write_json(older(wanted), tmp_path / "old.json")
    assert moved(read_smpl_json(tmp_path / "old.json")[0], wanted) < 1e-5
    write_zip(smpl_content(wanted, placed=False), tmp_path / "a.json.zip")
    read, _ = read_smpl_json(tmp_path / "a.json.zip")
    assert not read.t_world_root.any()


def changed(key, value, frame=7):
    def change(content):
        content["sequence"][frame][key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(sequence=[]), "no poses"),
        (lambda c: c.pop("sequence"), "no poses"),
        (lambda c: c["sequence"][3].pop("body_pose"), "body_pose is missing"),
        (lambda c: [frame.pop("right_hand_pose") for frame in c["sequence"]], "poses of 69 numbers"),
        (lambda c: [frame.update(body_pose=[0.0] * 60) for frame in c["sequence"]], "poses of 60 numbers"),
        (changed("body_pose", [0.0] * 68), "body_pose is missing in a frame, or no list"),
        (changed("transl", [0.0, math.nan, 0.0]), "'transl' holds NaN"),
        (changed("time", 0.0), "follows"),
        (changed("time", "soon"), "time is missing"),
        (changed("global_orient", [0.0, 0.0]), "global_orient"),
        (lambda c: c["global"].update(betas=["a"]), "betas are no numbers"),
        (lambda c: c["global"].update(betas=[math.inf]), "not finite"),
    ],
)
def test_bodies_that_cannot_be_are_refused(tmp_path, change, message):
    content = smpl_content(motion(12))
    change(content)
    write_zip(content, tmp_path / "a.json.zip")
    with pytest.raises(WearcapError, match=message) as raised:
        read_smpl_json(tmp_path / "a.json.zip")
    assert str(raised.value).startswith(str(tmp_path / "a.json.zip"))


def test_damaged_archives(tmp_path):
    path = tmp_path / "a.json.zip"
    with pytest.raises(WearcapError, match="no such file"):
        read_smpl_json(path)
    write_zip("{", path)
    with pytest.raises(WearcapError, match="not readable JSON"):
        read_smpl_json(path)
    write_zip(b"\xff\xfe\x00", path)
    with pytest.raises(WearcapError, match="not readable JSON"):
        read_smpl_json(path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(WearcapError, match="not a readable"):
        read_smpl_json(path)


@fuzz
@given(text=mutated(json.dumps(smpl_content(motion(2)))))
def test_damaged_bodies_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    path.write_text(text, encoding="utf-8")
    try:
        read, _ = read_smpl_json(path)
    except WearcapError:
        return
    assert read.R_parent_joint.isfinite().all()


@pytest.mark.parametrize(
    ("contacts", "message"),
    [
        ({"left_hand": [[0.5, 1.5]], "right_hand": [[8.0, 9.0]]}, "outside the recording.*another recording"),
        ({"left_hand": [[0.5, 1.5], [1.0, 1.8]], "right_hand": []}, "labels of left_hand overlap"),
        ({"left_hand": [[0.5, math.nan]], "right_hand": []}, "left_hand label 0 is"),
        ({"left_hand": [[1.0, 0.0], [1.5, 1.8]], "right_hand": []}, "to the end of the recording"),
        ({"left_hand": []}, "no contact labels"),
    ],
)
def test_contacts_that_cannot_be_are_refused(tmp_path, contacts, message):
    write_set(tmp_path, contacts={"contacts": contacts})
    with pytest.raises(WearcapError, match=message) as raised:
        read_hcontact(tmp_path, DOOR)
    assert str(raised.value).startswith(str(tmp_path / "contacts" / f"{DOOR}.json"))


def test_unknown_sequences_and_classes(tmp_path):
    write_set(tmp_path)
    with pytest.raises(WearcapError, match="no sequence 'SUB6'.*SUB5"):
        read_hcontact(tmp_path, "SUB6")
    with pytest.raises(WearcapError, match="no contact class 'door'"):
        read_hcontact(tmp_path, DOOR, "door")
    (tmp_path / "contacts" / f"{DOOR}.json").unlink()
    with pytest.raises(WearcapError, match="no such file"):
        read_hcontact(tmp_path, DOOR)


def test_names():
    sofa = {"subject": "SUB1", "location": "MPI_BIB_EG", "activity": "sofa"}
    assert about_sequence("SUB1_MPI_BIB_EG_sofa.06") == sofa
    assert about_sequence("SUB5_TUB_0KIT_door_int2.00")["activity"] == "door_int2"


def test_splits(tmp_path):
    path = tmp_path / "a.json"
    write_json({"window_radius": 30, "train": [3, 1, 2], "valid": [], "test": [9]}, path)
    assert read_hcontact_split(path) == {"train": [3, 1, 2], "valid": [], "test": [9]}
    for wrong in (
        [],
        {"window_radius": 30},
        {"window_radius": 30, "train": [-1], "valid": [], "test": []},
        {"window_radius": True, "train": [], "valid": [], "test": []},
    ):
        write_json(wrong, path)
        with pytest.raises(WearcapError, match="not a split"):
            read_hcontact_split(path)


def test_the_command_makes_a_data_set(tmp_path, capsys):
    write_set(tmp_path / "set", (DOOR, SOFA, "SUB12_TUB_2OG_sofamove.01"))
    radius = {"window_radius": 30}
    write_json(radius | {"train": [], "valid": [0], "test": [1]}, tmp_path / f"set/splits/all/{SOFA}.json")
    write_json(radius | {"train": [4], "valid": [], "test": []}, tmp_path / f"set/splits/doors/{DOOR}.json")
    arguments = ["hcontact", f"source={tmp_path / 'set'}", f"output={tmp_path / 'out'}", "jobs=1", "fps=30"]
    assert run_verb("prepare", arguments) == 0, capsys.readouterr().err
    store = RecordingStore.open(tmp_path / "out")
    assert {name: store.entries[name].split for name in store.names()} == {
        DOOR: "test",
        SOFA: "test",
        "SUB12_TUB_2OG_sofamove.01": "train",
    }
    door, sofa = (store.load(name) for name in (DOOR, SOFA))
    assert door.motion is not None
    assert door.interactions is not None
    assert sofa.interactions is not None
    assert door.motion.fps == pytest.approx(30.0)
    assert (set(door.interactions.classes), set(sofa.interactions.classes)) == ({"hinged"}, {"sliding"})
    assert door.interactions.start_s.tolist() == [0.5, 0.5, 1.5]


def test_what_no_pattern_matches_is_refused(tmp_path):
    write_set(tmp_path / "set")
    (tmp_path / "list.csv").write_text("subject,split\n*,train\n")
    splits = Splits.read(tmp_path / "list.csv")
    with pytest.raises(WearcapError, match="no contact class for sequence"):
        hcontact_tasks(tmp_path / "set", splits, {"*sofa*": "sliding"}, 60, "")
    with pytest.raises(WearcapError, match="no sequences"):
        hcontact_tasks(tmp_path, splits, {"*": "sliding"}, 60, "")
