"""Joint angles: one joint turned by a known angle in a known plane shows that angle and no other, as SciPy finds it, too."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from data_prep.cmu import cmu_tasks
from data_prep.shared.engine import Splits
from data_prep.shared.mocap import MOCAP
from wearcap.body.skeleton import SIDES, xsens23
from wearcap.body.skeletons import smplh52
from wearcap.cli.conf import compose, splits_dir
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import cycle_times
from wearcap.metrics.strides import gait_report
from wearcap.recording import Motion
from wearcap.recording.joint_angles import CENTRAL, SIDED, euler_deg, joint_angles

T_POSE = {"shoulder_elevation": 90.0, "elbow_pronation": 90.0}
"""Angles of the rest pose that are not 0, on either side."""


def posed(turns: dict[str, Rotation], skeleton=None) -> dict[str, float]:
    """Angles of a rest pose whose joints are turned; the world is x forward, y left, z up."""
    skeleton = skeleton or xsens23()
    R = torch.eye(3, dtype=torch.float64).repeat(1, len(skeleton), 1, 1)
    for name, turn in turns.items():
        R[0, skeleton.index(name)] = torch.from_numpy(turn.as_matrix())
    motion = Motion(torch.zeros(1, dtype=torch.float64), skeleton, R, torch.zeros(1, 3, dtype=torch.float64))
    return {name: angle.item() for name, angle in joint_angles(motion).items()}


def differs(turns: dict[str, Rotation]) -> dict[str, float]:
    """Angles that a pose changes, by more than 0.001°."""
    rest, pose = posed({}), posed(turns)
    return {name: round(pose[name] - rest[name], 3) for name in pose if abs(pose[name] - rest[name]) > 1e-3}


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


def test_the_rest_pose_is_neutral_but_for_the_arms():
    for skeleton in (xsens23(), smplh52()):
        for name, angle in posed({}, skeleton).items():
            assert angle == pytest.approx(T_POSE.get(name.partition("_")[2], 0.0), abs=0.5), name


PLANES = [
    # joint, axis (left is y, up z), degrees about it on the right side, the angle that they are
    ("hip", "y", -30, "hip_flexion", 30),  # the thigh swings forward
    ("hip", "x", 20, "hip_adduction", 20),  # the right knee to the left
    ("hip", "z", 15, "hip_internal_rotation", 15),
    ("knee", "y", 60, "knee_flexion", 60),  # the shank swings back
    ("knee", "x", 5, "knee_adduction", 5),
    ("knee", "z", 10, "knee_internal_rotation", 10),
    ("ankle", "y", -12, "ankle_dorsiflexion", 12),  # the toes rise
    ("ankle", "x", 9, "ankle_inversion", 9),  # the right foot's left edge rises
    ("ankle", "z", 7, "ankle_internal_rotation", 7),
    ("shoulder", "x", -30, "shoulder_elevation", 30),  # from sideways upwards
    ("shoulder", "x", 50, "shoulder_elevation", -50),  # and downwards
    ("shoulder", "z", 40, "shoulder_plane_of_elevation", 40),  # from sideways forward
    ("shoulder", "y", 25, "shoulder_internal_rotation", 25),  # the forearm, were it forward, turns down
    ("elbow", "z", 70, "elbow_flexion", 70),  # in T-pose the forearm comes forward
]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("joint", "axis", "degrees", "angle", "shown"), PLANES)
def test_one_joint_in_one_plane_is_one_angle(side, joint, axis, degrees, angle, shown):
    sign = -1 if side == "left" and axis in "xz" else 1
    assert differs({f"{side}_{joint}": about(axis, sign * degrees)}) == {f"{side}_{angle}": pytest.approx(shown)}


@pytest.mark.parametrize(("side", "sign"), [("left", -1), ("right", 1)])
def test_forearms_supinate_about_themselves(side, sign):
    """Palm down to palm forward: the thumbs, which point forward, turn up."""
    turned = differs({f"{side}_elbow": about("y", -90)})
    assert turned == {f"{side}_elbow_pronation": pytest.approx(-90)}


def test_pelvis_and_trunk():
    assert differs({"pelvis": about("y", 12)})["pelvis_anterior_tilt"] == pytest.approx(12)
    assert differs({"pelvis": about("x", 8)}) == {"pelvis_right_drop": pytest.approx(8)}
    assert differs({"pelvis": about("z", 130) * about("y", 12)}) == {
        "pelvis_left_turn": pytest.approx(130), "pelvis_anterior_tilt": pytest.approx(12)
    }  # fmt: skip
    bent = {"t12": about("y", 25)}
    assert differs(bent) == {"trunk_flexion": pytest.approx(25)}
    assert differs({"l3": about("x", 14)}) == {"trunk_right_bending": pytest.approx(14)}
    assert differs({"l3": about("z", 14)}) == {"trunk_left_rotation": pytest.approx(14)}


def test_three_angles_at_once_as_scipy_takes_them_apart():
    """Right side, in ISB's axes (x forward, y up, z right): x is the world's x, y its z, z its -y."""
    random = np.random.default_rng(0)
    for joint in ("hip", "knee", "ankle"):
        z, x, y = random.uniform(-60, 60, 3)
        turn = about("y", -z) * about("x", x) * about("z", y)
        isb = Rotation.from_matrix(turn.as_matrix()[[0, 2, 1]][:, [0, 2, 1]] * np.outer([1, 1, -1], [1, 1, -1]))
        expected = isb.as_euler("ZXY", degrees=True) * [angle[1] for angle in SIDED[joint].angles]
        right = posed({f"right_{joint}": turn})
        assert [right[f"right_{joint}_{name}"] for name, _ in SIDED[joint].angles] == pytest.approx(expected, abs=1e-4)
        mirror = Rotation.from_matrix(turn.as_matrix() * np.outer([1, -1, 1], [1, -1, 1]))
        left = posed({f"left_{joint}": mirror})
        assert [left[f"left_{joint}_{name}"] for name, _ in SIDED[joint].angles] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("sequence", ["ZXY", "YXZ", "YXY"])
def test_angles_rebuild_the_rotation_also_in_gimbal_lock(sequence):
    middles = np.array(
        [-90, -89.99, -40, 0, 0.1, 40, 89.99, 90] if sequence != "YXY" else [0, 0.2, 1, 90, 179, 179.9, 180]
    )
    grid = np.stack(np.meshgrid([-170, -30, 0, 50, 120], middles, [-100, 0, 20, 179]), -1).reshape(-1, 3)
    grid[:, 1] *= -1 if sequence == "YXY" else 1
    R = Rotation.from_euler(sequence, grid, degrees=True)
    angles = torch.stack(euler_deg(sequence, torch.from_numpy(R.as_matrix())), 1).numpy()
    angles[:, 1] *= -1 if sequence == "YXY" else 1
    assert np.abs(angles).max() <= 180 + 1e-9
    again = Rotation.from_euler(sequence, angles, degrees=True)
    # A hanging arm's plane of elevation, up to 0.5°, is given up.
    assert np.rad2deg((R.inv() * again).magnitude()).max() < (1.1 if sequence == "YXY" else 1e-4)
    least, most = (1, 179) if sequence == "YXY" else (0, 89)
    regular = (np.abs(grid[:, 1]) >= least) & (np.abs(grid[:, 1]) <= most)
    apart = ((angles - grid)[regular] + 180) % 360 - 180
    assert np.abs(apart).max() < 1e-4


def test_a_raised_arm_s_plane_and_a_hanging_one_s_rotation():
    hanging = about("x", 90)  # the right arm down
    assert posed({"right_shoulder": hanging})["right_shoulder_elevation"] == pytest.approx(0, abs=1e-4)
    turned = posed({"right_shoulder": about("z", 35) * hanging})
    assert turned["right_shoulder_internal_rotation"] == pytest.approx(35, abs=1e-3)
    assert turned["right_shoulder_plane_of_elevation"] == 0
    forward = posed({"left_shoulder": about("z", -90)})
    assert forward["left_shoulder_plane_of_elevation"] == pytest.approx(90)
    assert forward["left_shoulder_elevation"] == pytest.approx(90)


def test_all_angles_come_for_every_frame_and_in_motion():
    skeleton, times = xsens23(), torch.arange(9, dtype=torch.float64) / 60
    R = torch.eye(3).repeat(9, len(skeleton), 1, 1)
    R[:, skeleton.index("left_knee")] = about_axis("y", 0.1 * times.float())
    angles = joint_angles(Motion(times, skeleton, R, torch.zeros(9, 3)))
    assert len(angles) == 3 * (len(CENTRAL) + 2 * len(SIDED))
    assert angles["left_knee_flexion"].numpy() == pytest.approx(np.rad2deg(0.1 * times.numpy()), abs=1e-3)


@pytest.mark.real
@pytest.mark.slow
def test_people_walk_within_the_normal_ranges(real_data):
    """A trial of CMU's validation people at 1.5 m/s. Extremes of the mean cycle, and of stride parameters, of healthy adults
    with some margin (Perry & Burnfield 2010; Winter 1991); hips are lower by the pelvis' neutral tilt."""
    config = compose("prepare", ["prepare=cmu"])
    splits = Splits.read(splits_dir() / "cmu.csv")
    tasks = cmu_tasks(
        real_data / "cmu_mocap", splits, MOCAP, config.amc_fps, "CMU", config.repair, list(config.usual_m)
    )
    task = next(task for task in tasks if task.name == "39_01")
    assert task.split == "val"
    recording = task.make()
    motion, contacts = recording.motion, recording.contacts
    assert motion is not None
    assert contacts is not None
    angles, times = joint_angles(motion), motion.timestamps.numpy()
    ranges = {
        "hip_flexion": ((-35, -8), (18, 40)), "knee_flexion": ((-3, 14), (52, 78)), "ankle_dorsiflexion": ((-35, -8), (5, 28)),
        "hip_adduction": ((-15, -1), (1, 15)), "ankle_inversion": ((-20, 3), (-6, 15)),
    }  # fmt: skip
    for name, bounds in ranges.items():
        cycles = [
            np.interp(points, times, angles[f"{side}_{name}"].numpy())
            for side, of_side in zip(SIDES, cycle_times(motion))
            for points in of_side.numpy()
        ]
        assert len(cycles) >= 2
        mean = np.mean(cycles, 0)
        for extreme, (low, high) in zip((mean.min(), mean.max()), bounds):
            assert low <= extreme <= high, (name, extreme)
        if name == "knee_flexion":
            assert mean.argmax() < 8 or mean.argmax() > 92, "cycles begin at the peak of swing"
        if name == "hip_flexion":
            assert 60 < mean.argmin() < 95, "extended before the swing"
    report = gait_report(replace(motion, contact_prob=contacts.contact.float()))
    assert report is not None
    for side in SIDES:
        assert 55 < report[side]["stance_percent"]["mean"] < 68
        assert 95 < report[side]["cadence_per_min"]["mean"] < 135
        assert 1.2 < report[side]["speed_m_s"]["mean"] < 1.8
        assert 0 < report[side]["step_width_m"]["mean"] < 0.25
