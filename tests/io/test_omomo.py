"""OMOMO's joblib files and meshes in their layout: root joint, scale and centre of the mesh; hostile files."""

import os

import joblib
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from one_object_files import CORNERS, OMOMO_NAME, SCALE, carried, obj_text, omomo_entry, standing_about, write_omomo

from data_prep.omomo import omomo_take, read_omomo
from hostile import fuzz, mutated_bytes
from wearcap.body.skeletons import smplx22
from wearcap.errors import WearcapError
from wearcap.io.formats.amass import PELVIS_SMPLX


def take_of(root, fps=30.0):
    return omomo_take(read_omomo(root)[0], root, fps)


def test_body_and_object_of_a_sequence(tmp_path):
    take, wanted = take_of(write_omomo(tmp_path)), standing_about(skeleton=smplx22())
    assert (take.name, take.subject, take.object_name, take.activity) == (
        OMOMO_NAME,
        "sub16",
        "largebox",
        "largebox_007",
    )
    assert take.motion.provenance["gender"] == "female"
    assert take.shape == {f"beta_{k}": 0.25 for k in range(16)}
    assert (take.motion.T_world_joint.t - wanted.T_world_joint.t).abs().max() < 1e-5
    path = carried(wanted)
    torch.testing.assert_close(take.path.t_world_body, path.t_world_body, atol=1e-5, rtol=0)
    torch.testing.assert_close(take.path.R_world_body, path.R_world_body, atol=1e-5, rtol=0)
    np.testing.assert_allclose(take.mesh.vertices, CORNERS - CORNERS.mean(0), atol=1e-6)


def test_the_mesh_is_placed_by_the_data_sets_own_rule(tmp_path):
    """scale · R · v + t."""
    entry, take = omomo_entry(), take_of(write_omomo(tmp_path))
    wanted = SCALE * np.einsum("tij,vj->tvi", entry["obj_rot"], CORNERS / SCALE) + entry["obj_trans"].transpose(0, 2, 1)
    posed = np.asarray(take.path.T_world_body[:, None] @ torch.from_numpy(take.mesh.vertices))
    np.testing.assert_allclose(posed, wanted, atol=1e-5)


def test_both_files_other_shapes_and_no_root_joint(tmp_path):
    entry = omomo_entry(name="sub2_largebox_001")
    entry |= {
        "pose_body": entry["pose_body"].reshape(-1, 21, 3),
        "obj_trans": entry["obj_trans"][:, :, 0],
        "gender": "male",
        "betas": entry["betas"][0],
    }
    trans = entry["trans"]
    del entry["trans2joint"]
    write_omomo(write_omomo(tmp_path), entry, split="train")
    assert [sequence.name for sequence in read_omomo(tmp_path)] == [OMOMO_NAME, "sub2_largebox_001"]
    take = omomo_take(read_omomo(tmp_path)[1], tmp_path, 30)
    np.testing.assert_allclose(take.motion.t_world_root.numpy(), trans + np.float32(PELVIS_SMPLX), atol=1e-5)
    assert take.motion.provenance["gender"] == "male"


def test_frames_without_an_objects_pose_are_gaps(tmp_path):
    entry = omomo_entry()
    entry["obj_scale"][40:50] = 0.0
    entry["obj_rot"][40:50] = 0.0
    take = take_of(write_omomo(tmp_path, entry))
    assert len(take.motion) == len(take.path) == 170
    assert take.motion.timestamps.diff()[39].item() == pytest.approx(11 / 30)


def test_an_object_of_two_parts_is_reported(tmp_path):
    write_omomo(tmp_path, omomo_entry(name="sub1_mop_000"))
    (tmp_path / "captured_objects" / "mop_cleaned_simplified.obj").write_text(obj_text())
    assert "two parts" in take_of(tmp_path).motion.provenance["object"]


FAULTS = {
    "no body": ({"pose_body": None}, "no array 'pose_body'"),
    "with hands": ({"pose_body": np.zeros((180, 153), np.float32)}, "array 'pose_body' has shape"),
    "lists": ({"trans": [[0.0, 0, 0]] * 180}, "no array 'trans'"),
    "NaN": ({"root_orient": np.full((180, 3), np.nan)}, "'root_orient' holds NaN"),
    "NaN object": ({"obj_trans": np.full((180, 3, 1), np.nan)}, "'obj_trans' holds NaN"),
    "shorter": (
        {key: omomo_entry()[key][:170] for key in ("obj_rot", "obj_trans", "obj_scale")},
        "the object has 170 frames, the body 180",
    ),
    "quaternions": ({"obj_rot": np.zeros((180, 4))}, "array 'obj_rot' has shape"),
    "no rotation": ({"obj_rot": np.ones((180, 3, 3))}, "obj_rot of frame 0 is no rotation .180 such"),
    "no scale": ({"obj_scale": np.zeros(180)}, "nowhere positive"),
    "grows": ({"obj_scale": np.linspace(0.5, 1.0, 180)}, "obj_scale runs from 0.5 to 1"),
    "root joint": ({"trans2joint": np.zeros(4)}, "'trans2joint' has shape"),
    "NaN betas": ({"betas": np.full((1, 16), np.nan)}, "'betas' holds NaN"),
    "no frames": (
        {
            key: omomo_entry()[key][:0]
            for key in ("trans", "root_orient", "pose_body", "obj_rot", "obj_trans", "obj_scale")
        },
        "at least one",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_sequence_that_cannot_be_is_refused(tmp_path, fault):
    changes, message = FAULTS[fault]
    entry = {key: value for key, value in (omomo_entry() | changes).items() if value is not None}
    write_omomo(tmp_path, entry)
    with pytest.raises(WearcapError, match=message) as raised:
        take_of(tmp_path)
    assert OMOMO_NAME in str(raised.value)


MESHES = {
    "millimetres": (obj_text(1000 / SCALE), "400 m long.*millimetres"),
    "a cloud": ("v 0 0 0\nv 0 0 1\n", "no faces"),
    "NaN": ("v 0 0 nan\n", "line 1: not a readable vertex"),
    "no vertices": ("# nothing\n", "no vertices"),
    "empty": ("", "empty"),
}


@pytest.mark.parametrize("fault", MESHES)
def test_a_mesh_that_cannot_be_is_refused(tmp_path, fault):
    mesh, message = MESHES[fault]
    write_omomo(tmp_path, mesh=mesh)
    with pytest.raises(WearcapError, match=message) as raised:
        take_of(tmp_path)
    assert "largebox_cleaned_simplified.obj" in str(raised.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(WearcapError, match="no sequences.*diffusion_manip_seq_joints24.p"):
        read_omomo(tmp_path)
    write_omomo(tmp_path)
    (tmp_path / "captured_objects" / "largebox_cleaned_simplified.obj").unlink()
    with pytest.raises(WearcapError, match="no mesh of largebox"):
        take_of(tmp_path)


class Evil:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (self.target,)


def test_nothing_in_a_file_runs(tmp_path):
    write_omomo(tmp_path, omomo_entry() | {"gender": Evil(str(tmp_path / "made"))})
    with pytest.raises(WearcapError, match="mkdir"):
        read_omomo(tmp_path)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([omomo_entry(seconds=0.1)], "it holds a list"),
        ({0: 3}, "sequence 0 is named None"),
        ({0: {"trans": np.zeros((3, 3))}}, "sequence 0 is named None"),
        ({0: {"seq_name": "walk"}}, "sequence 0 is named 'walk'"),
        ({0: {"seq_name": "../x_y_z"}}, "sequence 0 is named"),
        ({}, "files without sequences"),
    ],
)
def test_what_is_no_data_set_is_refused(tmp_path, content, message):
    joblib.dump(content, tmp_path / "test_diffusion_manip_seq_joints24.p")
    with pytest.raises(WearcapError, match=message):
        read_omomo(tmp_path)


@fuzz
@given(data=st.data())
def test_damaged_files_give_takes_or_one_clear_error(tmp_path_factory, data):
    root = tmp_path_factory.getbasetemp() / "omomo_fuzz"
    path = write_omomo(root, omomo_entry(seconds=0.1)) / "test_diffusion_manip_seq_joints24.p"
    path.write_bytes(data.draw(mutated_bytes(path.read_bytes())))
    try:
        take = omomo_take(read_omomo(root)[0], root, 30)
    except WearcapError:
        return
    assert take.path.t_world_body.isfinite().all()
    assert take.motion.R_parent_joint.isfinite().all()
