"""Retargeting: the same body in other bones, measured in millimetres."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import head_level, landmarks, with_head_face
from wearcap.body.retarget import fit_offsets, reach, retarget
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rotation import swing_between

PAIRS = [
    ("hip", "femur"),
    ("knee", "tibia"),
    ("ankle", "foot"),
    ("toe", "toes"),
    ("shoulder", "humerus"),
    ("elbow", "radius"),
    ("wrist", "hand"),
]


def a_motion(skeleton: Skeleton, frames: int = 40, seed: int = 0):
    """Random smooth-ish poses of everyday size."""
    torch.manual_seed(seed)
    R = rotation.exp(0.25 * torch.randn(frames, len(skeleton), 3))
    R[:, 0] = rotation.about_axis("z", torch.linspace(0, 6, frames)) @ R[:, 0]
    return R, torch.randn(frames, 3)


def renamed(skeleton: Skeleton, names: dict[str, str]) -> Skeleton:
    return replace(skeleton, name="foreign", joint_names=tuple(names[n] for n in skeleton.joint_names), sites={})


def mixamo(skeleton: Skeleton) -> Skeleton:
    part = {
        "hip": "UpLeg",
        "knee": "Leg",
        "ankle": "Foot",
        "toe": "ToeBase",
        "collar": "Shoulder",
        "shoulder": "Arm",
        "elbow": "ForeArm",
        "wrist": "Hand",
    }
    trunk = {"pelvis": "Hips", "l5": "Spine", "l3": "Spine1", "t12": "Spine2", "t8": "Spine3"}
    names = {}
    for name in skeleton.joint_names:
        side, _, rest = name.partition("_")
        names[name] = f"mixamorig:{side.title()}{part[rest]}" if rest else trunk.get(name, name.title())
    return renamed(skeleton, names)


def splayed(skeleton: Skeleton, angle: float) -> tuple[Skeleton, torch.Tensor]:
    """The same body with another bind pose (legs astride, arms hanging), and its bind rotations."""
    R = torch.eye(3).repeat(len(skeleton), 1, 1)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        R[skeleton.index(f"{side}_hip")] = rotation.about_axis("x", torch.tensor(sign * angle))
        R[skeleton.index(f"{side}_shoulder")] = rotation.about_axis("x", torch.tensor(sign * -1.0))
    T = forward_kinematics(skeleton, R, torch.zeros(3))
    offsets = T.t - T.t[[max(p, 0) for p in skeleton.parents]]
    return replace(skeleton, name="astride", t_parent_joint=offsets, sites={}), T.R


def test_same_skeleton_is_unchanged():
    skeleton = xsens23()
    R, t = a_motion(skeleton)
    R_out, t_out = retarget(skeleton, skeleton, R, t)
    assert rotation.geodesic(R_out, R).max() < 5e-3
    torch.testing.assert_close(t_out, t, atol=1e-6, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 0.35])
def test_bind_pose_does_not_matter(angle):
    """A body whose bind pose stands astride moves the T-posed body to the same joints and orientations."""
    skeleton = xsens23()
    other, R_bind = splayed(skeleton, angle)
    R, t = a_motion(skeleton)
    T = forward_kinematics(skeleton, R, t)
    R_other = local_rotations(other, T.R @ R_bind.transpose(-1, -2))
    torch.testing.assert_close(forward_kinematics(other, R_other, t).t, T.t, atol=1e-5, rtol=0)
    R_back, t_back = retarget(other, skeleton, R_other, t)
    back = forward_kinematics(skeleton, R_back, t_back)
    assert (back.t - T.t).norm(dim=-1).max() < 4e-4  # single precision at a nearly straight knee
    assert rotation.geodesic(back.R, T.R).max() < 5e-3
    torch.testing.assert_close(fit_offsets(other, skeleton).t_parent_joint, skeleton.t_parent_joint, atol=1e-5, rtol=0)


def test_foreign_names_are_recognised():
    skeleton = xsens23()
    foreign = mixamo(skeleton)
    assert landmarks(foreign) == landmarks(skeleton)
    R, t = a_motion(skeleton)
    assert rotation.geodesic(retarget(foreign, skeleton, R, t)[0], R).max() < 5e-3


def test_unknown_limbs_are_named():
    skeleton = xsens23()
    names = {n: n.replace("left_elbow", "bone_7") for n in skeleton.joint_names}
    with pytest.raises(WearcapError, match=r"left arm.*bone_7"):
        landmarks(renamed(skeleton, names))


def test_other_proportions_keep_wrists_and_ankles_where_reachable():
    """Shorter limbs bend less to reach the same place."""
    small, tall = xsens23().scaled(0.97), xsens23()
    R = torch.eye(3).repeat(5, 23, 1, 1)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        R[:, tall.index(f"{side}_elbow")] = rotation.about_axis("z", torch.tensor(sign * 1.2))
        R[:, tall.index(f"{side}_knee")] = rotation.about_axis("y", torch.tensor(1.0))
    t = torch.rand(5, 3)
    source = forward_kinematics(tall, R, t).t
    target = forward_kinematics(small, *retarget(tall, small, R, t)).t
    joints = tall.indices("left_wrist", "right_wrist", "left_ankle", "right_ankle")
    assert (source - target)[:, joints].norm(dim=-1).max() < 1e-4


def test_reach_lands_and_keeps_lengths():
    torch.manual_seed(1)
    a, b, c, goal = torch.randn(4, 200, 3, dtype=torch.float64).unbind(0)
    R_up, R_low = reach(a, b, c, goal)
    elbow = a + (R_up @ (b - a)[..., None])[..., 0]
    hand = elbow + (R_low @ (c - b)[..., None])[..., 0]
    upper, lower, want = (b - a).norm(dim=-1), (c - b).norm(dim=-1), (goal - a).norm(dim=-1)
    reachable = (want < upper + lower) & (want > (upper - lower).abs() * 1.002)
    assert reachable.sum() > 50
    assert (hand - goal)[reachable].norm(dim=-1).max() < 1e-3
    along = torch.nn.functional.cosine_similarity(hand - a, goal - a)
    assert along.min() > 1 - 1e-6  # out of reach: along the way


def test_swing_between_opposites():
    a = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.6, 0, 0.8]])
    R = swing_between(a, -a)
    torch.testing.assert_close((R @ a[..., None])[..., 0], -a)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3))


def test_head_level_finds_a_planted_tilt():
    skeleton = xsens23()
    R, _ = a_motion(skeleton, 400)
    R[:] = torch.eye(3)
    planted = rotation.about_axis("y", torch.tensor(0.6)) @ rotation.about_axis("x", torch.tensor(-0.1))
    R[:, skeleton.index("head")] = planted
    fixed = with_head_face(skeleton, R, head_level(skeleton, R))
    face = forward_kinematics(skeleton, fixed, torch.zeros(400, 3)).R[:, skeleton.index("head")]
    assert abs(torch.rad2deg(torch.asin(-face[0, 2, 0])) - 7) < 0.01
    assert abs(face[0, 2, 1]) < 1e-4
    R[:, 0] = rotation.about_axis("y", torch.tensor(1.5))
    assert head_level(skeleton, R) is None


@pytest.mark.real
@pytest.mark.parametrize("trial", ["07_01", "09_01", "16_11"])
def test_cmu_round_trip(real_data, trial):
    """CMU → xsens23 → CMU: joints within millimetres on the way and back."""
    from wearcap.io.formats.asf_amc import read_amc, read_asf

    folder = real_data / "cmu_mocap" / "trials" / f"{int(trial[:2]):03d}"
    asf = read_asf(next(folder.glob("*.asf")))
    motion = read_amc(asf, folder / f"{trial}.amc.xz")
    source = asf.skeleton
    target = fit_offsets(source, xsens23())
    R, t = retarget(source, target, motion.R_parent_joint, motion.t_world_root)
    R_back, t_back = retarget(target, source, R, t)
    truth = forward_kinematics(source, motion.R_parent_joint, motion.t_world_root)
    there, back = forward_kinematics(target, R, t), forward_kinematics(source, R_back, t_back)
    pairs = [(f"{s}_{ours}", f"{s[0]}{theirs}") for s in ("left", "right") for ours, theirs in PAIRS]
    for ours, theirs in [*pairs, ("t8", "thorax"), ("neck", "lowerneck"), ("head", "head")]:
        true = truth.t[:, source.index(theirs)]
        limit = 0.008 if theirs == "head" else 0.004
        assert (there.t[:, target.index(ours)] - true).norm(dim=-1).max() < limit, ours
        assert (back.t[:, source.index(theirs)] - true).norm(dim=-1).max() < limit, theirs
    fingers = source.indices("lfingers", "rfingers", "lthumb", "rthumb")
    kept = [j for j in range(len(source)) if j not in fingers]
    assert (back.t - truth.t)[:, kept].norm(dim=-1).mean() < 0.002
