"""Headsets' logs: every axis convention, hand pose and way of naming columns gives the same short walk."""

import json

import numpy as np
import pytest

import short_walk
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.devices.headset_log import is_headset_log, read_headset_log

SNAKE = {
    "time": "time",
    "head": "head_{quantity}_{axis}",
    "left": "left_hand_{quantity}_{axis}",
    "right": "right_hand_{quantity}_{axis}",
}
WRIST = {
    "time": "timestamp [ms]",
    "head": "HMD.{quantity}.{axis}",
    "left": "LeftWrist.{quantity}.{axis}",
    "right": "RightWrist.{quantity}.{axis}",
    "quantities": "position rotation",
}
CAMEL = {
    "time": "timeStampMs",
    "head": "head{quantity}{axis}",
    "left": "leftController{quantity}{axis}",
    "right": "rightController{quantity}{axis}",
    "quantities": "Pos Quat",
    "axes": "XYZ",
    "quat": "XYZW",
}
GLUED = {
    "time": "t",
    "head": "hmd_{quantity}{axis}",
    "left": "l_{quantity}{axis}",
    "right": "r_{quantity}{axis}",
    "quantities": "p q",
}


def compare(found, time, R, t) -> None:
    """Head and wrists as they were made: 1 mm, 0.1°."""
    for track, pose in (
        (found.head, (R, t)),
        *((found.wrists[f"{side}_wrist"], pose) for side, pose in short_walk.wrists(time, R, t).items()),
    ):
        late, off, turned = short_walk.apart(track, time, *pose)
        assert late < 2e-3
        assert off < 1e-3
        assert turned < 0.1


@pytest.mark.parametrize("convention", ["unity", "openxr", "steamvr"])
@pytest.mark.parametrize("kind", ["wrist", "grip", "aim"])
@pytest.mark.parametrize("given", [True, False])
def test_conventions_are_detected_or_given(tmp_path, convention, kind, given):
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, convention, kind)
    path = short_walk.headset_csv(tmp_path / "a.csv", time, poses, SNAKE)
    found = read_headset_log(path, Conventions(axes=convention if given else "auto", hands=kind))
    compare(found, time, R, t)
    assert found.axes == (convention if given or convention == "unity" else "openxr")
    assert found.floor
    assert any("axes" in note for note in found.notes)


@pytest.mark.parametrize(
    ("names", "kind", "scale"), [(SNAKE, "grip", 1.0), (WRIST, "wrist", 1e3), (CAMEL, "aim", 1e3), (GLUED, "grip", 1.0)]
)
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
@pytest.mark.parametrize("between", [",", ";", "\t"])
def test_names_of_columns(tmp_path, names, kind, scale, order, between):
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, "unity", kind)
    names = names | ({"quat": "WXYZ" if order == "wxyz" else "XYZW"} if "quat" in names else {})
    path = short_walk.headset_csv(tmp_path / "a.csv", time * scale, poses, names, order, between)
    assert is_headset_log(path)
    compare(read_headset_log(path), time, R, t)


@pytest.mark.parametrize("layout", ["list", "object", "lines"])
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_json(tmp_path, layout, order):
    """Quaternions as arrays: their order is the one in which the head is upright."""
    time, R, t = short_walk.walk()
    frames = short_walk.headset_frames(time, short_walk.headset_poses(time, R, t, "openxr", "grip"), order, "devices")
    text = {
        "list": lambda: json.dumps(frames),
        "object": lambda: json.dumps({"app": "x", "frames": frames}, indent=1),
        "lines": lambda: "\n".join(map(json.dumps, frames)),
    }[layout]()
    (tmp_path / "a.json").write_text(text)
    assert is_headset_log(tmp_path / "a.json")
    found = read_headset_log(tmp_path / "a.json")
    compare(found, time, R, t)
    assert any(f"quaternions {order}" in note for note in found.notes)


def test_matrices_of_steamvr(tmp_path):
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, "steamvr", "grip")
    frames = [
        {
            "time": moment,
            **{
                name: {"matrix": np.concatenate([turn[k], at[k][:, None]], 1).ravel().tolist()}
                for name, (turn, at) in poses.items()
            },
        }
        for k, moment in enumerate(time.tolist())
    ]
    (tmp_path / "a.json").write_text(json.dumps(frames))
    compare(read_headset_log(tmp_path / "a.json"), time, R, t)


def test_hands_that_are_lost(tmp_path):
    """Empty fields, zeros and null are no poses; the head goes on."""
    time, R, t = short_walk.walk()
    poses = short_walk.headset_poses(time, R, t, "unity", "grip")
    path = short_walk.headset_csv(tmp_path / "a.csv", time, poses, SNAKE)
    rows = path.read_text().splitlines()
    for k in range(50, 80):
        fields = rows[k].split(",")
        fields[8:15] = [""] * 7 if k % 2 else ["0"] * 6 + ["1"]
        rows[k] = ",".join(fields)
    path.write_text("\n".join(rows) + "\n")
    found = read_headset_log(path)
    assert len(found.head) == len(time)
    assert len(found.wrists["left_wrist"]) == len(time) - 30
    assert "left_wrist is not tracked in 30 of 240 rows" in found.notes


def test_the_axes_of_a_seated_player_follow_from_the_hands(tmp_path):
    time, R, t = short_walk.walk()
    t = t * [0, 0, 1] + [0.3, 0.1, -0.4]
    R = R * 0 + np.eye(3)
    poses = short_walk.headset_poses(time, R, t, "unity", "grip")
    found = read_headset_log(short_walk.headset_csv(tmp_path / "a.csv", time, poses, SNAKE))
    assert found.axes == "unity"
    alone = {"head": poses["head"]}
    path = short_walk.headset_csv(tmp_path / "b.csv", time, alone, SNAKE)
    with pytest.raises(WearcapError, match="axes=unity|openxr|steamvr"):
        read_headset_log(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("time,a,b\n1,2,3\n", "no pose of a headset"),
        (
            "head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w\n1,2,3,0,0,0,1\n",
            "no column of time",
        ),
        ("time,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w\n", "no rows"),
        (
            "time,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w\n0,1\n",
            "line 2 has 2 fields",
        ),
        (
            "time,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w\n0,1,2,x,0,0,0,1\n",
            "line 2: 'x' of head",
        ),
        (
            "time,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w\n0,1,2,3,0,0,0,1\n0,1,2,3,0,0,0,1\n",
            "no two tracked poses",
        ),
        ("time,device,px,py,pz,qx,qy,qz,qw\n,HMD,1,2,3,0,0,0,1\n1,left,1,2,3,0,0,0,1\n", "no rows of the head"),
        ("[1, 2]", "no frames"),
        ('{"frames": 3}', "no frames"),
    ],
)
def test_defects(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(WearcapError, match=message):
        read_headset_log(tmp_path / "a.csv")
    if text:
        assert is_headset_log(tmp_path / "a.csv") == ("time,head" in text or "HMD" in text)
