"""SMPL-family files of the tests' own making: read, shaped, posed by the model's formula, refused when broken."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeletons import skeleton_by_name
from wearcap.body.smpl_body import betas_of, smpl_body, template_pelvis
from wearcap.cli.capture import _on_smpl
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.amass import write_amass
from wearcap.io.formats.gltf import write_glb
from wearcap.io.formats.smpl import read_smpl
from wearcap.recording import Recording
from wearcap_testing import swaying_motion

AXES = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # model → world


def model_file(path, name="smpl24", extra=()):
    """A file in SMPL's layout whose person is the default body."""
    body = anny_body(skeleton_by_name(name))
    joints, count = len(body.skeleton), len(body.rest_vertices)
    rest = (body.rest_vertices.double().numpy() + np.array([0.1, 0.2, 0.3])) @ AXES
    weights = np.zeros((count, joints + len(extra)))
    np.put_along_axis(weights[:, :joints], body.skin_joints.numpy(), body.skin_weights.numpy(), 1)
    target = (body.skeleton.rest_joints.double().numpy() + np.array([0.1, 0.2, 0.3])) @ AXES
    target = np.concatenate([target, target[list(extra)]]) if extra else target
    regressor = target @ np.linalg.pinv(rest)  # any matrix that gives these joints will do
    rng = np.random.default_rng(0)
    parents = [*body.skeleton.parents, *extra]
    arrays = {
        "v_template": rest,
        "shapedirs": 0.01 * rng.standard_normal((count, 3, 4)),
        "posedirs": 0.01 * rng.standard_normal((count, 3, 9 * (len(parents) - 1))),
        "J_regressor": regressor,
        "weights": weights,
        "f": body.faces.numpy().astype(np.uint32),
        "kintree_table": np.stack([np.array(parents).astype(np.uint32), np.arange(len(parents))]),
    }
    np.savez(path, **arrays)
    return arrays


def plain_smpl(arrays, betas, R_parent_joint):
    """SMPL's formula, written out joint by joint in the file's axes; root at its rest place."""
    shaped = arrays["v_template"] + arrays["shapedirs"][..., : len(betas)] @ betas
    joints = arrays["J_regressor"] @ shaped
    posed = shaped + arrays["posedirs"] @ (R_parent_joint[1:] - np.eye(3)).ravel()
    parents = arrays["kintree_table"][0].astype(np.int32)
    world, place = [R_parent_joint[0]], [joints[0]]
    for joint in range(1, len(joints)):
        parent = parents[joint]
        place.append(place[parent] + world[parent] @ (joints[joint] - joints[parent]))
        world.append(world[parent] @ R_parent_joint[joint])
    moved = np.stack([(posed - joints[j]) @ world[j].T + place[j] for j in range(len(joints))], 1)
    return (arrays["weights"][..., None] * moved).sum(1) - joints[0]


@pytest.mark.parametrize("name", ["smpl24", "smplh52"])
def test_vertices_follow_smpls_formula(tmp_path, name):
    arrays = model_file(tmp_path / "model.npz", name)
    betas = np.array([0.5, -1.0, 0.3])
    body = smpl_body(read_smpl(tmp_path / "model.npz"), torch.from_numpy(betas).float())
    assert body.skeleton.name == name
    torch.manual_seed(0)
    R = rotation.exp(0.3 * torch.randn(len(body.skeleton), 3, dtype=torch.float64))
    model_R = AXES.T @ R.numpy() @ AXES
    wanted = plain_smpl(arrays, betas, model_R) @ AXES.T
    T = forward_kinematics(body.skeleton, R.float(), torch.zeros(3))
    np.testing.assert_allclose(body.vertices(T).numpy(), wanted, atol=2e-5)
    some = body.regions["left_sole"]
    torch.testing.assert_close(body.vertices(T, "left_sole"), body.vertices(T)[some])


def test_smplx_hangs_face_and_hands_on_the_body(tmp_path):
    extra = (15, 15, 15, *([20] * 15), *([21] * 15))
    model_file(tmp_path / "model.npz", "smplx22", extra)
    body = smpl_body(read_smpl(tmp_path / "model.npz"))
    assert body.skeleton.name == "smplx22"
    assert body.skin_joints.max() < 22
    T = Rigid(torch.eye(3).expand(22, 3, 3), body.skeleton.rest_joints)
    torch.testing.assert_close(body.vertices(T), body.rest_vertices, atol=1e-5, rtol=0)
    assert body.vertices(T)[:, 2].min() == pytest.approx(-body.skeleton.root_height, abs=5e-3)


def test_broken_files_are_named(tmp_path):
    arrays = model_file(tmp_path / "model.npz")
    for name, broken, message in (
        ("weights", arrays["weights"][:-1], "weights"),
        ("v_template", arrays["v_template"] * np.nan, "v_template"),
        ("f", arrays["f"] + 10**6, "beyond the last"),
        ("posedirs", arrays["posedirs"][..., 1:], "posedirs"),
    ):
        np.savez(tmp_path / "broken.npz", **(arrays | {name: broken}))
        with pytest.raises(WearcapError, match=f"broken.npz.*{message}"):
            read_smpl(tmp_path / "broken.npz")
    np.savez(tmp_path / "broken.npz", **{k: v for k, v in arrays.items() if k != "shapedirs"})
    with pytest.raises(WearcapError, match="no array 'shapedirs'"):
        read_smpl(tmp_path / "broken.npz")
    (tmp_path / "model.pkl").write_bytes(b"\x80\x04cchumpy.ch\nCh\n.")
    with pytest.raises(WearcapError, match="clean_ch"):
        read_smpl(tmp_path / "model.pkl")
    with pytest.raises(WearcapError, match="at most this file's 4"):
        smpl_body(read_smpl(tmp_path / "model.npz"), torch.zeros(10))


def test_a_capture_is_shown_with_the_users_own_body(tmp_path):
    """`wearcap capture body=MODEL.npz`: the motion moves to the model's joints, and the .glb shows its surface."""
    model_file(tmp_path / "model.npz", "smplh52")
    motion = swaying_motion(4)
    recording = Recording("r", motion=motion, shape={"beta_0": 0.5, "height": 1.7})
    shown, body, betas, _ = _on_smpl(motion, recording, str(tmp_path / "model.npz"))
    assert betas.tolist() == [0.5]
    assert shown.skeleton.name == "smplh52"
    write_glb(shown, tmp_path / "motion.glb", body=body)
    assert (tmp_path / "motion.glb").stat().st_size > 36 * len(body.rest_vertices)
    before, after = (m.joint("head").t for m in (motion, shown))
    assert (before - after).norm(dim=-1).max() < 0.3


def test_bones_tell_the_shape_and_the_file_places_the_body(tmp_path):
    """A wearer with the bones of a shape gets bones of these lengths, and AMASS' translation is that of the same shape."""
    model_file(tmp_path / "model.npz", "smplh52")
    arrays = read_smpl(tmp_path / "model.npz")
    tall, wide = 0.06 * arrays.template, 0.04 * arrays.template * torch.tensor([1.0, 0.0, 0.0])
    arrays = replace(arrays, shape_directions=torch.stack([tall, wide], -1))
    true = torch.tensor([1.2, -0.8])
    wearer = smpl_body(arrays, true).skeleton
    found = smpl_body(arrays, betas_of(arrays, wearer)).skeleton
    lengths = [each.t_parent_joint[1:].norm(dim=-1) for each in (wearer, found, smpl_body(arrays).skeleton)]
    assert (lengths[1] - lengths[0]).abs().mean() < 0.1 * (lengths[2] - lengths[0]).abs().mean()
    motion = swaying_motion(5, skeleton=wearer)
    pelvis = template_pelvis(arrays, true)
    write_amass(motion, tmp_path / "out.npz", true, pelvis.tolist())
    written = np.load(tmp_path / "out.npz")
    np.testing.assert_allclose(written["betas"][:2], true.numpy(), atol=1e-6)
    np.testing.assert_allclose(written["trans"], motion.t_world_root.numpy() - pelvis.numpy(), atol=1e-5)
