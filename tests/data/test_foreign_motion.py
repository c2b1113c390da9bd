"""Motion files in the conventions of many programs come onto our skeleton with every joint in its place."""

import lzma
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from acclaim import acclaim_places
from foreign_bvh import CONVENTIONS, NAMES, Y_UP, Convention, turn, walk, write
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.recording import Motion

UPS = {"rigify": "z", "unreal": "z", "biped": "z"}
COMPARED = [name for name in NAMES if name not in ("spine", "spine2", "chest", "neck", "left_collar", "right_collar")]
"""Joints that files and xsens23 share."""


@pytest.fixture(scope="module")
def truth():
    return walk()


def turned_to(ours: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """R of the turn about the vertical that brings points "point 3" nearest to others, without any shift."""
    a, b = ours.reshape(-1, 3), truth.reshape(-1, 3)
    angle = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]).sum())
    return turn("z", angle)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_walk_in_every_convention_lands_on_its_joints(name, truth, tmp_path):
    convention = CONVENTIONS[name]
    R, p = truth
    write(tmp_path / "walk.bvh", convention, R, p)
    read = read_foreign_motion(tmp_path / "walk.bvh")
    report, motion = read.report, read.motion
    assert report.unit_m == pytest.approx(convention.unit_m)
    assert report.up == UPS.get(name, "y")
    assert report.found_by == ("topology" if name == "nameless" else "names")
    expected = {joint: convention.name(joint) for joint in COMPARED if joint != "pelvis"}
    assert {joint: report.joints[joint] for joint in expected} == expected
    assert len(motion) == len(p["pelvis"])
    assert motion.fps == pytest.approx(60)
    places = motion.T_world_joint
    ours = np.stack([places.t[:, motion.skeleton.index(joint)].numpy() for joint in expected], 1)
    if name == "unity":  # its ankles are taken to lie higher than ours
        low = np.array([0.0, 0.0, -0.0138 * 1.772])
        p = p | {f"{side}_ankle": p[f"{side}_ankle"] + R[f"{side}_knee"] @ low for side in ("left", "right")}
    true = np.stack([p[joint] for joint in expected], 1)
    to_truth = turned_to(ours, true)
    gap = np.linalg.norm(ours @ to_truth.T - true, axis=-1)
    toes = [k for k, joint in enumerate(expected) if "toe" in joint]
    assert np.delete(gap, toes, 1).max() < 0.01
    assert gap.max() < (0.02 if name == "unity" else 0.01)  # the distance to its toes changes when an ankle is moved
    assert max(worst for _, worst in report.residual_m.values()) == pytest.approx(gap.max(), abs=2e-3)
    # Where a body faces: exact from a bind pose, within a pose's mean otherwise.
    limit = 0.12 if convention.rest in ("t", "a") else 0.35
    for joint in ("pelvis", "head", "left_ankle", "right_ankle", "left_knee", "right_shoulder"):
        off = to_truth @ places.R[:, motion.skeleton.index(joint)].numpy().astype(float)
        angle = rotation.geodesic(torch.from_numpy(off), torch.from_numpy(R[joint]))
        assert angle.median() < limit, joint
    steps = rotation.geodesic(motion.R_parent_joint[:-1].double(), motion.R_parent_joint[1:].double())
    assert steps.max() < 0.3  # no flips: a limb of this walk turns by at most 8° in a frame
    assert any("mm from the file's joints" in line for line in report.lines())


def test_packed_files_are_the_same(truth, tmp_path):
    write(tmp_path / "walk.bvh", CONVENTIONS["mixamo"], *truth)
    (tmp_path / "walk.bvh.xz").write_bytes(lzma.compress((tmp_path / "walk.bvh").read_bytes()))
    plain, packed = (read_foreign_motion(tmp_path / name).motion for name in ("walk.bvh", "walk.bvh.xz"))
    assert torch.equal(plain.R_parent_joint, packed.R_parent_joint)


def test_a_mapping_overrides_names_unit_and_axes(truth, tmp_path):
    names = {part: f"n{k}" for k, part in enumerate(CONVENTIONS["mixamo"].names)}
    odd = Convention(names | {part: names[part] + "{s}" for part in list(names)[6:]}, ("u", "v"), unit_m=0.02)
    write(tmp_path / "odd.bvh", odd, *truth)
    pairs = {joint: odd.name(joint) for joint in COMPARED if joint != "pelvis"}
    lines = [f"  {ours}: {theirs}" for ours, theirs in pairs.items()]
    (tmp_path / "odd.yaml").write_text("unit: 0.02\nup: y\nforward: x\njoints:\n" + "\n".join(lines) + "\n")
    read = read_foreign_motion(tmp_path / "odd.bvh", tmp_path / "odd.yaml")
    assert read.report.unit_m == 0.02
    assert read.report.joints == pairs
    assert "mapping" in read.report.found_by
    goals = np.stack([truth[1][joint] for joint in pairs], 1)
    ours = np.stack([read.motion.joint(joint).t.numpy() for joint in pairs], 1)
    assert np.linalg.norm(ours @ turned_to(ours, goals).T - goals, axis=-1).max() < 0.01
    swapped = replace(CONVENTIONS["mixamo"])
    write(tmp_path / "swapped.bvh", swapped, *truth)
    (tmp_path / "swap.yaml").write_text("joints: {left_toe: 'mixamorig:RightToeBase'}\n")
    assert (
        read_foreign_motion(tmp_path / "swapped.bvh", tmp_path / "swap.yaml")
        .report.joints["left_toe"]
        .endswith("RightToeBase")
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unti: cm", "Did you mean 'unit'"),
        ("unit: furlong", "unit: furlong"),
        ("unit: true", "unit: True"),
        ("up: w", "up: w"),
        ("joints: [a]", "joints are no names"),
        ("joints: {left_kne: a}", "Did you mean 'left_knee'"),
        ("joints: {left_knee: nowhere}", "no joint of it"),
        ("- a\n- b", "holds a list"),
        ("a: &x [1]\nb: *x", "own parts"),
        ("unit: [", "not readable YAML"),
        ("unit: 1", "tall"),
    ],
)
def test_a_wrong_mapping_is_refused(text, message, truth, tmp_path):
    write(tmp_path / "walk.bvh", CONVENTIONS["mixamo"], *truth)
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(WearcapError, match=message):
        read_foreign_motion(tmp_path / "walk.bvh", tmp_path / "m.yaml")


def without(part: str) -> Convention:
    return replace(
        CONVENTIONS["mixamo"], names={k: v for k, v in CONVENTIONS["mixamo"].names.items() if k not in part.split()}
    )


def test_bones_that_change_their_length_are_fitted_as_near_as_constant_ones_reach(truth, tmp_path):
    """All places 2 % nearer to the pelvis and farther from it, in turn: the report says how far that is."""
    R, p = truth
    breath = 1 + 0.02 * np.sin(np.linspace(0, 9, len(p["pelvis"])))[:, None]
    stretched = {joint: p["pelvis"] + breath * (places - p["pelvis"]) for joint, places in p.items()}
    write(tmp_path / "stretched.bvh", CONVENTIONS["studio"], R, stretched)
    report = read_foreign_motion(tmp_path / "stretched.bvh").report
    knees, wrists = report.residual_m["left_knee"], report.residual_m["right_wrist"]
    assert 0.002 < knees[0] < knees[1] < 0.012  # 2 % of a thigh of 42 cm
    assert 0.002 < wrists[0] < wrists[1] < 0.03


def test_left_handed_axes_are_turned_right(truth, tmp_path):
    mirrored = replace(CONVENTIONS["mixamo"], axes=np.diag([-1.0, 1, 1]) @ Y_UP)
    write(tmp_path / "left.bvh", mirrored, *truth)
    write(tmp_path / "right.bvh", CONVENTIONS["mixamo"], *truth)
    left, right = (read_foreign_motion(tmp_path / f"{side}.bvh") for side in ("left", "right"))
    assert "left-handed" in left.report.notes[0]
    assert right.report.notes == ()
    torch.testing.assert_close(left.motion.T_world_joint.t, right.motion.T_world_joint.t, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("missing", "message"),
    [("head neck", "no joint named head"), ("shoulder elbow wrist", "arm"), ("hip knee ankle toe", "leg")],
)
def test_a_file_without_a_person_says_what_is_missing(missing, message, truth, tmp_path):
    write(tmp_path / "part.bvh", without(missing), *truth)
    with pytest.raises(WearcapError, match=message) as caught:
        read_foreign_motion(tmp_path / "part.bvh")
    assert "mapping=FILE.yaml" in str(caught.value)
    assert "part.bvh" in str(caught.value)


def test_files_without_toes_collars_or_neck_are_read(truth, tmp_path):
    write(tmp_path / "few.bvh", without("toe collar neck spine2"), *truth)
    report = read_foreign_motion(tmp_path / "few.bvh").report
    assert max(worst for _, worst in report.residual_m.values()) < 0.01
    assert report.joints["left_toe"] == "mixamorig:LeftFoot (end)"


def outcome(path: Path) -> tuple[str, Motion | None]:
    """The reader's refusal, or the motion."""
    try:
        return "", read_foreign_motion(path).motion
    except WearcapError as error:
        return str(error), None


def test_odd_files_are_read_or_refused(truth, tmp_path):
    """All joints in one place, one frame, values cut, swapped, turned to NaN: one clear error or a finite motion."""
    write(tmp_path / "walk.bvh", CONVENTIONS["studio"], *truth)
    text = (tmp_path / "walk.bvh").read_text()
    head, _, motion = text.partition("MOTION")
    rows = motion.strip().splitlines()
    rng = np.random.default_rng(0)
    texts = [head + "MOTION\nFrames: 1\nFrame Time: 0.01\n" + rows[2]]
    texts += [head + "MOTION\nFrames: 3\nFrame Time: 0.01\n" + ("0 " * len(rows[2].split()) + "\n") * 3]
    texts += [text.replace("Frames: 150", "Frames: 99999999999")]
    for _ in range(60):
        words = text.split(" ")
        for _ in range(int(rng.integers(1, 5))):
            words[int(rng.integers(len(words)))] = str(rng.choice(["nan", "1e300", "-9e9", "", "x", "0", "{", "}"]))
        cut = " ".join(words)
        texts.append(cut[: int(rng.integers(len(cut) // 2, len(cut)))] if rng.random() < 0.3 else cut)
    for k, bad in enumerate(texts):
        path = tmp_path / f"bad{k}.bvh"
        path.write_text(bad)
        refused, motion = outcome(path)
        if motion is None:
            assert path.name in refused
            assert "\n" not in refused
        else:
            assert motion.R_parent_joint.isfinite().all()
            assert motion.t_world_root.isfinite().all()


@pytest.mark.real
def test_cmus_conversions_stand_as_tall_as_people(real_data):
    """cgspeed's files: their unit, the T-pose before the motion, and the bone that they lost."""
    trials = sorted((real_data / "cmu_mocap" / "trials").glob("*/*.bvh.xz"))
    assert len(trials) == 5
    for trial in trials:
        read = read_foreign_motion(trial)
        motion, report = read.motion, read.report
        assert report.convention == "CMU, cgspeed's conversion"
        assert report.unit == "CMU's units"
        assert "first frame" in report.notes[0]
        assert motion.fps == pytest.approx(120)
        crown = motion.joint("head").t[:, 2] + motion.skeleton.sites["crown"].t_joint_site[2]
        assert 1.4 < crown.median() < 1.85, trial
        assert motion.skeleton.t_parent_joint[motion.skeleton.index("neck"), 2] > 0.08


ACCLAIM = {"knee": "tibia", "ankle": "foot", "elbow": "radius", "wrist": "hand"}
"""CMU's bones by the joint at their start; `wrist` in CMU's files is the middle of the forearm."""


@pytest.mark.real
@pytest.mark.parametrize(
    ("folder", "trial"),
    [
        ("cmu_mocap/trials/007", "07_01"),
        ("cmu_mocap/trials/001", "01_03"),
        ("cmu_mocap/trials/014", "14_06"),
        ("cmu_mocap/trials/005", "05_10"),
        ("hdm05/trials/HDM_mm", "HDM_mm_grabHighR_022_120"),
        ("hdm05/trials/HDM_bk", "HDM_bk_lieDownFloor_005_120"),
    ],
)
def test_acclaim_files_keep_their_joints_places(real_data, folder, trial):
    """Against forward kinematics of the format's own definition, written in NumPy here."""
    amc = real_data / folder / f"{trial}.amc.xz"
    true = acclaim_places(next((real_data / folder).glob("*.asf*")), amc)
    motion = read_foreign_motion(amc).motion
    for side in ("left", "right"):
        for ours, theirs in ACCLAIM.items():
            gap = np.linalg.norm(motion.joint(f"{side}_{ours}").t.numpy() - true[side[0] + theirs], axis=-1)
            assert gap.mean() < 0.002, (side, ours)
            assert gap.max() < 0.005, (side, ours)
