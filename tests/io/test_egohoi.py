"""EgoHOI in exactly its layout: one object and several, hinges, annotated poses, contacts, the tracker's own output."""

import json
import math

import numpy as np
import pytest
import torch
from hoi_files import motion, moved, older, smpl_content, write_json, write_zip
from hypothesis import given

from data_prep.egohoi import egohoi_names, read_egohoi, read_egohoi_contacts, read_object_locations
from hostile import fuzz, mutated
from wearcap.cli.main import run_verb
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.contact_labels import LabelClock
from wearcap.io.formats.environment import read_environment
from wearcap.io.formats.ply import Ply, read_ply, write_ply
from wearcap.recording.store import RecordingStore

ONE, SEVERAL = "SUB1_MPI_BIB_EG_sofa.06", "SUB6_TUB_2OG_multiroom.03"
SOFA, DOOR, TABLE = "MPI_BIB_EG_sofa", "TUB_2OG_confdoor", "TUB_2OG_table"
CENTER = np.array([12.0, -7.0, 0.4])
HINGE = [11.5, -7.0, 0.4]
CORNERS = (CENTER + 0.5 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])).astype(np.float32)


def pose(time, angle_deg=0.0, about=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> dict:
    """A turn about the vertical through a point of the scan, then a shift: R·v + p."""
    half, about = math.radians(angle_deg) / 2, np.array(about)
    R = rotation.about_axis("z", torch.tensor(2 * half)).double().numpy()
    return {
        "time": time,
        "position": (about - R @ about + shift).tolist(),
        "quaternion": [math.cos(half), 0, 0, math.sin(half)],
    }


def locations(*poses, hinge=None) -> dict:
    return {"center": CENTER.tolist(), "locations": list(poses)} | ({} if hinge is None else {"hinge": hinge})


def contact(*rows) -> dict:
    return {
        "interactions": [
            {"start": start, "end": end, "parts": [f"{side}_hand" for side in sides]} for start, end, *sides in rows
        ]
    }


SLID = locations(pose(0.0), pose(1.8, 90.0, CENTER, (0.5, 0.25, 0.0)))
OPENED = locations(pose(1.9, 60.0, HINGE), pose(0.0), hinge=HINGE)


def write_set(root, frames=120):
    for name in (SOFA, DOOR, TABLE):
        write_ply(Ply(CORNERS), root / "object_models" / f"{name}.ply")
    write_json(older(motion(frames, hands=False, fps=frames / 2)), root / "smpl_motions" / f"{ONE}.json")
    write_json({"betas": [0.1, 0.2], "gender": "male"}, root / "smpl_shapes" / "SUB1.json")
    write_json(SLID, root / "object_locations" / f"{ONE}.json")
    write_json(contact((0.5, 1.0, "left", "right"), (1.0, 1.5, "right")), root / "gt_contacts" / f"{ONE}.json")
    write_zip(smpl_content(motion(frames, seed=1, fps=frames / 2)), root / "smpl_motions" / f"{SEVERAL}.json.zip")
    write_json(OPENED, root / "object_locations" / SEVERAL / f"{DOOR}.json")
    write_json(SLID, root / "object_locations" / SEVERAL / f"{TABLE}.json")
    write_json(contact((1.0, 1.5, "right"), (1.6, 1.7)), root / "gt_contacts" / SEVERAL / f"{DOOR}.json")
    write_json(contact((0.2, 0.8, "left", "right")), root / "gt_contacts" / SEVERAL / f"{TABLE}.json")
    return root


def posed(path) -> np.ndarray:
    """Corners by the data set's own rule, for each of a file's poses in order of time."""
    rows = sorted(json.loads(path.read_text())["locations"], key=lambda row: row["time"])
    R = rotation.matrix_from_quat_wxyz(torch.tensor([row["quaternion"] for row in rows], dtype=torch.float64)).numpy()
    return np.einsum("tij,vj->tvi", R, CORNERS.astype(np.float64)) + [[row["position"]] for row in rows]


def test_one_object_slides(tmp_path):
    write_set(tmp_path)
    assert egohoi_names(tmp_path) == [ONE, SEVERAL]
    recording, environment = read_egohoi(tmp_path, ONE)
    sofa = environment.by_name(SOFA)
    assert recording.motion is not None
    assert recording.interactions is not None
    assert moved(recording.motion, motion(hands=False)) < 1e-5
    assert (recording.subject, recording.location, recording.activity) == ("SUB1", "MPI_BIB_EG", "sofa")
    assert sofa.freedom.kind == "plane"
    assert sofa.category == "sofa"
    np.testing.assert_allclose(sofa.mesh.vertices, CORNERS - CENTER, atol=1e-6)
    np.testing.assert_allclose(sofa.t_world_object, CENTER, atol=1e-5)
    track = recording.object_motion[SOFA]
    assert track.timestamps.tolist() == [0.0, 1.8]
    np.testing.assert_allclose(track.t_world_body[1], CENTER + np.array([0.5, 0.25, 0.0]), atol=1e-5)
    where = np.asarray(track.T_world_body[:, None] @ torch.from_numpy(sofa.mesh.vertices))
    np.testing.assert_allclose(where, posed(tmp_path / "object_locations" / f"{ONE}.json"), atol=1e-5)
    assert recording.interactions.hands.tolist() == [[True, True], [False, True]]
    assert set(recording.interactions.objects) == {SOFA}
    assert set(recording.interactions.classes) == {"sliding"}


def test_several_objects_one_of_which_turns_about_its_hinge(tmp_path):
    recording, environment = read_egohoi(write_set(tmp_path), SEVERAL)
    door = environment.by_name(DOOR)
    assert recording.interactions is not None
    assert door.freedom.kind == "hinge"
    assert door.freedom.pivot == tuple(HINGE)
    assert recording.interactions.start_s.tolist() == [0.2, 1.0]
    assert recording.interactions.objects == (TABLE, DOOR)
    assert recording.interactions.classes == ("sliding", "hinged")
    turned = door.freedom.moved(door.T_world_object, torch.tensor(math.radians(60.0)))
    track = recording.object_motion[DOOR]
    torch.testing.assert_close(turned.R, track.R_world_body[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(turned.t, track.t_world_body[1], atol=1e-5, rtol=0)
    assert recording.shape == {"beta_0": 0.5, "beta_1": -1.0}


def test_motion_types_are_given_by_patterns(tmp_path):
    write_set(tmp_path)
    types = {"*door": "absent", "*": "free"}
    recording, environment = read_egohoi(tmp_path, SEVERAL, types)
    assert [item.name for item in environment.objects] == [TABLE]
    assert environment.by_name(TABLE).freedom.kind == "free"
    assert set(recording.object_motion) == {TABLE}
    with pytest.raises(WearcapError, match="motion type 'swing'.*along_floor"):
        read_egohoi(tmp_path, SEVERAL, {"*": "swing"})
    with pytest.raises(WearcapError, match=f"{TABLE} is to turn about a hinge and has none"):
        read_egohoi(tmp_path, SEVERAL, {"*": "hinge"})


def test_objects_stand_at_first_where_they_were_seen_last_before_the_start(tmp_path):
    write_set(tmp_path)
    path = tmp_path / "object_locations" / f"{ONE}.json"
    write_json(locations(pose(-9.0), pose(-1.0, shift=(2, 0, 0)), pose(1.0, shift=(3, 0, 0))), path)
    sofa = read_egohoi(tmp_path, ONE)[1].by_name(SOFA)
    np.testing.assert_allclose(sofa.t_world_object, CENTER + np.array([2, 0, 0]), atol=1e-5)
    write_json(locations(pose(1.0, shift=(3, 0, 0)), pose(1.5)), path)
    sofa = read_egohoi(tmp_path, ONE)[1].by_name(SOFA)
    np.testing.assert_allclose(sofa.t_world_object, CENTER + np.array([3, 0, 0]), atol=1e-5)


def test_names_of_objects(tmp_path):
    write_set(tmp_path)
    (tmp_path / "object_models" / f"{SOFA}.ply").rename(tmp_path / "object_models" / f"{SOFA}_left.ply")
    assert read_egohoi(tmp_path, ONE)[1].objects[0].name == f"{SOFA}_left"
    assert read_egohoi(tmp_path, ONE, object_name=TABLE)[1].objects[0].name == TABLE
    write_ply(Ply(CORNERS), tmp_path / "object_models" / f"{SOFA}_right.ply")
    with pytest.raises(WearcapError, match=f"2 models fit.*{SOFA}_left, {SOFA}_right"):
        read_egohoi(tmp_path, ONE)
    with pytest.raises(WearcapError, match="no model of chair"):
        read_egohoi(tmp_path, ONE, object_name="chair")
    with pytest.raises(WearcapError, match="no sequence 'SUB3'"):
        read_egohoi(tmp_path, "SUB3")
    (tmp_path / "object_locations" / f"{ONE}.json").unlink()
    with pytest.raises(WearcapError, match="no object locations of this sequence"):
        read_egohoi(tmp_path, ONE)


CLOCK = LabelClock.of(ONE, torch.arange(120, dtype=torch.float64) / 60)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (contact((1.0, 0.5, "left")), "interaction 0 ends before it starts: 1.0 to 0.5 s"),
        (contact((0.5, 0.5, "left")), "is empty"),
        (contact((0.5, 1.0, "left"), (0.9, 1.2, "left", "right")), "labels of left_hand overlap"),
        (contact((40.0, 41.0, "left")), "outside the recording.*another recording"),
        (
            {"interactions": [{"start": 0, "end": 1, "parts": [["left_hand"]]}]},
            "interaction 0 is with \\['left_hand'\\]",
        ),
        (contact((0.5, 1.0, "third")), "interaction 0 is with 'third_hand'.*left_hand or right_hand"),
        (contact((0.5, math.nan, "left")), "left_hand label 0 is"),
        (contact(("0.5", 1.0, "left")), "left_hand label 0 is"),
        ({"interactions": [{"start": 0.5, "end": 1.0}]}, "interaction 0 is"),
        ({"interactions": [{"start": 0.5, "parts": ["left_hand"]}]}, "left_hand label 0"),
        ({"interactions": [3]}, "interaction 0 is 3"),
        ({"contacts": {}}, "no contact labels"),
        ([], "no contact labels"),
    ],
)
def test_contacts_that_cannot_be_are_refused(tmp_path, content, message):
    write_json(content, tmp_path / "a.json")
    with pytest.raises(WearcapError, match=message) as raised:
        read_egohoi_contacts(tmp_path / "a.json", CLOCK, SOFA, "sliding")
    assert str(raised.value).startswith(str(tmp_path / "a.json"))


def test_a_hand_holds_one_object_at_a_time(tmp_path):
    write_set(tmp_path)
    write_json(contact((0.5, 1.2, "right")), tmp_path / "gt_contacts" / SEVERAL / f"{TABLE}.json")
    with pytest.raises(WearcapError, match="labels of right_hand overlap"):
        read_egohoi(tmp_path, SEVERAL)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (locations(), "no object locations"),
        ({"locations": [pose(0.0)]}, "no object locations.*center"),
        (locations(pose(0.0), pose(0.0)), "timestamp"),
        (locations(pose(0.0) | {"quaternion": [1, 1, 0, 0]}), "norm 1.41"),
        (locations(pose(0.0) | {"quaternion": [1, 0, 0]}), "no object locations"),
        (locations(pose(0.0) | {"position": [math.nan, 0, 0]}), "translation is NaN"),
        (locations(pose(0.0) | {"time": None}), "timestamp is NaN"),
        (locations(pose(0.0), pose(1.0) | {"time": None}), "no object locations"),
        (locations(pose(0.0), {"time": 1.0}), "no object locations"),
        (locations(pose(0.0), hinge=[0, 0]), "center or hinge is no point"),
        (locations(pose(0.0), hinge=[0, 0, math.inf]), "center or hinge is no point"),
        ([pose(0.0)], "no object locations"),
    ],
)
def test_locations_that_cannot_be_are_refused(tmp_path, content, message):
    write_json(content, tmp_path / "a.json")
    with pytest.raises(WearcapError, match=message):
        read_object_locations(tmp_path / "a.json")


@fuzz
@given(text=mutated(json.dumps(OPENED)))
def test_damaged_locations_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "locations.json"
    path.write_text(text, encoding="utf-8")
    try:
        read = read_object_locations(path)
    except WearcapError:
        return
    assert read.trajectory.t_world_body.isfinite().all()


def test_the_command_makes_a_data_set_with_environments(tmp_path, capsys):
    write_set(tmp_path / "set")
    arguments = [
        "egohoi",
        f"source={tmp_path / 'set'}",
        f"output={tmp_path / 'out'}",
        "jobs=1",
        f"+motion_types.{TABLE}=free",
    ]
    assert run_verb("prepare", arguments) == 0, capsys.readouterr().err
    store = RecordingStore.open(tmp_path / "out")
    assert store.names("test") == [ONE, SEVERAL]
    recording = store.load(SEVERAL)
    assert recording.environment is not None
    assert recording.motion is not None
    assert recording.motion.fps == pytest.approx(30.0)
    environment = read_environment(store.root / recording.environment)
    assert [(item.name, item.freedom.kind) for item in environment.objects] == [(DOOR, "hinge"), (TABLE, "free")]
    assert set(recording.object_motion) == {DOOR, TABLE}
    model = read_ply(store.root / "scenes" / SEVERAL / "objects" / f"{DOOR}.ply")
    np.testing.assert_allclose(model.points, CORNERS - CENTER, atol=1e-6)
