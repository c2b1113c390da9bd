"""Joints' axes of a rig whose bind pose does not stand are the body's, found from clips in which it is straight."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from foreign_bvh import CONVENTIONS, NAMES, OFFSETS, PARENTS, Convention, turn, write
from wearcap.checks.body import check_motion
from wearcap.io.conventions import Conventions
from wearcap.prepare.foreign import ForeignMotion, read_foreign_motion, straightest
from wearcap.prepare.foreign_conventions import Mapping
from wearcap.recording import Motion

RIG = CONVENTIONS["unity"]
"""Bones along each joint's own x, y up."""
OURS = {"pelvis": "pelvis", "chest": "t8", "head": "head"}
MALE2 = replace(RIG, rest="bent trunk")
"""As of ACCAD's Male2: in the bind pose legs and feet stand, and the trunk lies along x."""
TRUNK_DEG, LIMB_DEG = 8, 10

Pose = tuple[dict[str, np.ndarray], dict[str, np.ndarray]]


def person(
    frames: int = 240, stride: float = 0.4, crouch: float = 0.0, look: float = 0.5, lie: float = 0.0, speed: float = 1.2
) -> Pose:
    """World rotations (from the T-pose) and places by joint of someone who stands for a third, then walks along x.

    `crouch` bends hips, knees and trunk (rad), `look` swings the head to both sides, `lie` lays all down backwards.
    """
    t = np.arange(frames) / 60
    going = np.clip((t - t[-1] / 3) / 0.3, 0, 1)
    phase = 2 * np.pi * 0.9 * t
    still = np.zeros(frames)
    local = {name: turn("x", still) for name in NAMES}
    local["spine2"] = turn("y", still + 0.8 * crouch)
    local["head"] = turn("z", look * going * np.sin(2 * np.pi * 0.75 * t)) @ turn("y", still + np.radians(7))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = stride * going * sign * np.sin(phase) - 0.9 * crouch
        bend = 0.06 + 1.8 * crouch + going * 2 * stride * np.clip(np.sin(phase + np.pi * (side == "left") + 0.9), 0, 1)
        local[f"{side}_hip"] = turn("y", swing - 0.03)
        local[f"{side}_knee"] = turn("y", bend)
        local[f"{side}_ankle"] = turn("y", -swing + 0.03 - bend)
        local[f"{side}_shoulder"] = turn("y", 0.5 * stride * going * np.sin(phase) * -sign) @ turn(
            "x", still - 1.3 * sign
        )
        local[f"{side}_elbow"] = turn("z", -sign * (0.35 + 0.2 * going))
    down = turn("y", -lie)
    R = {"pelvis": down @ local["pelvis"]}
    height = 0.94 * np.cos(lie) - 0.35 * crouch + 0.15 * np.sin(lie)
    p = {"pelvis": np.stack([np.cumsum(going) / 60 * speed + 2.0, still + 1.5, still + height], -1)}
    for name in NAMES[1:]:
        R[name] = R[PARENTS[name]] @ local[name]
        p[name] = p[PARENTS[name]] + R[PARENTS[name]] @ OFFSETS[name]
    return R, p


def read(path: Path, truth: Pose, rig: Convention = RIG, **options) -> ForeignMotion:
    write(path, rig, *truth)
    return read_foreign_motion(path, **options)


def error_deg(motion: Motion, truth: dict[str, np.ndarray], joint: str) -> float:
    """Median angle between a joint's axes and the true ones; a y-up file's z is our x, and the true x is its z."""
    ours = motion.joint(OURS.get(joint, joint)).R.double().numpy()
    return float(
        np.degrees(np.median((Rotation.from_matrix(ours).inv() * Rotation.from_matrix(truth[joint])).magnitude()))
    )


@pytest.mark.parametrize("rig", [RIG, CONVENTIONS["rokoko"], CONVENTIONS["unreal"], MALE2])
def test_the_axes_of_one_who_stands_and_walks_are_the_bodys(rig, tmp_path):
    R, p = person()
    read_in = read(tmp_path / "walk.bvh", (R, p), rig)
    assert read_in.report.frames.startswith("the motion")
    assert not any("uncertain" in note for note in read_in.report.notes)
    motion = read_in.motion
    for joint in ("pelvis", "chest", "head"):
        assert error_deg(motion, R, joint) < TRUNK_DEG, joint
    for side in ("left", "right"):
        for part in ("hip", "knee", "ankle", "toe", "shoulder", "elbow"):
            assert error_deg(motion, R, f"{side}_{part}") < LIMB_DEG, (side, part)
    assert not [f for f in check_motion("motion", motion, None) if f.check.endswith("axes") and f.severity != "ok"]


def test_limbs_that_never_bend_keep_the_trunks_axes(tmp_path):
    R, p = person(stride=0.0, speed=0.0)
    motion = read(tmp_path / "stand.bvh", (R, p)).motion
    for joint in ("left_hip", "right_knee"):
        assert error_deg(motion, R, joint) < LIMB_DEG


def test_a_crouch_alone_is_uncertain_and_right_beside_a_clip_that_stands(tmp_path):
    """Bent all along, head to one side: the constants of the rig come from another clip of it."""
    R, p = person(crouch=0.9, speed=0.0, stride=0.0)
    aside = turn("z", 0.7)
    R["head"] = R["head"] @ aside
    alone = read(tmp_path / "crouch.bvh", (R, p), MALE2)
    assert any("uncertain" in note for note in alone.report.notes)
    assert "uncertain" in alone.report.summary()
    assert error_deg(alone.motion, R, "head") > 20
    write(tmp_path / "walk.bvh", MALE2, *person())
    siblings = straightest((tmp_path / "walk.bvh",))
    beside = read_foreign_motion(tmp_path / "crouch.bvh", siblings=siblings)
    assert len(beside.motion) == len(alone.motion)
    assert not any("uncertain" in note for note in beside.report.notes)
    for joint in ("pelvis", "chest", "head"):
        assert error_deg(beside.motion, R, joint) < TRUNK_DEG, joint


@pytest.mark.parametrize("rig", [CONVENTIONS["mixamo"], RIG])
def test_lying_is_no_other_axis(rig, tmp_path):
    """Somebody lies throughout on a floor at 0, far from the origin: y stays up, and the doctor finds no error."""
    read_in = read(tmp_path / "lie.bvh", person(lie=np.pi / 2, speed=0.0, stride=0.0, look=0.0), rig)
    assert read_in.report.up == "y"
    head, ankle = (read_in.motion.joint(name).t[:, 2] for name in ("head", "left_ankle"))
    assert (head - ankle).abs().max() < 0.3
    found = check_motion("motion", read_in.motion, None)
    assert "error" not in {finding.severity for finding in found}
    assert "the body is not upright" in {finding.what for finding in found}


def test_a_body_that_stands_along_another_axis_is_still_an_error(tmp_path):
    motion = read(tmp_path / "walk.bvh", person()).motion
    aside = torch.from_numpy(turn("x", np.pi / 2)).float()
    R = motion.R_parent_joint.clone()
    R[:, 0] = aside @ R[:, 0]
    found = check_motion("motion", replace(motion, R_parent_joint=R, t_world_root=motion.t_world_root @ aside.T), None)
    assert "the body stands along -y" in {finding.what for finding in found if finding.severity == "error"}


def test_what_is_stated_comes_before_what_is_detected(tmp_path):
    truth = person()
    write(tmp_path / "walk.bvh", replace(RIG, unit_m=0.012), *truth)
    stated = read_foreign_motion(tmp_path / "walk.bvh", how=Conventions(unit=0.012, up="y"))
    assert (stated.report.unit_m, stated.report.up) == (0.012, "y")
    assert "Stated: unit=0.012, up=y." in stated.report.summary()
    thigh = stated.motion.joint("left_hip").t - stated.motion.joint("left_knee").t
    assert thigh.norm(dim=-1).median() == pytest.approx(0.42, abs=0.003)
    assert read_foreign_motion(tmp_path / "walk.bvh").report.unit_m == 0.01
    assert (
        read_foreign_motion(tmp_path / "walk.bvh", Mapping(unit_m=0.01), how=Conventions(unit=0.012)).report.unit_m
        == 0.012
    )
    assert read_foreign_motion(tmp_path / "walk.bvh", how=Conventions(up="x")).report.up == "x"


@pytest.fixture(scope="module")
def walker(tmp_path_factory) -> Motion:
    return read(tmp_path_factory.mktemp("walker") / "walk.bvh", person(look=0.2)).motion


def turned(motion: Motion, joint: str, R: np.ndarray) -> Motion:
    """The motion with a constant turn of one joint's axes; no joint moves."""
    k = motion.skeleton.index(joint)
    turn_joint = torch.from_numpy(R).float()
    local, offsets = motion.R_parent_joint.clone(), motion.skeleton.t_parent_joint.clone()
    local[:, k] = local[:, k] @ turn_joint
    for child, parent in enumerate(motion.skeleton.parents):
        if parent == k:
            local[:, child] = turn_joint.T @ local[:, child]
            offsets[child] = turn_joint.T @ offsets[child]
    return replace(motion, R_parent_joint=local, skeleton=replace(motion.skeleton, t_parent_joint=offsets))


@pytest.mark.parametrize(
    ("joint", "axis", "degrees", "severity"),
    [
        ("pelvis", "y", 45, "error"), ("pelvis", "z", 70, "error"), ("pelvis", "y", 34, "warning"), ("pelvis", "y", 15, "ok"),
        ("t8", "x", -50, "error"), ("head", "z", 95, "error"), ("head", "x", 60, "error"), ("head", "y", 50, "ok"),
        ("head", "z", 25, "ok"),
    ],
)  # fmt: skip
def test_the_doctor_sees_axes_that_are_not_the_bodys(joint, axis, degrees, severity, walker):
    off = turned(walker, joint, turn(axis, np.radians(degrees)))
    torch.testing.assert_close(off.T_world_joint.t, walker.T_world_joint.t, atol=1e-4, rtol=0)
    [finding] = [f for f in check_motion("motion", off, None) if f.check.endswith("joints' axes")]
    assert finding.severity == severity, finding
    if severity != "ok":
        assert ("trunk" if joint == "t8" else joint) in finding.evidence


@pytest.mark.real
@pytest.mark.parametrize(
    "trial",
    ["Male2_B3_Walk", "Male2_B1_StandToWalk", "Male2_B2_WalkToStand", "Male2_B9_WalkTurnLeft90", "Female1_B03_Walk"],
)
def test_accads_walkers_are_upright_and_look_ahead(trial, real_data):
    motion = read_foreign_motion(real_data / "accad" / "trials" / trial.split("_")[0] / f"{trial}.bvh.xz").motion
    places = motion.t_world_root.numpy().astype(float)
    half = int(motion.fps / 2)
    way = places[2 * half :, :2] - places[: -2 * half, :2]
    walks = np.linalg.norm(way, axis=1) > 0.5
    for joint, least in (("pelvis", 0.97), ("t8", 0.97), ("head", 0.9)):
        R = motion.joint(joint).R.numpy()[half:-half][walks]
        assert R[:, 2, 2].mean() > least, joint
        x, d = R[:, :2, 0], way[walks]
        off = np.degrees(np.arctan2(d[:, 0] * x[:, 1] - d[:, 1] * x[:, 0], (d * x).sum(1)))
        assert abs(np.median(off)) < 20, joint


@pytest.mark.real
@pytest.mark.parametrize(
    "trial", ["Female1_A09_LieT2", "Male2_A9_Lie", "Female1_A11_CrawlForward", "Male2_A8_CrouchToLie"]
)
def test_accads_lying_and_crawling_clips_are_read(trial, real_data):
    read_in = read_foreign_motion(real_data / "accad" / "trials" / trial.split("_")[0] / f"{trial}.bvh.xz")
    assert read_in.report.up == "y"
    assert "error" not in {finding.severity for finding in check_motion("motion", read_in.motion, None)}
