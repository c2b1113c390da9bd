"""Headsets' axes, units and orders of quaternions: written by SciPy in every convention, read as the same wearer or asked."""

import lzma

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.devices.headset_axes import HeadsetLog, in_our_axes
from wearcap.io.devices.headset_log import read_headset_log
from wearcap.io.devices.headset_tables import RawPoses

TO_OURS = {
    "openxr": np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "unity": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "unreal": np.diag([1.0, -1.0, 1.0]),
    "head": np.eye(3),
}
"""Columns: a convention's axes, ahead, left and up."""
POSTURES = {
    "ahead": (5, (0.35, 0.2, -0.35), True),
    "hanging": (5, (0.05, 0.25, -0.7), True),
    "behind": (18, (-0.12, 0.2, -0.65), True),
    "down": (52, (0.0, 0.25, -0.7), True),
    "far down": (74, (0.1, 0.25, -0.7), True),
    "standing": (8, (0.1, 0.25, -0.7), False),
    "standing, behind": (20, (-0.14, 0.2, -0.65), False),
}
"""Pitch (degrees down), the left hand seen from the neck (m; ahead, left, up), and whether the wearer walks."""
PER_UNIT = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def wearer(posture: str, seconds: float = 12.0, fps: float = 30.0):
    """Times (s), and {joint: (rotations, places in m)} of somebody whose head turns on a neck; x ahead, y left, z up."""
    pitch, (ahead, aside, below), walks = POSTURES[posture]
    time = np.arange(int(seconds * fps)) / fps
    course = 0.25 * time + 0.3 * np.sin(0.5 * time) if walks else 0.1 * np.sin(0.4 * time)
    step = np.stack([np.cos(course), np.sin(course)], 1) * 1.1 * walks / fps
    neck = np.concatenate([np.cumsum(step, 0), 1.52 + 0.015 * walks * np.sin(11 * time)[:, None]], 1)
    turn = np.stack(
        [course + 0.4 * np.sin(1.3 * time), np.radians(pitch) + 0.12 * np.sin(2.1 * time), 0.05 * np.sin(1.7 * time)], 1
    )
    head, body = Rotation.from_euler("ZYX", turn), Rotation.from_euler("z", course[:, None])
    poses = {"head": (head.as_matrix(), neck + head.apply([0.1, 0.0, 0.1]))}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = 0.12 * walks * np.sin(5.5 * time + sign)
        at = np.stack([ahead + swing, sign * aside + 0 * time, below + 0 * time], 1)
        arm = Rotation.from_euler("ZYX", np.stack([0.2 * sign + 0 * time, 0.9 + swing, 0.1 * sign + swing], 1))
        poses[f"{side}_wrist"] = (body * arm).as_matrix(), neck + body.apply(at)
    return time, poses


def written(time, poses, convention: str, order: str, unit: str, named: bool = False) -> dict[str, RawPoses]:
    """Poses as a file has them."""
    M, found = TO_OURS[convention], {}
    for joint, (R, t) in poses.items():
        quat = Rotation.from_matrix(M.T @ R @ M).as_quat()[:, ["xyzw".index(axis) for axis in order]]
        found[joint] = RawPoses(time, t @ M * PER_UNIT[unit], quat, order if named else None, ("grip",))
    return found


def assert_is(found: HeadsetLog, poses, convention: str) -> None:
    """The head and the hands' palms are where they were made (1 mm, 0.1°)."""
    assert found.axes == convention
    R, t = poses["head"]
    assert np.abs(found.head.t_world_body.numpy() - t).max() < 1e-3
    off = Rotation.from_matrix(np.swapaxes(found.head.R_world_body.double().numpy(), 1, 2) @ R).magnitude()
    assert np.degrees(off.max()) < 0.1
    for joint, wrist in found.wrists.items():
        assert np.linalg.norm(wrist.t_world_body.numpy() - poses[joint][1], axis=1).max() == pytest.approx(
            0.08, abs=1e-3
        )


@pytest.mark.parametrize("posture", POSTURES)
@pytest.mark.parametrize("convention", TO_OURS)
@pytest.mark.parametrize("unit", PER_UNIT)
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_every_posture_in_every_writing(posture, convention, unit, order):
    """Neither order, axes nor unit are named."""
    time, poses = wearer(posture)
    raw = written(time, poses, convention, order, unit)
    found = in_our_axes(raw, Conventions(), "log")
    assert_is(found, poses, convention)
    notes = "\n".join(found.notes)
    assert f"axes {convention}" in notes
    assert f"quaternions {order}" in notes
    assert ("unit " in notes) == (unit != "m")
    assert found.floor


def test_what_is_stated_wins():
    """Unity's axes stated of an OpenXR log; a unit of feet, which is not detected."""
    time, poses = wearer("ahead")
    raw = written(time, poses, "openxr", "xyzw", "m", named=True)
    found = in_our_axes(raw, Conventions(axes="unity"), "log")
    assert found.axes == "unity"
    assert np.abs(found.head.t_world_body.numpy() - poses["head"][1] * [-1, 1, 1]).max() < 1e-3
    for name, metres in (("foot", 0.3048), ("inch", 0.0254)):
        other = {j: RawPoses(p.seconds, p.position / metres, p.rotation, p.order, p.families) for j, p in raw.items()}
        with pytest.raises(WearcapError, match="no unit of length fits.*unit=m|cm|mm"):
            in_our_axes(other, Conventions(), "log")
        assert_is(in_our_axes(other, Conventions(unit=name), "log"), poses, "openxr")


def test_a_recentred_origin_has_no_height():
    """The unit follows from how far the hands are from the head; alone the head's speed says that it is no metre."""
    time, poses = wearer("ahead")
    moved = {joint: (R, t - [0, 0, 1.6]) for joint, (R, t) in poses.items()}
    for unit in PER_UNIT:
        raw = written(time, moved, "unity", "xyzw", unit, named=True)
        for devices in (raw, {"head": raw["head"]}):
            found = in_our_axes(devices, Conventions(axes="unity"), "log")
            assert_is(found, moved, "unity")
            assert not found.floor


def test_what_the_format_fixes_decides_where_habits_do_not():
    """Head alone, standing without a turn: nothing shows what is ahead, and all candidates are named."""
    time = np.arange(300) / 60
    still = {"head": (np.tile(np.eye(3), (len(time), 1, 1)), np.tile([0.0, 0.0, 1.6], (len(time), 1)))}
    raw = written(time, still, "unity", "xyzw", "m", named=True)
    with pytest.raises(WearcapError, match="not certain: .*Say which: axes=.*openxr.*unity"):
        in_our_axes(raw, Conventions(), "log")
    assert_is(in_our_axes(raw, Conventions(), "log", "unity"), still, "unity")


def test_hand_joints_show_the_elbows():
    """Hands that hang behind the back of somebody who stands and looks ahead: fingers point down, not up."""
    time, poses = wearer("standing, behind")
    R = poses["head"][0]
    level = Rotation.from_euler("z", np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None])
    poses["head"] = level.as_matrix(), np.tile([0.0, 0.0, 1.62], (len(time), 1))
    down = (level * Rotation.from_euler("y", 80, degrees=True)).as_matrix()
    for joint in ("left_wrist", "right_wrist"):
        poses[joint] = down, poses[joint][1]
    raw = written(time, poses, "openxr", "xyzw", "m", named=True)
    assert in_our_axes(raw, Conventions(hands="wrist"), "log").axes == "openxr"
    with pytest.raises(WearcapError, match="axes=openxr.unity"):
        in_our_axes(raw, Conventions(hands="grip"), "log")


def test_a_head_on_its_side_is_refused():
    time, poses = wearer("ahead")
    R, t = poses["head"]
    lying = R @ Rotation.from_euler("x", 90, degrees=True).as_matrix()
    raw = written(time, {"head": (lying, t)}, "openxr", "xyzw", "m", named=True)
    with pytest.raises(WearcapError, match="the headset is upright"):
        in_our_axes(raw, Conventions(), "log")


# --- real people -----------------------------------------------------------------------------------------------------


def of_players(path):
    """Head (eyes 10 cm before and 8 cm above its joint) and wrists of a BVH by SciPy: x ahead, y left, z up."""
    words = lzma.decompress(path.read_bytes()).decode().split()
    begin, names, parents, offsets, open_joints, channels = words.index("MOTION"), [], [], [], [], []
    for k, word in enumerate(words[:begin]):
        if word in ("ROOT", "JOINT"):
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(words[k + 1])
            offsets.append(None)
        elif word == "{":
            open_joints.append(len(names) - 1)
        elif word == "}":
            open_joints.pop()
        elif word == "OFFSET" and offsets[-1] is None:
            offsets[-1] = np.array(words[k + 1 : k + 4], float)
        elif word == "CHANNELS":
            channels.append(int(words[k + 1]))
    numbers = np.array(words[begin + 6 :], float).reshape(int(words[begin + 2]), -1)
    R, t = {}, {}
    for joint, (parent, end, count) in enumerate(zip(parents, np.cumsum(channels), channels, strict=True)):
        turn = Rotation.from_euler("ZXY", numbers[:, end - 3 : end], degrees=True)
        R[joint] = turn if parent < 0 else R[parent] * turn
        t[joint] = numbers[:, :3] if count == 6 else t[parent] + R[parent].apply(offsets[joint])
    turned = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = {}
    for name, joint in (("head", "Head"), ("left_wrist", "LeftHand"), ("right_wrist", "RightHand")):
        at = names.index(joint)
        place = t[at] + (R[at].apply([0.0, 0.08, 0.1]) if name == "head" else 0.0)
        found[name] = turned @ R[at].as_matrix() @ turned.T, place @ turned.T
    return np.arange(len(numbers)) * float(words[begin + 5]), found


CROSSED = {"beatsaber_8", "beatsaber_11", "jobsimulator_9"}
"""Clips in which the hands are less than 8 cm apart sideways, in the median: left and right look alike."""


@pytest.mark.real
def test_players_of_games(real_data):
    """16 clips of 2 to 3 minutes, of fights, dances and work with the hands: each is read in the axes it is written in."""
    clips = sorted((real_data / "fubot_vr" / "trials").glob("*.bvh.xz"))
    assert len(clips) == 16
    asked = set()
    for path in clips:
        time, poses = of_players(path)
        for convention, order, unit in zip(TO_OURS, ("wxyz", "xyzw") * 2, ("m", "cm", "mm", "m"), strict=True):
            try:
                found = in_our_axes(written(time, poses, convention, order, unit), Conventions(), path.name)
            except WearcapError:
                asked.add((path.name.split(".")[0], convention))
            else:
                assert_is(found, poses, convention)
    assert asked <= {(name, axes) for name in CROSSED for axes in ("unreal", "head")}


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "axes"),
    [
        ("P_openxr_hands_behind.csv", "openxr"),
        ("Q_looking_down.csv", "openxr"),
        ("R_right_hand_late.csv", "openxr"),
        ("I_hs_unity_cm.csv", "unity"),
        ("J_hs_unreal_cm.csv", "unreal"),
        ("S_unity_euler.csv", "unity"),
        ("../quest_azure_kinect/HMD_P01_Session01_20260114_155558.csv", "unity"),
        ("../quest_azure_kinect/HMD_P01_Session01_20260114_161518.csv", "unity"),
    ],
)
def test_files_of_users(real_data, name, axes):
    found = read_headset_log(real_data / "field" / name)
    assert found.axes == axes
    assert found.floor
    assert 1.1 < found.head.t_world_body[:, 2].median() < 1.7
    assert ("unit cm" in " ".join(found.notes)) == ("_cm" in name)


@pytest.mark.real
def test_who_stands_with_the_hands_behind_the_back_is_asked(real_data):
    with pytest.raises(WearcapError, match="Say which: axes=openxr.unity"):
        read_headset_log(real_data / "field" / "P_openxr_hands_behind_standing.csv")
