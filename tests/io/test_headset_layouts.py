"""Headset logs in the layouts of public recorders: times and poses are those that an independent writer put there."""

import json
import struct

import numpy as np
import pytest

import short_walk
from headset_tables import (
    POSES,
    SIDES,
    TIME,
    R,
    T,
    all_seven,
    compare,
    csv,
    euler_angles,
    matrices,
    names_of,
    seven,
    texts,
    write,
)
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.devices.headset_log import is_headset_log, is_headset_session, read_headset_log, read_raw_poses

# --- layouts -------------------------------------------------------------------------------------------------------


def quest(folder):
    """Meta XR: milliseconds since 1970, a frame's number, the program's time."""
    names = "timestamp_ms,frame,unity_time," + names_of("{d}_{q}_{a}", ("hmd", "left", "right"))
    return csv(folder / "a.csv", names, np.round(TIME * 1e3), np.arange(len(TIME)), TIME, all_seven()), {}


def pico(folder):
    """XRoboToolkit: texts of seven numbers, nanoseconds."""
    frames = [
        {
            "timeStampNs": round(moment * 1e9),
            "Head": {"pose": ",".join(f"{value:.7f}" for value in seven("head")[k]), "status": 3},
            "Controller": {
                side: {"axisX": 0.0, "pose": ",".join(f"{value:.7f}" for value in seven(side)[k])}
                for side in ("left", "right")
            },
        }
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.jsonl", "\n".join(map(json.dumps, frames))), {}


def openvr(folder):
    """Rows of HmdMatrix34_t, by name."""
    names = ["time"] + [
        f"{device}_m{i}{j}" for device in ("HMD", "LeftTracker", "RightTracker") for i in range(3) for j in range(4)
    ]
    parts = [matrices(device)[:, :3].reshape(len(TIME), 12) for device in POSES]
    return csv(folder / "a.csv", ",".join(names), TIME, *parts), {}


def hololens(folder):
    """HoloLens2ForCV's head_hand_eye.csv: no header, Windows' file times, 4 x 4 matrices of the head and of 26 joints."""
    ticks = [str(116444736000000000 + round((1.7e9 + moment) * 1e7)) for moment in TIME]
    parts = [matrices("head").reshape(len(TIME), 16)]
    for side in ("left", "right"):
        joints = np.random.default_rng(0).normal(size=(len(TIME), 26, 16))
        joints[:, 1] = matrices(side).reshape(len(TIME), 16)
        parts += [np.ones((len(TIME), 1)), joints.reshape(len(TIME), -1)]
    rows = texts(ticks, *parts, np.zeros((len(TIME), 10)))
    return write(folder / "head_hand_eye.csv", "\n".join(map(",".join, rows))), {"start": 1.7e9 + TIME[0]}


def webxr(folder):
    """The viewer's pose and a list of input sources, with w = 1 of positions."""

    def pose(device, k):
        return {
            "position": dict(zip("xyzw", [*seven(device)[k, :3], 1.0])),
            "orientation": dict(zip("xyzw", seven(device)[k, 3:])),
            "inverse": {},
        }

    frames = [
        {
            "time": moment * 1e3,
            "viewer": {"transform": pose("head", k)},
            "inputSources": [
                {"handedness": side, "targetRayMode": "tracked-pointer", "gripSpace": pose(side, k)}
                for side in ("left", "right")
            ],
        }
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.json", json.dumps({"session": "immersive-vr", "frames": frames})), {}


def a_frame(folder):
    """Euler angles beside quaternions: the quaternions count."""

    def part(device, k):
        return {
            "position": dict(zip("xyz", seven(device)[k, :3])),
            "rotation": {"x": 12.0, "y": 3.0, "z": -4.0},
            "quaternion": dict(zip("xyzw", seven(device)[k, 3:])),
            "trigger": 0,
        }

    frames = [
        {
            "timestamp": round(moment * 1e3),
            "leftController": part("left", k),
            "rightController": part("right", k),
            "headset": part("head", k),
        }
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.json", json.dumps(frames)), {}


def vision_pro(folder):
    """Transforms as columns of a simd_float4x4, in lists of lists."""
    key = {"head": "deviceAnchor", "left": "leftHandAnchor", "right": "rightHandAnchor"}
    frames = [
        {
            "timestamp": moment,
            **{name: {"originFromAnchorTransform": matrices(device)[k].T.tolist()} for device, name in key.items()},
        }
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.json", json.dumps(frames)), {"devices": {"head": "head"}}


def flat_columns(folder):
    """Sixteen numbers, column by column."""
    frames = [
        {"t": moment, **{f"{device}_transform": matrices(device)[k].T.ravel().tolist() for device in POSES}}
        for k, moment in enumerate(TIME.tolist())
    ]
    return write(folder / "a.jsonl", "\n".join(map(json.dumps, frames))), {}


def alyx(folder):
    """Who-is-Alyx: centimetres, milliseconds since the start."""
    names = "delta_time_ms," + names_of("{d}_{q}_{a}", ("hmd", "left_controller", "right_controller"))
    return csv(folder / "a.csv", names, (TIME - TIME[0]) * 1e3, all_seven(100.0)), {"start": 0.0, "scale": 100.0}


def vectors(folder):
    """Unity's Vector3.ToString() in one field, semicolons and quotes, milliseconds."""

    def shown(values):
        return ['"(' + ", ".join(f"{value:.5f}" for value in row) + ')"' for row in values]

    names = "Time;HMDPosition;HMDRotation;LeftHandPosition;LeftHandRotation;RightHandPosition;RightHandRotation"
    parts = [shown(half) for device in POSES for half in (seven(device)[:, :3], seven(device)[:, 3:])]
    path = csv(folder / "a.csv", names, TIME * 1e3, *parts, between=";")
    return path, {"within": 1e-5, "turned": 0.1}


def bare_vectors(folder):
    """The same between commas without quotes, with decimal commas."""

    def shown(values):
        return ["(" + ", ".join(f"{value:.5f}".replace(".", ",") for value in row) + ")" for row in values]

    parts = [shown(half) for device in POSES for half in (seven(device)[:, :3], seven(device)[:, 3:])]
    names = "Time,HeadPosition,HeadRotation,LeftPosition,LeftRotation,RightPosition,RightRotation"
    return csv(folder / "a.csv", names, TIME, *parts), {"within": 1e-5, "turned": 0.1}


def decimal_commas(folder):
    path = csv(folder / "a.csv", ("time," + names_of("{d}_{q}_{a}")).replace(",", ";"), TIME, all_seven(), between=";")
    body = path.read_text().replace(".", ",")
    return write(path, body), {}


def long_form(folder):
    """A row per device and time; other trackers stand between."""
    rows = ["time,source,posX,posY,posZ,rotX,rotY,rotZ,rotW"]
    for k, moment in enumerate(TIME):
        for label, device in (
            ("HMD", "head"),
            ("LeftController", "left"),
            ("WaistTracker", "head"),
            ("RightController", "right"),
        ):
            rows.append(f"{moment:.6f},{label}," + ",".join(f"{value:.7f}" for value in seven(device)[k]))
    return write(folder / "a.csv", "\n".join(rows)), {}


def long_json(folder):
    """One object a line and device."""
    lines = [
        json.dumps(
            {
                "ts": moment,
                "device": label,
                "position": seven(device)[k, :3].tolist(),
                "quaternion_xyzw": seven(device)[k, 3:].tolist(),
            }
        )
        for k, moment in enumerate(TIME.tolist())
        for label, device in (("/user/head", "head"), ("/user/hand/left", "left"), ("/user/hand/right", "right"))
    ]
    return write(folder / "a.jsonl", "\n".join(lines)), {}


def euler(folder):
    names = "Frame,Time," + ",".join(
        f"{d}_{q}_{a}" for d in ("HMD", "L_ctrl", "R_ctrl") for q in ("Pos", "Rot") for a in "xyz"
    )
    parts = [part for device in POSES for part in (POSES[device][1], euler_angles(device))]
    return csv(folder / "a.csv", names, np.arange(len(TIME)), TIME, *parts), {}


def session(folder):
    """A file per device, two clocks: the finer one counts."""
    for name, device in (("hmd_poses", "head"), ("left_controller_poses", "left"), ("right_controller_poses", "right")):
        csv(
            folder / "s" / f"{name}.csv",
            "unix_time,ovr_timestamp,pos_x,pos_y,pos_z,rot_x,rot_y,rot_z,rot_w",
            np.floor(TIME * 1e3),
            TIME,
            seven(device),
        )
    write(folder / "s" / "info.csv", "participant,age\nA. Nonymous,33\n")
    return folder / "s", {"late": 1e-6}


def replay(folder, modifiers="", practice=0.0, speed=1.0):
    """Beat Saber's: players' names stay out."""

    def text(value):
        return struct.pack("<i", len(value.encode())) + value.encode()

    info = b"".join(
        map(text, ["1", "1.29", "0", "7656", "A. Nonymous", "steam", "OpenVR", "Index", "Knuckles", "ab", "Söng"])
    )
    content = struct.pack("<IBB", 0x442D3D69, 1, 0) + info + text("me") + text("Expert") + struct.pack("<i", 5)
    content += text("Standard") + text("") + text(modifiers) + struct.pack("<f?4f", 18, False, 1.7, 0, 0, practice)
    content += struct.pack("<Bi", 1, len(TIME))
    for k, moment in enumerate(TIME - TIME[0]):
        content += struct.pack("<fi21f", moment * speed, 90, *all_seven()[k])
    (folder / "a.bsor").write_bytes(content + struct.pack("<Bi", 2, 0))
    return folder / "a.bsor", {"start": 0.0}


@pytest.mark.parametrize(
    ("modifiers", "practice", "speed"), [("GN,FS", 0.0, 1.2), ("SS", 0.0, 0.85), ("", 0.5, 0.5), ("NF", 1.0, 1.0)]
)
def test_a_replay_in_the_songs_time(tmp_path, modifiers, practice, speed):
    compare(replay(tmp_path, modifiers, practice, speed)[0], 0.0)


LAYOUTS = [
    quest,
    pico,
    openvr,
    hololens,
    webxr,
    a_frame,
    vision_pro,
    flat_columns,
    alyx,
    vectors,
    bare_vectors,
    decimal_commas,
]
LAYOUTS += [long_form, long_json, euler, session, replay]


FIXED = {hololens: "openxr", webxr: "openxr", vision_pro: "openxr", euler: "unity", replay: "unity"}
"""Conventions by recorder; of other logs they follow from the poses."""


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_layouts(tmp_path, layout):
    path, how = layout(tmp_path)
    assert is_headset_session(path) if path.is_dir() else is_headset_log(path)
    _, convention, notes = compare(path, **how)
    assert convention == FIXED.get(layout)
    assert "Nonymous" not in str(notes)


def test_unreals_rotators(tmp_path):
    """Pitch, yaw, roll in degrees; Unreal turns (left-handed, z up, x ahead) by its rotation matrix of them."""
    pitch, yaw, roll = (np.radians(30 * np.sin(speed * TIME)) for speed in (1.0, 2.0, 3.0))
    cp, sp, cy, sy, cr, sr = (f(angle) for angle in (pitch, yaw, roll) for f in (np.cos, np.sin))
    x = np.stack([cp * cy, cp * sy, sp], 1)
    y = np.stack([sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp], 1)
    z = np.stack([-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp], 1)
    path = csv(
        tmp_path / "a.csv",
        "time,HMD_x,HMD_y,HMD_z,HMD_pitch,HMD_yaw,HMD_roll",
        TIME,
        T * 100,
        *(np.degrees(a) for a in (pitch, yaw, roll)),
    )
    poses, _, convention, notes = read_raw_poses(path)
    assert "pitch, yaw and roll in degrees as Unreal's" in notes
    assert convention == "unreal"
    assert np.abs(poses["head"].rotation - np.stack([x, y, z], 2)).max() < 1e-6


def test_unitys_angles_by_the_names_of_unreal(tmp_path):
    """Pitch, yaw, roll in Unity's axes: read so where the axes are stated, else the question is put."""
    angles = euler_angles("head")
    path = csv(tmp_path / "a.csv", "time,HMD_x,HMD_y,HMD_z,HMD_pitch,HMD_yaw,HMD_roll", TIME, POSES["head"][1], angles)
    with pytest.raises(WearcapError, match="y seems to be up"):
        read_headset_log(path)
    found = read_headset_log(path, Conventions(axes="unity"))
    assert max(short_walk.apart(found.head, TIME, R, T)) < 0.02


def test_trials_of_a_session_are_one_recording_with_a_gap(tmp_path):
    cut = 100
    for name, device in (("headset", "head"), ("left_controller", "left"), ("right_controller", "right")):
        whole = np.concatenate([POSES[device][1], euler_angles(device)], 1)
        for trial, part in (("001", slice(0, cut)), ("002", slice(cut + 60, None))):
            csv(
                tmp_path / "S001" / "trackers" / f"{name}_movement_T{trial}.csv",
                "time,pos_x,pos_y,pos_z,rot_x,rot_y,rot_z",
                TIME[part],
                whole[part],
            )
    write(tmp_path / "S001" / "trial_results.csv", "experiment,ppid,trial_num\nwalk,A. Nonymous,1\n")
    assert is_headset_session(tmp_path / "S001")
    poses, _, convention, notes = read_raw_poses(tmp_path / "S001")
    kept = np.r_[0:cut, cut + 60 : len(TIME)]
    assert convention == "unity"
    assert "2 trials of a UXF session in one recording" in notes
    for joint, device in SIDES.items():
        assert np.abs(poses[joint].seconds - TIME[kept]).max() < 1e-6
        assert np.abs(poses[joint].position - POSES[device][1][kept]).max() < 1e-6
    log = read_headset_log(tmp_path / "S001", Conventions(axes="unity"))
    assert len(log.head) == len(kept)


# --- what is no log ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [4, 30, 150, 1000, -9])
def test_a_replay_cut_short(tmp_path, size):
    whole, _ = replay(tmp_path)
    (tmp_path / "cut.bsor").write_bytes(whole.read_bytes()[:size])
    with pytest.raises(WearcapError):
        read_raw_poses(tmp_path / "cut.bsor")


@pytest.mark.parametrize("count", [2**31 - 1, -1])
def test_a_replay_with_a_wrong_count(tmp_path, count):
    content = replay(tmp_path)[0].read_bytes()
    at = content.index(struct.pack("<Bi", 1, len(TIME)))
    (tmp_path / "a.bsor").write_bytes(content[:at] + struct.pack("<Bi", 1, count) + content[at + 5 :])
    with pytest.raises(WearcapError, match="frames"):
        read_raw_poses(tmp_path / "a.bsor")


def test_angles_that_may_be_radians(tmp_path):
    parts = [part for device in POSES for part in (POSES[device][1], np.radians(euler_angles(device)))]
    names = "time," + ",".join(f"{d}_{q}_{a}" for d in POSES for q in ("pos", "rot") for a in "xyz")
    with pytest.raises(WearcapError, match="may be radians"):
        read_raw_poses(csv(tmp_path / "a.csv", names, TIME, *parts))


def test_folders_that_are_no_sessions(tmp_path):
    write(tmp_path / "a" / "left.csv", "time,pos_x,pos_y,pos_z,rot_x,rot_y,rot_z,rot_w\n0,0,1,0,0,0,0,1\n")
    assert not is_headset_session(tmp_path / "a")
    for name in ("walk_head", "run_head"):
        csv(tmp_path / "b" / f"{name}.csv", "time,pos_x,pos_y,pos_z,rot_x,rot_y,rot_z,rot_w", TIME, seven("head"))
    assert not is_headset_session(tmp_path / "b")
    with pytest.raises(WearcapError, match="no session"):
        read_headset_log(tmp_path / "b")


# --- field inputs --------------------------------------------------------------------------------------------------


@pytest.mark.real
@pytest.mark.parametrize("name", ["J_hs_clock.csv", "J_hs_iso.csv", "J_hs_ticks.csv", "J_hs_euler.csv"])
def test_field_logs_agree_with_each_other(real_data, name):
    """One walk at 72 Hz in four layouts."""
    poses, _, _, _ = read_raw_poses(real_data / "field" / name)
    head = poses["head"]
    assert len(head.seconds) == 899
    assert np.abs(head.seconds - head.seconds[0] - np.arange(899) / 72).max() < 1.1e-3
    assert head.position[-1] == pytest.approx([-12.635333, 1.576362, 5.914915], abs=2e-5)


@pytest.mark.real
@pytest.mark.parametrize("name", ["S_unity_euler.csv", "S_uxf_session", "K_quest_session", "R_right_hand_late.csv"])
def test_field_sessions(real_data, name):
    poses, _, convention, notes = read_raw_poses(real_data / "field" / name)
    assert set(poses) == set(SIDES)
    assert convention == ("unity" if name.startswith("S") else None)
    assert len(poses["head"].seconds) == {"K": 1080, "R": 420, "S": 720}[name[0]]
    assert any("5.0 s are left out" in note for note in notes) == name.startswith("R")
    assert "P01" not in str(notes)
