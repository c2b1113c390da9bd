"""Fingers: planted angles come back within their limits, gaps are bridged, and every writer has them."""

import json
import struct

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import planted_hands as planted
from own_bvh import read_bvh
from wearcap.apps.live.sinks.vmc import BONES, FINGER_BONES, bones_of
from wearcap.body.hands import CHAINS, FINGER_NAMES, HAND_JOINTS, LIMITS, REST, finger_joints, has_fingers
from wearcap.body.skeleton import SIDES, xsens23
from wearcap.body.skeletons import FINGER_JOINTS, smplh52
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.gltf import write_glb
from wearcap.io.formats.motion_npz import read_motion, write_motion
from wearcap.io.saving import write_smplh
from wearcap.recording import FingerStream, Motion
from wearcap.tracking.fingers import SHORT_S, bridged, fit_hand, with_fingers

LOW, HIGH = LIMITS.unbind(-1)


def body(frames: int, fps: float = 60.0, skeleton=None) -> Motion:
    """A body whose arms turn, so that wrists have other axes than the world."""
    skeleton = skeleton or xsens23()
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    turns = torch.from_numpy(Rotation.random(4, random_state=3).as_matrix()).float()
    R[:, skeleton.indices("left_shoulder", "right_shoulder", "left_wrist", "right_wrist")] = turns
    return Motion(
        torch.arange(frames, dtype=torch.float64) / fps, skeleton, R, torch.tensor([[0.0, 0, 1]]).repeat(frames, 1)
    )


def both(frames: int, noise_m: float = 0.0) -> tuple[dict[str, np.ndarray], dict[str, FingerStream]]:
    angles = {side: planted.moving(frames, seed) for seed, side in enumerate(SIDES)}
    rng = np.random.default_rng(5)
    places = {side: planted.carried(planted.joints(each, side)) for side, each in angles.items()}
    return angles, {side: planted.stream(each + noise_m * rng.normal(size=each.shape)) for side, each in places.items()}


def in_wrist(motion: Motion, side: str) -> np.ndarray:
    """Joints and tips of a motion's fingers in the wrist's axes, "time finger 4 3"."""
    T, skeleton = motion.T_world_joint, motion.skeleton
    wrist = T[:, skeleton.index(f"{side}_wrist")]
    rows = []
    for finger in FINGER_NAMES:
        index = skeleton.indices(*finger_joints(side, finger))
        tip = T.t[:, index[2]] + T.R[:, index[2]] @ torch.tensor(skeleton.sites[f"{side}_{finger}_tip"].t_joint_site)
        rows.append(torch.cat([T.t[:, index], tip[:, None]], 1))
    return ((torch.stack(rows, 1) - wrist.t[:, None, None]) @ wrist.R[:, None]).numpy()


def test_planted_angles_and_places_come_back():
    angles, hands = both(240)
    motion = with_fingers(body(240), hands)
    for side in SIDES:
        fitted = fit_hand(hands[side], side)
        assert fitted.measured.all()
        assert np.degrees(np.abs(fitted.angles.numpy() - angles[side])).max() < 1.0
        expected = planted.joints(angles[side], side)[:, np.array(CHAINS)]
        assert np.linalg.norm(in_wrist(motion, side) - expected, axis=-1).max() < 1e-3
    assert motion.fingers_measured.eq(1).all()


def test_noise_stays_small():
    angles, hands = both(240, 3e-4)
    motion = with_fingers(body(240), hands)
    for side in SIDES:
        off = np.linalg.norm(in_wrist(motion, side) - planted.joints(angles[side], side)[:, np.array(CHAINS)], axis=-1)
        assert off.mean() < 6e-4
        assert np.degrees(np.median(np.abs(fit_hand(hands[side], side).angles.numpy() - angles[side]))) < 1.0


def test_hands_mirror_each_other():
    places = planted.carried(planted.joints(planted.moving(60), "left"))
    left = fit_hand(planted.stream(places), "left")
    right = fit_hand(planted.stream(places * [1, -1, 1]), "right")
    torch.testing.assert_close(left.angles, right.angles, atol=1e-5, rtol=0)
    torch.testing.assert_close(left.shape.bones, right.shape.bones, atol=1e-7, rtol=0)


def test_a_hand_of_another_size_keeps_its_bones():
    fitted = fit_hand(planted.stream(planted.carried(planted.joints(planted.moving(60), "left", 1.3))), "left")
    default = fit_hand(planted.stream(planted.joints(planted.moving(60), "left")), "left")
    torch.testing.assert_close(fitted.shape.bones, 1.3 * default.shape.bones, atol=1e-5, rtol=0)
    torch.testing.assert_close(fitted.angles, default.angles, atol=1e-3, rtol=0)


def hostile(kind: str) -> np.ndarray:
    places = planted.carried(planted.joints(np.repeat(planted.FIST[None], 40, 0), "left"))
    rng = np.random.default_rng(0)
    match kind:
        case "nan":
            places[:] = np.nan
        case "infinite":
            places[:, 3:] = np.inf
        case "one point":
            places[:] = places[:, :1]
        case "a line":
            places = places[:, :1] + np.arange(len(HAND_JOINTS))[None, :, None] * [0.0, 0.01, 0.0]
        case "the other hand":
            places = places * [1, -1, 1]
        case "swapped fingers":
            places = places[:, rng.permutation(len(HAND_JOINTS))]
        case "centimetres":
            places = 100 * places
        case "noise":
            places = rng.normal(scale=0.05, size=places.shape)
    return places


@pytest.mark.parametrize(
    "kind", ["nan", "infinite", "one point", "a line", "the other hand", "swapped fingers", "centimetres", "noise"]
)
def test_what_is_no_such_hand_is_not_measured_and_keeps_the_limits(kind):
    stream = planted.stream(hostile(kind))
    fitted = fit_hand(stream, "left")
    assert fitted.measured.double().mean() < 0.1
    assert ((fitted.angles >= LOW - 1e-9) & (fitted.angles <= HIGH + 1e-9)).all()
    motion = with_fingers(body(20), {"left": stream})
    assert has_fingers(motion.skeleton)
    assert motion.R_parent_joint.isfinite().all()
    assert motion.skeleton.t_parent_joint.isfinite().all()


def test_gaps_are_bridged_and_not_measured():
    """A gap of a third of a second is interpolated; in a longer one the hand relaxes within a quarter of a second."""
    stream = planted.stream(planted.carried(planted.joints(np.repeat(planted.FIST[None], 300, 0), "left")))
    stream.valid[60:78] = stream.valid[120:240] = False
    fitted = fit_hand(stream, "left")
    angles, measured = bridged(fitted, stream.timestamps)
    assert torch.equal(measured.bool(), stream.valid)
    bend = angles[:, 1, 3].rad2deg()
    assert bend[60:78] == pytest.approx(100, abs=0.5)
    rest = REST[1, 3].rad2deg().item()
    assert bend[119 + 15 : 240 - 15] == pytest.approx(rest, abs=0.1)
    assert bend.diff().abs().max() < 12
    assert ((angles >= LOW) & (angles <= HIGH)).all()
    late, none = bridged(fitted, torch.tensor([5.2, 9.0], dtype=torch.float64))
    assert late[1] == pytest.approx(REST, abs=1e-6)
    assert none.eq(0).all()
    assert SHORT_S >= 0.5


def test_an_untracked_hand_rests_beside_a_tracked_one():
    _, hands = both(60)
    motion = with_fingers(body(60), {"right": hands["right"]})
    left = [motion.skeleton.index(name) for name in FINGER_JOINTS if name.startswith("left")]
    assert motion.fingers_measured.mean(0).tolist() == [0.0, 1.0]
    assert motion.R_parent_joint[:, left].diff(dim=0).abs().max() == 0
    turned = Rotation.from_matrix(motion.R_parent_joint[0, motion.skeleton.index("left_index2")].numpy()).as_rotvec()
    assert np.degrees(turned) == pytest.approx([-np.degrees(REST[1, 3].item()), 0, 0], abs=1e-3)
    assert with_fingers(body(5), {}).skeleton == xsens23()


@pytest.fixture(scope="module")
def posed() -> Motion:
    return with_fingers(body(60), both(60)[1])


def test_motion_npz_keeps_fingers_and_what_is_measured(posed, tmp_path):
    write_motion(posed, tmp_path / "m.npz")
    back = read_motion(tmp_path / "m.npz")
    assert back.skeleton == posed.skeleton
    assert torch.equal(back.R_parent_joint, posed.R_parent_joint)
    assert torch.equal(back.fingers_measured, posed.fingers_measured)
    assert posed.sliced(3, 9).fingers_measured.shape == (6, 2)


def test_smplh_has_the_same_finger_rotations(posed, tmp_path):
    write_smplh(posed, tmp_path / "m_smplh.npz")
    poses = np.load(tmp_path / "m_smplh.npz")["poses"].reshape(60, 52, 3)
    A = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for name in ("left_index1", "right_thumb1", "right_pinky3"):
        R = A @ Rotation.from_rotvec(poses[:, smplh52().index(name)]).as_matrix() @ A.T
        assert np.abs(R - posed.R_parent_joint[:, posed.skeleton.index(name)].numpy()).max() < 1e-4


def test_glb_animates_a_node_for_each_finger_joint(posed, tmp_path):
    write_glb(posed, tmp_path / "m.glb")
    content = (tmp_path / "m.glb").read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    node = next(k for k, each in enumerate(document["nodes"]) if each["name"] == "left_index2")
    (channel,) = [each for each in document["animations"][0]["channels"] if each["target"]["node"] == node]
    accessor = document["accessors"][document["animations"][0]["samplers"][channel["sampler"]]["output"]]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    xyzw = np.frombuffer(binary, np.float32, 4 * accessor["count"], start).reshape(-1, 4)
    R = posed.R_parent_joint[:, posed.skeleton.index("left_index2")].numpy()
    assert np.abs(Rotation.from_quat(xyzw).as_matrix() - R).max() < 1e-5


def test_bvh_reads_back_with_fingers(posed, tmp_path):
    write_bvh(posed, tmp_path / "m.bvh")
    text = (tmp_path / "m.bvh").read_text()
    assert all(f"JOINT {name}" in text for name in FINGER_JOINTS)
    back = read_bvh(tmp_path / "m.bvh")
    for name in ("left_index3", "right_thumb2"):
        off = back.joint(name).t - back.joint("pelvis").t - posed.joint(name).t + posed.joint("pelvis").t
        assert off.norm(dim=-1).max() < 1e-3


def test_vmc_sends_unitys_finger_bones(posed):
    t, xyzw = bones_of(posed)
    names = [*BONES, *FINGER_BONES]
    assert t.shape == (60, len(names), 3)
    assert {"LeftThumbProximal", "LeftIndexIntermediate", "RightLittleDistal"} <= set(names)
    k, joint = names.index("LeftIndexIntermediate"), posed.skeleton.index("left_index2")
    unity = np.array([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])  # x right, y up, z forward
    R = unity @ posed.R_parent_joint[:, joint].numpy() @ unity.T
    assert np.abs(Rotation.from_quat(xyzw[:, k].numpy()).as_matrix() - R).max() < 1e-4
    assert t[:, k].numpy() == pytest.approx(
        (unity @ posed.skeleton.t_parent_joint[joint].numpy())[None].repeat(60, 0), abs=1e-5
    )
    assert len(bones_of(body(3))[0][0]) == len(BONES)
