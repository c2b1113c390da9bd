"""TRC, MOT and angles out: as parsers of their own read them, and the coordinates rebuild the limbs that the markers show."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import wearcap
from wearcap.geometry.rotation import about_axis
from wearcap.io.formats.trc import read_trc
from wearcap.recording import Motion
from wearcap_testing import swaying_motion


def parsed_trc(path: Path) -> tuple[dict[str, str], np.ndarray, dict[str, np.ndarray]]:
    """Header, times (s) and markers (in the file's unit and axes) as the format's description has them."""
    lines = path.read_text().split("\n")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t")))
    names = lines[3].split("\t")[2::3]
    assert lines[4].split("\t")[2:5] == ["X1", "Y1", "Z1"]
    rows = np.array([[float(cell) for cell in line.split("\t")] for line in lines[6:] if line])
    assert rows[:, 0].tolist() == list(range(1, len(rows) + 1))
    return header, rows[:, 1], {name: rows[:, 2 + 3 * k : 5 + 3 * k] for k, name in enumerate(names) if name}


def parsed_mot(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    head, _, table = path.read_text().partition("endheader\n")
    rows = [line.split("\t") for line in table.strip().split("\n")]
    values = np.array(rows[1:], dtype=float)
    settings = dict(line.split("=") for line in head.strip().split("\n")[1:])
    assert (int(settings["nRows"]), int(settings["nColumns"])) == values.shape
    return settings, dict(zip(rows[0], values.T))


@pytest.fixture(scope="module")
def motion() -> Motion:
    """A person who sways and turns, every joint by up to 40° about any axis but knees and elbows, which are hinges."""
    sway = swaying_motion(50, fps=60.0)
    random, skeleton = np.random.default_rng(0), sway.skeleton
    phase = sway.timestamps.numpy()[:, None] * random.uniform(1, 5, len(skeleton))
    axes = random.normal(0, 0.4, (len(skeleton), 3))
    turns = Rotation.from_rotvec((np.sin(phase)[..., None] * axes).reshape(-1, 3)).as_matrix()
    R = torch.from_numpy(turns.reshape(50, -1, 3, 3)).float()
    for side, sign in (("left", -1), ("right", 1)):
        bend = torch.linspace(0.1, 1.4, 50)
        R[:, skeleton.index(f"{side}_knee")] = about_axis("y", bend)
        R[:, skeleton.index(f"{side}_elbow")] = about_axis("z", sign * bend)
    R[:, 0] = about_axis("z", torch.linspace(0, 7, 50)) @ R[:, 0]
    return replace(sway, R_parent_joint=R, timestamps=sway.timestamps + 1 / 3)


def test_markers_are_the_joints_and_landmarks_in_opensim_s_axes(motion, tmp_path):
    wearcap.save(motion, tmp_path / "a.trc")
    header, times, markers = parsed_trc(tmp_path / "a.trc")
    assert (header["Units"], header["NumFrames"], header["NumMarkers"]) == ("mm", "50", str(len(markers)))
    assert float(header["DataRate"]) == pytest.approx(60)
    assert times.tolist() == motion.timestamps.tolist(), "to the last bit"
    assert {"left_heel", "right_toe_tip", "crown", "left_hip"} <= set(markers)
    for joint in motion.skeleton.joint_names:
        x, y, z = motion.joint(joint).t.double().numpy().T * 1000
        assert markers[joint] == pytest.approx(np.stack([x, z, -y], 1), abs=1e-3)
    again = read_trc(tmp_path / "a.trc")
    assert torch.allclose(again.t_world_marker[:, : len(motion.skeleton)], motion.T_world_joint.t.double(), atol=2e-6)


def direction(markers, start, stop):
    bone = markers[stop] - markers[start]
    return bone / np.linalg.norm(bone, axis=1, keepdims=True)


def test_coordinates_rebuild_the_limbs(motion, tmp_path):
    """Rotations by SciPy along OpenSim's chain: pelvis, hip, knee; pelvis, lumbar, arm, elbow."""
    wearcap.save(motion, tmp_path / "a.trc")
    wearcap.save(motion, tmp_path / "a.mot")
    _, _, markers = parsed_trc(tmp_path / "a.trc")
    settings, at = parsed_mot(tmp_path / "a.mot")
    assert settings["inDegrees"] == "yes"
    assert at["time"].tolist() == motion.timestamps.tolist()

    def turned(*names: str, left: bool = False) -> Rotation:
        z, x, y = (at[name] if name else np.zeros(50) for name in names)
        return Rotation.from_euler("ZXY", np.stack([z, -x if left else x, -y if left else y], 1), degrees=True)

    pelvis = turned("pelvis_tilt", "pelvis_list", "pelvis_rotation")
    trunk = pelvis * turned("lumbar_extension", "lumbar_bending", "lumbar_rotation")
    for side in ("left", "right"):
        s, left = side[0], side == "left"
        thigh = pelvis * turned(f"hip_flexion_{s}", f"hip_adduction_{s}", f"hip_rotation_{s}", left=left)
        shank = thigh * Rotation.from_euler("z", -at[f"knee_angle_{s}"][:, None], degrees=True)
        arm = trunk * turned(f"arm_flex_{s}", f"arm_add_{s}", f"arm_rot_{s}", left=left)
        forearm = arm * Rotation.from_euler("z", at[f"elbow_flex_{s}"][:, None], degrees=True)
        for segment, start, stop in (
            (thigh, "hip", "knee"), (shank, "knee", "ankle"), (arm, "shoulder", "elbow"), (forearm, "elbow", "wrist")
        ):  # fmt: skip
            shown = direction(markers, f"{side}_{start}", f"{side}_{stop}")
            assert segment.apply([0, -1, 0]) == pytest.approx(shown, abs=2e-5), (side, start)
        assert at[f"pro_sup_{s}"] == pytest.approx(90, abs=1e-3)
    hips = (markers["left_hip"] + markers["right_hip"]) / 2000
    place = np.stack([at[f"pelvis_t{axis}"] for axis in "xyz"], 1)
    ahead = pelvis.inv().apply(place - hips)
    assert ahead == pytest.approx(np.tile(ahead[0], (50, 1)), abs=1e-5)
    assert 0.04 < ahead[0, 0] < ahead[0, 1] < 0.1
    assert np.abs(np.diff(at["pelvis_rotation"])).max() < 30, "no jump in more than a whole turn"


def test_signs_are_the_model_s(tmp_path):
    base = swaying_motion(3)
    R = torch.eye(3).repeat(3, len(base.skeleton), 1, 1)
    turns = {"right_hip": ("y", -0.5), "left_knee": ("y", 0.4), "left_ankle": ("y", -0.2), "right_shoulder": ("x", 1.2)}
    for joint, (axis, angle) in turns.items():
        R[:, base.skeleton.index(joint)] = about_axis(axis, torch.tensor(angle))
    wearcap.save(replace(base, R_parent_joint=R), tmp_path / "a.mot")
    _, at = parsed_mot(tmp_path / "a.mot")
    degrees = {
        name: round(float(np.rad2deg(angle)), 3) for name, angle in (("hip", 0.5), ("knee", 0.4), ("ankle", 0.2))
    }
    assert at["hip_flexion_r"][0] == pytest.approx(degrees["hip"], abs=1e-3)
    assert at["knee_angle_l"][0] == pytest.approx(degrees["knee"], abs=1e-3)
    assert at["ankle_angle_l"][0] == pytest.approx(degrees["ankle"], abs=1e-3)
    assert at["arm_add_r"][0] == pytest.approx(np.rad2deg(1.2) - 90, abs=1e-3)


def test_angles_have_their_unit_in_every_heading(motion, tmp_path):
    wearcap.save(motion, tmp_path / "walk_angles.csv")
    with open(tmp_path / "walk_angles.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time_s"]) for row in rows] == motion.timestamps.tolist()
    assert all(name == "time_s" or name.endswith("_deg") for name in rows[0])
    assert float(rows[-1]["left_knee_flexion_deg"]) == pytest.approx(np.rad2deg(1.4), abs=1e-3)


def test_opensim_reads_both(motion, tmp_path):
    opensim = pytest.importorskip("opensim", reason="OpenSim is not installed: pip install opensim")
    for ending in ("trc", "mot"):
        wearcap.save(motion, tmp_path / f"a.{ending}")
    markers = opensim.TimeSeriesTableVec3(str(tmp_path / "a.trc"))
    assert list(markers.getIndependentColumn()) == motion.timestamps.tolist()
    assert markers.getTableMetaDataString("Units") == "mm"
    column = markers.getDependentColumn("left_knee")
    x, y, z = motion.joint("left_knee").t[7].double().tolist()
    assert [column[7].get(k) for k in range(3)] == pytest.approx([1000 * x, 1000 * z, -1000 * y], abs=1e-3)
    table = opensim.TimeSeriesTable(str(tmp_path / "a.mot"))
    assert table.getTableMetaDataString("inDegrees") == "yes"
    assert table.getNumRows() == 50
    assert table.getDependentColumn("knee_angle_l").to_numpy()[-1] == pytest.approx(np.rad2deg(1.4), abs=1e-3)
