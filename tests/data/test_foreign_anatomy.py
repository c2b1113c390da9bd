"""One person in files whose heads and ankles lie elsewhere: crown, eyes, wrists and legs come out at one place."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import foreign_bvh
from foreign_bvh import CONVENTIONS, turn, walk, write
from wearcap.body.skeleton import xsens23
from wearcap.prepare.foreign import read_foreign_motion, straightest

STATURE = 1.7714
"""Of `foreign_bvh`'s person whose ankle is 0.0462 of it over the sole: ankle to head's joint 1.50 m, to crown 1.6894."""
CROWN = 0.1894
PITCH = 0.122
"""Downward pitch (rad) of a head that looks ahead while its wearer walks."""
LAYOUTS = {
    "ours": ("mixamo", 0.0, CROWN, 0.0, 0.0),
    "ACCAD": ("motionbuilder", CROWN - 0.11, 0.11, 0.0, 0.0),
    "MHAD": ("lafan", 0.003, CROWN - 0.003, 0.0, 0.0),
    "CMU": ("cmu", 0.09, CROWN - 0.09, 0.0, 0.45),
    "Unity": ("unity", CROWN - 0.093 * STATURE, 0.065, 0.0138 * STATURE, 0.0),
    "no end": ("biped", 0.0, 0.0, 0.0, 0.0),
}
"""Convention; how far its head's joint lies over ours, its end over that joint, its ankle over ours (m); its head
frame's pitch (rad)."""


def level_walk():
    """The walk, its head looking a little down as walkers' do."""
    R, p = walk(240)
    yaw = np.arctan2(R["head"][:, 1, 0], R["head"][:, 0, 0])
    return R | {"head": turn("z", yaw) @ turn("y", np.full(len(yaw), PITCH))}, p


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_person_in_each_layout_lands_at_one_place(layout, tmp_path, monkeypatch):
    name, head_up, end_up, ankle_up, pitched = LAYOUTS[layout]
    R, p = level_walk()
    places, rotations = dict(p), dict(R)
    places["head"] = p["head"] + R["head"] @ np.array([0, 0, head_up])
    for side in ("left", "right"):
        places[f"{side}_ankle"] = p[f"{side}_ankle"] + R[f"{side}_knee"] @ np.array([0, 0, ankle_up])
    rotations["head"] = R["head"] @ turn("y", pitched)
    monkeypatch.setitem(foreign_bvh.SIDED_ENDS, "head", tuple(turn("y", -pitched) @ np.array([0, 0, end_up])))
    write(tmp_path / "walk.bvh", replace(CONVENTIONS[name], places=True), rotations, places)
    motion = read_foreign_motion(tmp_path / "walk.bvh").motion
    assert abs(motion.skeleton.stature - STATURE) < 0.01
    ours, scale = {joint: motion.joint(joint).t.numpy() for joint in p if joint in motion.skeleton}, STATURE / 1.73
    eyes, crown = np.array([0.08, 0, 0.074]) * scale, np.array([0.02, 0, 0.185]) * scale
    found = motion.joint("head")
    for point, at in (("eyes", eyes), ("crown", crown)):
        p[point] = p["head"] + R["head"] @ at
        ours[point] = (found @ torch.tensor(at).float()).numpy()
    ours["crown"] = (found @ torch.tensor(motion.skeleton.sites["crown"].t_joint_site)).numpy()
    sided = [f"{side}_{part}" for side in ("left", "right") for part in ("wrist", "hip", "knee", "ankle")]
    compared = ["head", "eyes", "crown", *sided]
    a, b = (np.stack([at[joint] for joint in compared], 1) for at in (ours, p))
    angle = np.arctan2(
        (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).sum(), (a[..., :2] * b[..., :2]).sum()
    )  # a file does not say where the world's x points
    gaps = np.linalg.norm(a @ turn("z", angle).T - b, axis=-1).max(0)
    assert gaps.max() < 0.01, dict(zip(compared, gaps.round(3)))


def test_the_base_of_the_skull_of_our_skeleton_is_where_the_table_says():
    skeleton = xsens23()
    assert skeleton.stature - skeleton.height_of("head") == pytest.approx(0.185, abs=1e-4)
    assert skeleton.height_of("left_ankle") / skeleton.stature == pytest.approx(0.0462, abs=1e-4)


@pytest.mark.real
@pytest.mark.parametrize(
    ("clip", "stature"),
    [
        ("accad/trials/Female1/Female1_A01_Stand", 1.65),  # its end 1.62 m over toes that lie 3 cm over the floor
        ("accad/trials/Male2/Male2_A1_Stand", 1.78),  # its end 1.775 m over the ends of toes 0.6 cm over the floor
        ("fubot_vr/trials/boxvr_4", 1.84),
        ("berkeley_mhad/trials/s02/skl_s02_t-pose", 1.745),
        ("berkeley_mhad/trials/s09/skl_s09_t-pose", 1.515),
    ],
)
def test_statures_of_people_who_are_known(real_data, clip, stature):
    path = real_data / f"{clip}.bvh.xz"
    files = sorted(path.parent.glob("*.bvh.xz"))
    siblings = straightest(tuple(files[:: -(-len(files) // 12)])) if "Male2" in clip else ()
    assert abs(read_foreign_motion(path, siblings=siblings).motion.skeleton.stature - stature) < 0.02
