"""AMASS files in both layouts, written here as the data set has them; round trip; hostile files; fuzz."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hostile import fuzz, mutated_bytes
from wearcap.body.skeleton import xsens23
from wearcap.body.skeletons import smpl24, smplh52, smplx22
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.amass import PELVIS_SMPLH, read_amass, write_amass
from wearcap.recording import Motion

random = np.random.default_rng(5)


def smplh_file(frames: int = 5, **changes) -> dict:
    arrays = {
        "trans": random.normal(size=(frames, 3)),
        "gender": np.array("female"),
        "mocap_framerate": np.array(120.0),
        "betas": np.arange(16) / 10,
        "dmpls": np.zeros((frames, 8)),
        "poses": random.normal(0, 0.4, (frames, 156)),
    }
    return {key: value for key, value in (arrays | changes).items() if value is not None}


def stageii_file(frames: int = 5) -> dict:
    poses = random.normal(0, 0.4, (frames, 165))
    return {
        "gender": np.array(b"male"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(30.0),
        "mocap_time_length": np.array(0.2),
        "trans": random.normal(size=(frames, 3)),
        "poses": poses,
        "betas": np.zeros(16),
        "root_orient": poses[:, :3],
        "pose_body": poses[:, 3:66],
        "pose_hand": poses[:, 75:],
        "pose_jaw": poses[:, 66:69],
        "pose_eye": poses[:, 69:75],
        "labels_obs": np.array([{}], dtype=object),
    }


def test_smplh_file(tmp_path):
    (tmp_path / "S1").mkdir()
    arrays = smplh_file()
    np.savez(tmp_path / "S1" / "walk_poses.npz", **arrays)
    recording = read_amass(tmp_path / "S1" / "walk_poses.npz")
    motion = recording.motion
    assert motion.skeleton == smplh52()
    assert motion.fps == pytest.approx(120)
    assert (recording.name, recording.subject) == ("walk_poses", "S1")
    assert recording.shape["beta_3"] == pytest.approx(0.3)
    assert motion.provenance["gender"] == "female"
    np.testing.assert_allclose(motion.t_world_root.numpy(), arrays["trans"] + PELVIS_SMPLH, atol=1e-6)


def test_joint_frames_are_turned_from_smpls_to_ours(tmp_path):
    """A knee bent by SMPL's +x (its left axis) is bent by our +y; facing by SMPL's axes is facing by ours."""
    poses = np.zeros((1, 156))
    knee = 3 * smplh52().index("left_knee")
    poses[0, knee : knee + 3] = [0.7, 0, 0]
    upright = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # SMPL's y to the world's z, its z to x
    poses[0, :3] = upright.as_rotvec()
    np.savez(tmp_path / "a.npz", **smplh_file(1, poses=poses))
    motion = read_amass(tmp_path / "a.npz").motion
    torch.testing.assert_close(motion.R_parent_joint[0, 0], torch.eye(3), atol=1e-6, rtol=0)
    bent = rotation.about_axis("y", torch.tensor(0.7))
    torch.testing.assert_close(motion.R_parent_joint[0, motion.skeleton.index("left_knee")], bent, atol=1e-6, rtol=0)
    foot, knee_t = motion.joint("left_ankle").t[0], motion.joint("left_knee").t[0]
    assert foot[0] < knee_t[0] - 0.2  # the shin swings back


def test_stageii_file(tmp_path):
    arrays = stageii_file()
    np.savez(tmp_path / "a_stageii.npz", **arrays)
    motion = read_amass(tmp_path / "a_stageii.npz").motion
    assert motion.skeleton == smplx22()
    assert motion.fps == pytest.approx(30)
    assert motion.provenance["gender"] == "male"
    only_poses = {key: value for key, value in arrays.items() if key not in ("pose_body", "root_orient")}
    np.savez(tmp_path / "b_stageii.npz", **only_poses)
    assert torch.equal(read_amass(tmp_path / "b_stageii.npz").motion.R_parent_joint, motion.R_parent_joint)


@pytest.mark.parametrize("skeleton", [smplh52(), smplx22(), smpl24()], ids=lambda skeleton: skeleton.name)
def test_round_trip(tmp_path, skeleton):
    generator = torch.Generator().manual_seed(2)
    R = rotation.exp(torch.randn(7, len(skeleton), 3, generator=generator))
    motion = Motion(torch.arange(7, dtype=torch.float64) / 60, skeleton, R, torch.randn(7, 3, generator=generator))
    write_amass(motion, tmp_path / "a.npz", betas=torch.tensor([0.5, -0.5]))
    recording = read_amass(tmp_path / "a.npz")
    back = recording.motion
    names = [name for name in skeleton.joint_names if name in back.skeleton.joint_names]
    a, b = back.skeleton.indices(*names), skeleton.indices(*names)
    assert (back.T_world_joint.t[:, a] - motion.T_world_joint.t[:, b]).norm(dim=-1).max() < 1e-5
    torch.testing.assert_close(back.timestamps, motion.timestamps)
    assert recording.shape["beta_1"] == -0.5


def test_what_is_no_smpl_motion_is_refused(tmp_path):
    motion = Motion(torch.zeros(1, dtype=torch.float64), xsens23(), torch.eye(3).expand(1, 23, 3, 3), torch.zeros(1, 3))
    with pytest.raises(WearcapError, match="Retarget"):
        write_amass(motion, tmp_path / "a.npz")
    body = Motion(motion.timestamps, smplx22(), torch.eye(3).expand(1, 22, 3, 3), torch.zeros(1, 3))
    with pytest.raises(WearcapError, match="NaN"):
        write_amass(dataclasses.replace(body, t_world_root=torch.full((1, 3), float("nan"))), tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


LEVELS = {"x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "y": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
          "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "-x": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]}  # fmt: skip
"""Rows: a file's axes in the world with z up, by what is up in the file."""


def walker(up: str, whole: bool = True) -> tuple[dict, np.ndarray, np.ndarray]:
    """A walk over 3 m in a file with an up axis: its arrays, the pelvis' places and rotations in a world with z up.

    Not `whole`: `trans` alone was turned, without the template's pelvis.
    """
    s = np.linspace(0, 1, 60)
    to_file = Rotation.from_matrix(LEVELS[up]).inv()
    stands = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    R = Rotation.from_euler("z", 0.3 + s[:, None]) * stands
    pelvis = np.stack([3 * s, 0.2 * s - 1, 0.94 + 0.02 * np.sin(9 * s)], -1)
    poses = np.zeros((60, 156))
    poses[:, :3] = (to_file * R).as_rotvec()
    poses[:, [3, 6]] = np.stack([np.sin(9 * s), -np.sin(9 * s)], -1) * 0.4
    trans = to_file.apply(pelvis) - PELVIS_SMPLH if whole else to_file.apply(pelvis - np.array(PELVIS_SMPLH))
    return smplh_file(60, poses=poses, trans=trans), pelvis, (R * stands.inv()).as_matrix()


@pytest.mark.parametrize("whole", [True, False], ids=["turned", "trans turned alone"])
@pytest.mark.parametrize("up", LEVELS)
def test_the_axis_that_is_up_is_seen_and_turned(tmp_path, up, whole):
    arrays, pelvis, R = walker(up, whole)
    np.savez(tmp_path / "a.npz", **arrays)
    recording = read_amass(tmp_path / "a.npz")
    assert (f"Its {up} axis points up" in recording.note) == (up != "z")
    heading = Rotation.from_matrix(recording.motion.R_parent_joint[0, 0].double().numpy() @ R[0].T)
    assert np.abs(heading.as_rotvec()[:2]).max() < 1e-6  # a turn about the vertical
    t, R_pelvis = recording.motion.t_world_root.numpy(), recording.motion.R_parent_joint[:, 0].numpy()
    np.testing.assert_allclose(R_pelvis, heading.as_matrix() @ R, atol=1e-6)
    np.testing.assert_allclose(np.diff(t, axis=0), heading.apply(np.diff(pelvis, axis=0)), atol=1e-6)
    np.testing.assert_allclose(t[:, 2], pelvis[:, 2], atol=1e-5 if up in ("y", "z", "-y") else 0.035)
    stated = read_amass(tmp_path / "a.npz", up=up)
    assert torch.equal(stated.motion.t_world_root, recording.motion.t_world_root)
    assert stated.note == ""
    with pytest.raises(WearcapError, match="up=w"):
        read_amass(tmp_path / "a.npz", up="w")


@pytest.mark.parametrize("feet_at", [-0.9, 0.0, 2.0])
@pytest.mark.parametrize("crawls", [False, True])
def test_who_lies_or_crawls_throughout_keeps_z(tmp_path, feet_at, crawls):
    s = np.linspace(0, 1, 60)
    poses = np.zeros((60, 156))  # SMPL's own axes: the body along y, its front along z
    poses[:, :3] = [0, 0.1, 0] if not crawls else Rotation.from_euler("yx", [np.pi, -0.2]).as_rotvec()
    if crawls:
        poses[:, [3, 6]], poses[:, [12, 15]] = -1.3, 1.3
    y = feet_at + 0.9 + (0.6 * s if crawls else 0 * s)
    trans = np.stack([0 * s, y, (0.5 if crawls else 0.12) + 0 * s], -1) - PELVIS_SMPLH
    np.savez(tmp_path / "a.npz", **smplh_file(60, poses=poses, trans=trans))
    recording = read_amass(tmp_path / "a.npz")
    assert recording.note == ""
    np.testing.assert_allclose(recording.motion.t_world_root.numpy(), trans + PELVIS_SMPLH, atol=1e-6)


@pytest.mark.real
def test_a_walk_with_y_up(real_data):
    recording = read_amass(real_data / "field" / "E_amass_y_up.npz")
    arrays = np.load(real_data / "field" / "E_amass_y_up.npz")
    assert "y axis points up" in recording.note
    t = recording.motion.t_world_root.numpy()
    np.testing.assert_allclose(np.ptp(t[:, :2], axis=0).max(), np.ptp(arrays["trans"], axis=0).max(), atol=1e-4)
    assert t[:, 2] == pytest.approx(arrays["trans"][:, 1] + PELVIS_SMPLH[2], abs=1e-5)
    places = recording.motion.T_world_joint.t
    assert (places[:, recording.motion.skeleton.index("head"), 2] > 1.4).all()


CAMERAS = {
    "LLFF": {"poses": np.zeros((9, 3, 5)), "bds": np.zeros((9, 2))},
    "rows of 17": {"poses": np.zeros((9, 17))},
    "COLMAP": {"cameras": np.zeros((1, 4)), "points3D": np.zeros((50, 3))},
    "NeRF": {"images": np.zeros((2, 4, 4, 3)), "poses": np.zeros((2, 4, 4)), "focal": np.array(500.0)},
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_cameras_are_no_motion(tmp_path, kind):
    np.savez(tmp_path / "a.npz", **CAMERAS[kind])
    with pytest.raises(WearcapError, match="no trans, no frame rate.*SfM or NeRF") as caught:
        read_amass(tmp_path / "a.npz")
    assert all(name in str(caught.value) for name in CAMERAS[kind])


FAULTS = {
    "shape file": ({"poses": None, "trans": None}, "shape.npz"),
    "no translation": ({"trans": None}, "holds no trans"),
    "no rate": ({"mocap_framerate": None}, "frame rate"),
    "rate 0": ({"mocap_framerate": np.array(0.0)}, "frame rate of 0"),
    "rate nan": ({"mocap_framerate": np.array(np.nan)}, "frame rate of nan"),
    "rate text": ({"mocap_framerate": np.array("fast")}, "frame rate"),
    "wrong count": ({"trans": np.zeros((4, 3))}, r"time=4"),
    "missing columns": ({"poses": np.zeros((5, 72))}, "156"),
    "nan": ({"poses": np.full((5, 156), np.nan)}, "NaN"),
    "text": ({"poses": np.full((5, 156), "x")}, "real numbers"),
    "objects": ({"poses": np.array([[None] * 156] * 5, dtype=object)}, "Python objects"),
    "no frames": ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "no frames"),
    "nan shape": ({"betas": np.full(16, np.nan)}, "betas"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_file_is_named(tmp_path, fault):
    changes, message = FAULTS[fault]
    np.savez(tmp_path / "a.npz", **smplh_file(**changes))
    with pytest.raises(WearcapError, match=message) as caught:
        read_amass(tmp_path / "a.npz")
    assert "a.npz" in str(caught.value)


@fuzz
@given(data=st.data())
def test_fuzz_gives_a_motion_or_one_clear_error(tmp_path, data):
    np.savez(tmp_path / "a.npz", **smplh_file(1))
    (tmp_path / "a.npz").write_bytes(data.draw(mutated_bytes((tmp_path / "a.npz").read_bytes())))
    try:
        recording = read_amass(tmp_path / "a.npz")
    except WearcapError:
        return
    assert recording.motion.R_parent_joint.isfinite().all()
