"""Single files of the HPS data set: what was written in its layout comes back in our axes; damage is named."""

import json
import math
import pickle
from contextlib import suppress
from pathlib import Path

import hps_files
import numpy as np
import pytest
import torch
from hps_files import FRAMES, NAME, same_motion, write_smpl, write_unity
from hypothesis import given

from data_prep.hps import (
    read_hps_cameras,
    read_hps_localization,
    read_hps_motion,
    read_hps_starts,
    read_hps_subject,
    read_unity_motion,
    resampled_localization,
    rotations_from_unity,
)
from hostile import fuzz, mutated, mutated_bytes
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Localization

# Single files ------------------------------------------------------------------------------------------------------


def test_published_motion(tmp_path):
    truth = hps_files.motion()
    write_smpl(truth, tmp_path / "a.pkl")
    read = read_hps_motion(tmp_path / "a.pkl")
    same_motion(read, truth)
    assert read.fps == pytest.approx(30.0)


def test_a_pose_of_zeros_stands_up_facing_x(tmp_path):
    """SMPL's own axes of a person that was turned to z up: x left, y up, z forward before the turn."""
    upright = np.zeros((2, 72))
    upright[:, 0] = math.pi / 2  # about x: y up becomes z up, and z forward becomes -y
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": upright, "transes": np.zeros((2, 3))}))
    read = read_hps_motion(tmp_path / "a.pkl")
    head = read.joint("head").t - read.joint("pelvis").t
    assert head[0, 2] > 0.5
    forward = read.R_parent_joint[0, 0] @ torch.tensor([1.0, 0, 0])
    assert torch.allclose(forward, torch.tensor([0.0, -1, 0]), atol=1e-6)


@pytest.mark.parametrize("inner_root", [True, False])
def test_unity_text_round_trip(inner_root, tmp_path):
    truth = hps_files.motion(40)
    write_unity(truth, tmp_path, inner_root=inner_root)
    same_motion(read_unity_motion(tmp_path / f"{NAME}_pose.txt", tmp_path / f"{NAME}_trans.txt"), truth)


def test_unitys_turns_in_a_left_handed_world():
    """Unity: a positive turn about y (up) takes forward (z) to the right (x): in our axes the person turns right."""
    forward, up = torch.tensor([0.0, 0, 1]).double(), torch.tensor([0.0, 1, 0]).double()
    right_turn = rotations_from_unity(torch.tensor([0.0, 90, 0], dtype=torch.float64))
    assert torch.allclose(right_turn @ forward, torch.tensor([-1.0, 0, 0]).double(), atol=1e-9)  # SMPL's x is left
    nod = rotations_from_unity(torch.tensor([30.0, 0, 0], dtype=torch.float64))
    assert (nod @ forward)[1] < -0.4  # a positive turn about x looks down
    roll = rotations_from_unity(torch.tensor([0.0, 0, 30.0], dtype=torch.float64))
    assert (roll @ up)[0] > 0.4  # a positive turn about z leans to the left
    both = rotations_from_unity(torch.tensor([30.0, 90, 0], dtype=torch.float64))
    torch.testing.assert_close(both, right_turn @ nod)  # x before y, about fixed axes


def test_a_line_cut_short_at_the_end_is_left_out(tmp_path):
    write_unity(hps_files.motion(10), tmp_path)
    path = tmp_path / f"{NAME}_pose.txt"
    path.write_text(path.read_text()[:-20])
    assert len(read_unity_motion(path, tmp_path / f"{NAME}_trans.txt")) == 9


def lines(path: Path, change) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())))


@pytest.mark.parametrize(
    ("suffix", "change", "message"),
    [
        ("pose", lambda rows: [*rows[:4], rows[4][:60], *rows[5:]], "line 5: .* numbers. Expected 75 or 72"),
        ("pose", lambda rows: [*rows[:4], rows[4].replace(" ", " nan ", 1), *rows[5:]], "line 5"),
        ("pose", lambda rows: [row.rsplit(" ", 1)[0] + " nan" for row in rows], "line 1"),
        ("trans", lambda rows: rows[:-4], "6 positions for 10 poses"),
        ("trans", lambda rows: [row + " 1.0" for row in rows], "4 numbers. Expected 3"),
        ("pose", lambda rows: [], "empty"),
    ],
)
def test_damaged_unity_text(suffix, change, message, tmp_path):
    write_unity(hps_files.motion(10), tmp_path)
    lines(tmp_path / f"{NAME}_{suffix}.txt", change)
    with pytest.raises(WearcapError, match=message):
        read_unity_motion(tmp_path / f"{NAME}_pose.txt", tmp_path / f"{NAME}_trans.txt")


class Bomb:
    def __reduce__(self):
        return print, ("this ran",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"poses": np.zeros((3, 72)), "transes": np.zeros((4, 3))}, "'transes' has shape"),
        ({"poses": np.zeros((3, 75)), "transes": np.zeros((3, 3))}, "'poses' has shape"),
        ({"poses": np.full((3, 72), np.nan), "transes": np.zeros((3, 3))}, "NaN"),
        ({"poses": np.zeros((3, 72))}, "no array 'transes'"),
        ({"poses": np.zeros((0, 72)), "transes": np.zeros((0, 3))}, "no frames"),
        ({"poses": "text", "transes": np.zeros((3, 3))}, "'poses'"),
        ({"poses": [[1.0], [1.0, 2.0]], "transes": np.zeros((3, 3))}, "'poses': no array of numbers"),
        ({"poses": ["x" * 100_000] + ["x"] * 5000, "transes": np.zeros((3, 3))}, "'poses': no array of numbers"),
        ([1, 2], "holds a list"),
        ({"poses": Bomb(), "transes": np.zeros((3, 3))}, "builtins.print"),
    ],
)
def test_hostile_motion(content, message, tmp_path, capsys):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(WearcapError, match=message):
        read_hps_motion(tmp_path / "a.pkl")
    assert "this ran" not in capsys.readouterr().out


def test_localization(tmp_path):
    truth = hps_files.motion()
    hps_files.write_localization(truth, tmp_path / "a.json", cam_start=0, lost=(4, 5))
    read = read_hps_localization(tmp_path / "a.json")
    assert len(read.timestamps) == FRAMES
    assert (read.confidence == 0).nonzero()[:, 0].tolist() == [4, 5]
    head = truth.joint("head")
    found = read.confidence > 0
    view = read.R_world_cam[..., 2]  # an OpenCV camera looks along z
    torch.testing.assert_close(view[found], head.R[found][..., 0], atol=1e-5, rtol=0)
    assert torch.isfinite(read.t_world_cam).all()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"0": None, "1": None}, "no frame has a pose"),
        ({}, "no frame has a pose"),
        ({"0": {"position": [0, 0, 0]}}, "frame 0: no pose"),
        ({"0": {"position": [0, 0], "quaternion": [1, 0, 0, 0]}}, "frame 0"),
        ({"0": {"position": [0, 0, 0], "quaternion": [2, 0, 0, 0]}}, "length 1"),
        ({"0": {"position": [0, float("nan"), 0], "quaternion": [1, 0, 0, 0]}}, "frame 0"),
        ({"first": None}, "frame 'first'"),
        ({"99999999999": None}, "frame '99999999999'"),
        ({"9" * 5000: None}, "frame '9999"),
        ({"0": None, "00": None}, "twice"),
        ([], "holds a list"),
    ],
)
def test_hostile_localization(rows, message, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(rows))
    with pytest.raises(WearcapError, match=message):
        read_hps_localization(tmp_path / "a.json")


def test_localization_at_30_hz(tmp_path):
    """Recorded at 29.97: a steady walk and turn stays steady, lost frames stay lost."""
    count, fps = 400, 30000 / 1001
    times = np.arange(count) / fps
    rows = {
        str(k): {"position": [1.2 * t, 0, 1.7], "quaternion": [math.cos(0.1 * t), 0, 0, math.sin(0.1 * t)]}
        for k, t in enumerate(times)
    }
    rows |= {str(k): None for k in range(100, 110)}
    (tmp_path / "a.json").write_text(json.dumps(rows))
    slow = read_hps_localization(tmp_path / "a.json", fps)
    read = resampled_localization(slow, 30.0)
    assert read.timestamps.diff().max() == pytest.approx(1 / 30)
    assert read.timestamps[-1] <= slow.timestamps[-1] + 1e-9
    found = read.confidence > 0
    gap = (read.timestamps > times[99] + 1e-3) & (read.timestamps < times[110] - 1e-3)
    assert torch.equal(~found, gap)
    t = read.timestamps[found]
    torch.testing.assert_close(read.t_world_cam[found, 0], (1.2 * t).float(), atol=1e-4, rtol=0)
    expected = rotation.about_axis("z", 0.2 * t).float()
    assert rotation.geodesic(read.R_world_cam[found], expected).max() < 1e-3


def test_a_lost_neighbour_does_not_pull_a_frame_that_all_but_coincides():
    times = torch.tensor([0.0, 0.9995, 2.0], dtype=torch.float64)
    position = torch.tensor([[0.0, 0, 0], [100.0, 50, 1.7], [0.0, 0, 0]])
    seen = Localization(times, torch.eye(3).repeat(3, 1, 1), position, torch.tensor([0.0, 1.0, 0.0]))
    read = resampled_localization(seen, 1.0)
    assert read.confidence.tolist() == [0.0, 1.0, 0.0]
    torch.testing.assert_close(read.t_world_cam[1], position[1])


def test_a_single_localised_frame_is_resampled_to_itself():
    one = Localization(torch.tensor([2.0], dtype=torch.float64), torch.eye(3)[None], torch.ones(1, 3), torch.ones(1))
    read = resampled_localization(one, 30.0)
    assert read.timestamps.tolist() == [2.0]
    assert read.confidence.tolist() == [1.0]
    torch.testing.assert_close(read.t_world_cam, one.t_world_cam)


@pytest.mark.parametrize(
    "content",
    ['{"cam_start": 3}', '{"cam_start": -1, "imu_start": 2}', "[]", "{", '{"cam_start": "a", "imu_start": 0}'],
)
def test_hostile_starts(content, tmp_path):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(WearcapError, match=r"a\.json"):
        read_hps_starts(tmp_path / "a.json")


@pytest.mark.parametrize(
    "content", [{}, {"betas": []}, {"betas": ["a"]}, {"betas": [float("inf")]}, {"betas": [0.1], "root_to_heel": "x"}]
)
def test_hostile_betas(content, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(WearcapError, match=r"a\.json"):
        read_hps_subject(tmp_path / "a.json")


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {}},
        {"captured_videos": None},
        {"parameters": {"focal_dist_xy": [871.8], "center_xy": [1, 2], "dist_coeffs": []}},
        {"parameters": {"focal_dist_xy": [0, 0], "center_xy": [1, 2], "dist_coeffs": []}},
        {"parameters": {"focal_dist_xy": [9, 9], "center_xy": [1, 2], "dist_coeffs": [0.1] * 14}},
    ],
)
def test_missing_intrinsics(change, tmp_path):
    (tmp_path / "cameras.json").write_text(json.dumps({"029756": hps_files.CAMERA["029756"] | change}))
    with pytest.raises(WearcapError, match="camera '029756'"):
        read_hps_cameras(tmp_path / "cameras.json")


# Fuzz --------------------------------------------------------------------------------------------------------------


def small_pickle() -> bytes:
    return pickle.dumps({"poses": np.zeros((2, 72)), "transes": np.zeros((2, 3))})


@fuzz
@given(damaged=mutated_bytes(small_pickle()))
def test_fuzzed_motion(damaged, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "fuzzed.pkl"
    path.write_bytes(damaged)
    with suppress(WearcapError):
        read_hps_motion(path)


@fuzz
@given(damaged=mutated('{"0": {"position": [1.0, 2, 3], "quaternion": [1, 0, 0, 0]}, "1": null, "2": null}'))
def test_fuzzed_localization(damaged, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    path.write_text(damaged)
    with suppress(WearcapError):
        read_hps_localization(path)
