"""BEHAVE's 30 fps release in its layout: axes, times, the mesh's centre; hostile files."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from one_object_files import BEHAVE_NAME, CORNERS, behave_arrays, carried, frame_times, standing_about, write_behave

from boxes import BOX_FACES
from data_prep.behave import R_WORLD_CAMERA, behave_names, read_behave, read_behave_mesh
from hostile import fuzz, mutated_bytes
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.ply import Ply


def test_body_and_object_of_a_sequence(tmp_path):
    write_behave(tmp_path)
    assert behave_names(tmp_path) == [BEHAVE_NAME]
    take, wanted = read_behave(tmp_path, BEHAVE_NAME), standing_about()
    assert (take.subject, take.location, take.activity) == ("Sub04", "Date03", "boxlarge_hand")
    assert take.object_name == "boxlarge"
    assert take.motion.skeleton.name == "smplh52"
    assert take.motion.provenance["gender"] == "male"
    assert take.shape["beta_3"] == pytest.approx(0.3)
    torch.testing.assert_close(take.motion.timestamps, wanted.timestamps + 3.0)
    assert (take.motion.T_world_joint.t - wanted.T_world_joint.t).abs().max() < 1e-5
    path = carried(wanted)
    torch.testing.assert_close(take.path.t_world_body, path.t_world_body, atol=1e-5, rtol=0)
    torch.testing.assert_close(take.path.R_world_body, path.R_world_body, atol=1e-5, rtol=0)


def test_a_person_before_a_camera_whose_y_points_down_is_upright(tmp_path):
    """SMPL's y is up and its z forward: half a turn about x makes it upright for the camera, and facing it."""
    poses = np.zeros((180, 156))
    poses[:, 0] = np.pi
    write_behave(tmp_path, body={"poses": poses, "trans": np.tile([0.0, 0.5, 3.0], (180, 1))})
    motion = read_behave(tmp_path, BEHAVE_NAME).motion
    up = motion.joint("head").t - motion.joint("pelvis").t
    assert (up[:, 2] > 0.4).all()
    assert (motion.R_parent_joint[:, 0, 0, 0] < -0.99).all()  # forward is towards the camera: -x
    assert motion.t_world_root[0, 0] == pytest.approx(3.0, abs=0.05)


def test_the_mesh_is_placed_by_the_data_sets_own_rule(tmp_path):
    """R (v - mean) + t in the camera's frame."""
    write_behave(tmp_path)
    take, (_, handled) = read_behave(tmp_path, BEHAVE_NAME), behave_arrays()
    R = rotation.exp(torch.from_numpy(handled["angles"]))
    in_camera = np.einsum("tij,vj->tvi", R.numpy(), CORNERS - CORNERS.mean(0)) + handled["trans"][:, None]
    wanted = in_camera @ R_WORLD_CAMERA.numpy().T
    posed = np.asarray(take.path.T_world_body[:, None] @ torch.from_numpy(take.mesh.vertices))
    np.testing.assert_allclose(posed, wanted, atol=1e-5)


def test_the_registered_meshes(tmp_path):
    of_object = {"boxlarge": "f1000", "monitor": "closed_f1000", "chairwood": "f2500", "tablesquare": "f2000"}
    for name, ending in of_object.items():
        with pytest.raises(WearcapError, match=rf"{name}_{ending}\.ply: no mesh"):
            read_behave_mesh(tmp_path, name)


def test_the_other_folder_and_betas_for_all_frames(tmp_path):
    write_behave(tmp_path, body={"betas": np.arange(10.0), "frame_times": None})
    (tmp_path / "sequences").rename(tmp_path / "behave-30fps-params-v1")
    assert read_behave(tmp_path, BEHAVE_NAME).shape["beta_9"] == 9.0


def test_frames_that_were_not_fitted_are_gaps(tmp_path):
    kept = np.r_[0:40, 43:180]
    body, handled = behave_arrays()
    cut = [{key: value[kept] for key, value in arrays.items() if value.ndim} for arrays in (body, handled)]
    write_behave(tmp_path, body=cut[0], handled=cut[1])
    times = read_behave(tmp_path, BEHAVE_NAME).motion.timestamps
    assert times.diff()[39].item() == pytest.approx(4 / 30)


BODY = {
    "72 columns": ({"poses": np.zeros((180, 72))}, "array 'poses' has shape .180, 72.*156"),
    "no poses": ({"poses": None}, "no array 'poses'"),
    "no translation": ({"trans": None}, "no array 'trans'"),
    "NaN": ({"poses": np.full((180, 156), np.nan)}, "'poses' holds NaN"),
    "infinite": ({"trans": np.full((180, 3), np.inf)}, "'trans' holds NaN or infinity"),
    "half": ({"trans": np.zeros((90, 3))}, "array 'trans' has shape"),
    "NaN betas": ({"betas": np.full((180, 10), np.nan)}, "'betas' holds NaN"),
    "other times": ({"frame_times": frame_times(181)[1:]}, "body's frame 0 is of 3.033 s, the object's of 3.000 s"),
}
THING = {
    "shorter": (
        {"angles": np.zeros((179, 3)), "trans": np.zeros((179, 3)), "frame_times": frame_times(179)},
        "the object has 179 frames, the body 180",
    ),
    "quaternions": ({"angles": np.zeros((180, 4))}, "array 'angles' has shape"),
    "NaN": ({"trans": np.full((180, 3), np.nan)}, "object_fit_all.npz: array 'trans' holds NaN"),
    "no times": ({"frame_times": None}, "frame_times is missing"),
    "numbers": ({"frame_times": np.arange(180.0)}, "frame_times is float64"),
    "words": ({"frame_times": np.array(["then"] * 180)}, "frame_times cannot be read"),
    "NaN times": ({"frame_times": np.array(["tnan"] * 180)}, "frame_times holds NaN"),
    "a frame per second": (
        {"frame_times": frame_times(180, 1.0)},
        "frames come at 1 per second. Expected 30 per second",
    ),
    "60 Hz": ({"frame_times": frame_times(180, 1 / 60)}, "per second. Expected 30"),
    "backwards": ({"frame_times": np.r_[frame_times(180)[:90], frame_times(180)[80:170]]}, "timestamp"),
    "objects": ({"angles": np.array([None] * 180, dtype=object)}, "Python objects"),
}


@pytest.mark.parametrize("fault", BODY)
def test_a_body_that_cannot_be_is_refused(tmp_path, fault):
    changes, message = BODY[fault]
    write_behave(tmp_path, body=changes)
    with pytest.raises(WearcapError, match=message) as raised:
        read_behave(tmp_path, BEHAVE_NAME)
    assert BEHAVE_NAME in str(raised.value)


@pytest.mark.parametrize("fault", THING)
def test_an_objects_path_that_cannot_be_is_refused(tmp_path, fault):
    changes, message = THING[fault]
    write_behave(tmp_path, body={"frame_times": None}, handled=changes)
    with pytest.raises(WearcapError, match=message) as raised:
        read_behave(tmp_path, BEHAVE_NAME)
    assert BEHAVE_NAME in str(raised.value)


MESHES = {
    "millimetres": (
        Ply(CORNERS * 1000, None, BOX_FACES),
        "400 m long. Expected 0.01 to 5 m. It looks like millimetres",
    ),
    "kilometres": (Ply(CORNERS / 1000, None, BOX_FACES), "0.0004 m long"),
    "a cloud": (Ply(CORNERS), "no faces"),
    "empty": (Ply(CORNERS[:0]), "no vertices"),
    "NaN": (Ply(np.where(CORNERS == 0, np.nan, CORNERS).astype(np.float32), None, BOX_FACES), "NaN or infinite"),
}


@pytest.mark.parametrize("fault", MESHES)
def test_a_mesh_that_cannot_be_is_refused(tmp_path, fault):
    ply, message = MESHES[fault]
    write_behave(tmp_path, ply=ply)
    with pytest.raises(WearcapError, match=message) as raised:
        read_behave(tmp_path, BEHAVE_NAME)
    assert "boxlarge_f1000.ply" in str(raised.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(WearcapError, match="no sequences.*smpl_fit_all.npz"):
        behave_names(tmp_path)
    write_behave(tmp_path)
    with pytest.raises(WearcapError, match="no sequence 'Date09_x'"):
        read_behave(tmp_path, "Date09_x")
    folder = tmp_path / "sequences" / BEHAVE_NAME
    (tmp_path / "objects/boxlarge/boxlarge_f1000.ply").rename(tmp_path / "mesh.ply")
    with pytest.raises(WearcapError, match="boxlarge_f1000.ply: no mesh of boxlarge"):
        read_behave(tmp_path, BEHAVE_NAME)
    for content in ({}, {"cat": 3}, {"cat": "../../box"}, []):
        (folder / "info.json").write_text(json.dumps(content))
        with pytest.raises(WearcapError, match="info.json: does not name the object"):
            read_behave(tmp_path, BEHAVE_NAME)
    for file in ("info.json", "object_fit_all.npz"):
        (folder / file).unlink()
        with pytest.raises(WearcapError, match=file):
            read_behave(tmp_path, BEHAVE_NAME)
    (folder / "smpl_fit_all.npz").write_bytes((folder / "smpl_fit_all.npz").read_bytes()[:-400])
    with pytest.raises(WearcapError, match="smpl_fit_all.npz.*not a readable .npz"):
        read_behave(tmp_path, BEHAVE_NAME)
    write_behave(tmp_path, name="odd")
    with pytest.raises(WearcapError, match="not named as BEHAVE's"):
        read_behave(tmp_path, "odd")


@fuzz
@given(data=st.data(), file=st.sampled_from(["smpl_fit_all.npz", "object_fit_all.npz"]))
def test_damaged_files_give_a_take_or_one_clear_error(tmp_path_factory, data, file):
    root = tmp_path_factory.getbasetemp() / "behave_fuzz"
    few = slice(0, 3)
    body, handled = ({key: v[few] if v.ndim else v for key, v in part.items()} for part in behave_arrays(seconds=0.2))
    write_behave(root, body=body, handled=handled)
    path = root / "sequences" / BEHAVE_NAME / file
    path.write_bytes(data.draw(mutated_bytes(path.read_bytes())))
    try:
        take = read_behave(root, BEHAVE_NAME)
    except WearcapError:
        return
    assert take.path.t_world_body.isfinite().all()
    assert take.motion.R_parent_joint.isfinite().all()
