"""BVH as public programs export it: every joint stands where the writer's own forward kinematics puts it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from foreign_bvh import CONVENTIONS, Z_UP, Convention, _names, walk, write
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.prepare.foreign_files import read_take

NEURON = "Hips Spine Spine1 Spine2 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}UpLeg {s}Leg {s}Foot -"
MOTIVE = "Hip Ab - Chest Neck Head {s}Shoulder {s}UArm {s}FArm {s}Hand {s}Thigh {s}Shin {s}Foot {s}Toe"
DEEPMOTION = (
    "hips_JNT spine_JNT spine1_JNT spine2_JNT neck_JNT head_JNT {s}_shoulder_JNT {s}_arm_JNT {s}_forearm_JNT {s}_hand_JNT "
    "{s}_upleg_JNT {s}_leg_JNT {s}_foot_JNT {s}_toebase_JNT"
)
QUALISYS = "Hips Spine Spine1 Spine2 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}UpLeg {s}Leg {s}Foot {s}ToeBase"
ICLONE = (
    "Hip Waist Spine01 Spine02 NeckTwist01 Head {s}_Clavicle {s}_Upperarm {s}_Forearm {s}_Hand {s}_Thigh {s}_Calf {s}_Foot "
    "{s}_ToeBase"
)
ROKOKO = "Hips Spine2 Spine3 Spine4 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}Thigh {s}Shin {s}Foot {s}Toe"
NAMCO = "Hips Spine - Chest Neck Head Shoulder_{s} UpperArm_{s} LowerArm_{s} Hand_{s} UpperLeg_{s} LowerLeg_{s} Foot_{s} Toes_{s}"
FINGERS = (
    ("left_HandThumb1", "left_wrist", (0.03, 0.03, 0.0)),
    ("left_HandThumb2", "left_HandThumb1", (0.02, 0.03, 0.0)),
    ("left_InHandIndex", "left_wrist", (0.02, 0.05, 0.01)),
    ("left_HandIndex1", "left_InHandIndex", (0.0, 0.04, 0.0)),
    ("left_InHandPinky", "left_wrist", (-0.02, 0.05, 0.01)),
    ("left_HandPinky1", "left_InHandPinky", (0.0, 0.03, 0.0)),
)
ROLLS = (("left_UpLegRoll", "left_hip", (0.0, 0.0, -0.21)), ("left_ForeArmRoll", "left_elbow", (0.0, 0.13, 0.0)))


def named(prefix: str, names: str) -> dict[str, str]:
    return {part: prefix + name for part, name in _names(names).items()}


def without_places(layout: Convention) -> Convention:
    return replace(layout, places=False)


AXIS_STUDIO = Convention(named("", NEURON), order="YXZ", places=True, extra=FINGERS)
MOTIONBUILDER = Convention(
    named("Actor:", QUALISYS), order="ZXY", places=True, ground="Actor:Reference", still=True, extra=ROLLS,
    offset=(35.0, 94.0, -452.0), style=(("rotation\n", "rotation \n"), ("End Site", "End Site ")),
)  # fmt: skip
BLENDER = Convention(
    CONVENTIONS["rigify"].names, ("L", "R"), 1.0, Z_UP, "a", order="XYZ", places=True,
    orders={"elbow": "YXZ", "knee": "ZXY", "head": "XZY"}, style=(("\t", "  "),),
)  # fmt: skip
LAYOUTS = {
    "Axis Studio, displacement": AXIS_STUDIO,
    "Axis Studio, no displacement": without_places(AXIS_STUDIO),
    "Axis Neuron": replace(AXIS_STUDIO, names=named("Robot_", NEURON), order="ZXY", style=(("\n", "\r\n"),)),
    "Rokoko Studio": Convention(named("", ROKOKO), order="ZXY", places=True, extra=FINGERS[:2]),
    "Rokoko Studio, hips above a root": Convention(named("", ROKOKO), places=True, ground="Root", still=True),
    "MotionBuilder": MOTIONBUILDER,
    "MotionBuilder, hips alone move": replace(MOTIONBUILDER, places=False),
    "Blender, native orders": BLENDER,
    "Blender, root only": without_places(BLENDER),
    "Blender, Mixamo's rig": replace(CONVENTIONS["mixamo"], rest="own x", order="XYZ", places=True),
    "iClone": Convention(named("CC_Base_", ICLONE), ("L", "R"), order="ZXY", rest="a", ground="RL_BoneRoot", places=True),
    "DAZ Studio": replace(CONVENTIONS["daz"], orders={"hip": "YZX", "elbow": "XZY", "pelvis": "YZX", "ankle": "XYZ"}),
    "Unreal": replace(CONVENTIONS["unreal"], places=True, still=True),
    "Xsens MVN": replace(CONVENTIONS["mvn"], offset=(0.0, 97.0, 0.0), style=(("\n", "\r\n"), ("\t", " "))),
    "cgspeed": replace(CONVENTIONS["cmu"], style=((" {", "\n{"),)),
    "Motive": Convention(named("", MOTIVE), ("L", "R"), 1.0, order="XYZ", style=(("End Site", "End Site\tSite"),)),
    "DeepMotion": Convention(named("", DEEPMOTION), ("l", "r"), order="ZYX", rest="own x", channels="XYZ"),
    "Qualisys": Convention(named("Q_", QUALISYS), unit_m=0.001, axes=Z_UP, order="XYZ", channels="ZXY"),
    "Bandai Namco": Convention(named("", NAMCO), ("L", "R"), order="ZXY", places=True, ground="joint_Root", rest="own x"),
    "FBX to BVH": Convention(named("", QUALISYS), rest="zero", places=True, order="ZYX", rotations_first=True),
    "shifts": Convention(named("", QUALISYS), places=True, shifts=True, channels="YXZ"),
    "shifts of hips above a root": replace(MOTIONBUILDER, shifts=True, offset=(0.0, 94.0, 0.0)),
    "a line for every word": replace(CONVENTIONS["lafan"], style=(("OFFSET ", "OFFSET\t\t"), ("ROOT ", "ROOT\n"))),
}  # fmt: skip
"""Rotation orders, OFFSETs, positions, roots, names and white space as these programs write them."""


@pytest.fixture(scope="module")
def truth():
    return walk(90)


@pytest.mark.parametrize("name", LAYOUTS)
def test_joints_stand_where_the_writer_put_them(name, truth, tmp_path):
    layout = LAYOUTS[name]
    places = write(tmp_path / "take.bvh", layout, *truth)
    take = read_take(tmp_path / "take.bvh", 120)
    assert (len(take.t), take.joints) == (90, len(places))
    assert any("as shifts" in note for note in take.notes) == layout.shifts
    for joint, true in places.items():
        gap = np.linalg.norm(take.t[:, take.names.index(joint)].numpy() - true, axis=-1) * layout.unit_m
        assert gap.max() < 0.0005, joint


def plain_places(path: Path) -> dict[str, np.ndarray]:
    """Forward kinematics of a file whose root alone has positions, in NumPy and SciPy: places by joint, "time 3"."""
    head, _, motion = path.read_text().partition("MOTION")
    rows = np.array([row.split() for row in motion.strip().splitlines()[2:]], float)
    open_, R, t, column, joint = [], {}, {}, 0, ""
    for line in head.splitlines():
        word, *rest = line.split()
        if word in ("ROOT", "JOINT", "End"):
            joint = rest[0] if word != "End" else f"{open_[-1]} (end)"
        elif word == "{":
            open_.append(joint)
        elif word == "}":
            open_.pop()
        elif word == "OFFSET" and len(open_) > 1:
            t[joint] = t[open_[-2]] + R[open_[-2]].apply(np.array(rest, float))
        elif word == "CHANNELS":
            if len(open_) == 1:
                t[joint], column = rows[:, :3], 3
            order = "".join(name[0] for name in rest[-3:])
            turn = Rotation.from_euler(order, rows[:, column : column + 3], degrees=True)
            R[joint], column = (R[open_[-2]] * turn if len(open_) > 1 else turn), column + 3
    return t


@pytest.mark.real
@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("D_bvh_plain", ""),
        ("D_bvh_comment", "comments: 1"),
        ("D_bvh_count_less", "70 frames, its rows are 90"),
        ("D_bvh_count_more", "110 frames, its rows are 90"),
        ("D_bvh_decimal_commas", "commas are read as points: 91"),
        ("D_bvh_frame_time_in_ms", "milliseconds: 30 Hz"),
        ("O_bvh_positions_on_every_joint", ""),
    ],
)
def test_one_take_in_odd_files(real_data, kind, note):
    take = read_take(real_data / "field" / f"{kind}.bvh", 120)
    assert note in " ".join(take.notes)
    assert bool(take.notes) == bool(note)
    assert take.timestamps[-1].item() == pytest.approx(89 / 30, abs=1e-4)
    for joint, true in plain_places(real_data / "field" / "D_bvh_plain.bvh").items():
        gap = np.linalg.norm(take.t[:, take.names.index(joint)].numpy() - true, axis=-1)
        assert gap.max() < 0.05, joint  # centimetres


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_body_is_found_in_each_layout(name, truth, tmp_path):
    layout = LAYOUTS[name]
    write(tmp_path / "take.bvh", layout, *truth)
    report = read_foreign_motion(tmp_path / "take.bvh").report
    assert report.unit_m == pytest.approx(layout.unit_m)
    assert report.up == ("z" if layout.axes is Z_UP else "y")
    assert report.joints["left_knee"] == layout.name("left_knee")
    assert max(worst for _, worst in report.residual_m.values()) < 0.01
