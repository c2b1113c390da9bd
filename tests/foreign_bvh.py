"""A short walk in NumPy, and a small BVH writer of any convention: names, units, axes, rest poses, roots, channels.

Independent of the package: the files' meaning is this module's own.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

BODY = (
    ("pelvis", "", (0, 0, 0)), ("spine", "pelvis", (-0.01, 0, 0.10)), ("spine2", "spine", (0, 0, 0.12)),
    ("chest", "spine2", (0.01, 0, 0.13)), ("neck", "chest", (-0.02, 0, 0.19)), ("head", "neck", (0.02, 0, 0.10)),
    ("left_collar", "chest", (0, 0.03, 0.13)), ("left_shoulder", "left_collar", (-0.01, 0.15, 0.01)),
    ("left_elbow", "left_shoulder", (0, 0.30, 0)), ("left_wrist", "left_elbow", (0, 0.26, 0)),
    ("left_hip", "pelvis", (0.01, 0.09, -0.04)), ("left_knee", "left_hip", (0, 0, -0.42)),
    ("left_ankle", "left_knee", (0, 0, -0.40)), ("left_toe", "left_ankle", (0.15, 0, -0.06)),
)  # fmt: skip
"""Joints of the T-pose, x forward, y left, z up (m); the right side is mirrored."""
ENDS = {"head": (0.0, 0.0, 0.1894), "left_wrist": (0.0, 0.17, 0.0), "left_toe": (0.07, 0.0, 0.0)}


def _mirrored(rows):
    return [(n.replace("left", "right"), p.replace("left", "right"), (x, -y, z)) for n, p, (x, y, z) in rows]


ROWS = [*BODY, *_mirrored(row for row in BODY if "left" in row[0])]
NAMES = [row[0] for row in ROWS]
PARENTS = {name: parent for name, parent, _ in ROWS}
OFFSETS = {name: np.array(offset, float) for name, _, offset in ROWS}
SIDED_ENDS = ENDS | {k.replace("left", "right"): (x, -y, z) for k, (x, y, z) in ENDS.items() if "left" in k}


def turn(axis: str, angle) -> np.ndarray:
    """Rotation matrices about x, y or z (rad)."""
    angle = np.asarray(angle, float)
    c, s, o, z = np.cos(angle), np.sin(angle), np.ones_like(angle), np.zeros_like(angle)
    rows = {"x": [[o, z, z], [z, c, -s], [z, s, c]], "y": [[c, z, s], [z, o, z], [-s, z, c]],
            "z": [[c, -s, z], [s, c, z], [z, z, o]]}[axis]  # fmt: skip
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def walk(frames: int = 150, fps: float = 60.0) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """World rotations (from the T-pose) and places (m, z up) by joint, of someone who walks along a bend."""
    t = np.arange(frames) / fps
    phase = 2 * np.pi * 0.9 * t
    local = {name: np.tile(np.eye(3), (frames, 1, 1)) for name in NAMES}
    heading = 0.3 + 0.4 * t
    local["pelvis"] = turn("z", heading) @ turn("x", 0.04 * np.sin(phase)) @ turn("y", np.full(frames, 0.05))
    for name in ("spine", "spine2", "chest"):
        local[name] = turn("z", -0.06 * np.sin(phase)) @ turn("y", 0.03 + 0.01 * np.sin(2 * phase))
    local["head"] = turn("z", 0.3 * np.sin(1.3 * t)) @ turn("y", np.full(frames, 0.05))
    for side, sign, shift in (("left", 1.0, 0.0), ("right", -1.0, np.pi)):
        swing = 0.45 * np.sin(phase + shift)
        bend = 0.15 + 0.9 * np.clip(np.sin(phase + shift + 0.9), 0, None) ** 2
        local[f"{side}_hip"] = turn("y", -swing - 0.1) @ turn("x", np.full(frames, 0.03 * sign))
        local[f"{side}_knee"] = turn("y", bend)
        local[f"{side}_ankle"] = turn("y", swing + 0.1 - bend)
        local[f"{side}_toe"] = turn("y", -0.2 * np.clip(np.sin(phase + shift - 1), 0, None))
        local[f"{side}_collar"] = turn("x", np.full(frames, -0.05 * sign)) @ turn("z", 0.05 * np.sin(phase))
        local[f"{side}_shoulder"] = turn("y", 0.5 * swing) @ turn("x", np.full(frames, -1.25 * sign))
        local[f"{side}_elbow"] = turn("z", -sign * (0.5 + 0.3 * np.sin(phase + shift)))
        local[f"{side}_wrist"] = turn("x", 0.15 * np.sin(phase))
    course = np.stack([np.cos(heading), np.sin(heading)], -1) * 1.1 / fps
    root = np.concatenate([np.cumsum(course, 0), (0.92 + 0.02 * np.cos(2 * phase))[:, None]], -1)
    R, p = {"pelvis": local["pelvis"]}, {"pelvis": root}
    for name in NAMES[1:]:
        above = PARENTS[name]
        R[name] = R[above] @ local[name]
        p[name] = p[above] + R[above] @ OFFSETS[name]
    return R, p


A_POSE = {"left_shoulder": -0.9, "left_elbow": -0.9, "left_wrist": -0.9, "left_hip": 0.12, "left_knee": 0.12,
          "left_ankle": 0.0, "right_shoulder": 0.9, "right_elbow": 0.9, "right_wrist": 0.9, "right_hip": -0.12,
          "right_knee": -0.12, "right_ankle": 0.0}  # fmt: skip
"""Turn about the forward axis (rad) in the bind pose."""
UPPER = ("spine", "spine2", "chest", "neck", "head", "collar", "shoulder", "elbow", "wrist")
Y_UP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""World (x forward, z up) to a file with y up that faces z."""
Z_UP = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""To a file with z up that faces -y."""


@dataclass
class Convention:
    """How a file is written."""

    names: dict[str, str]
    """The file's names; `{s}` is the side as `sides` has it."""
    sides: tuple[str, str] = ("Left", "Right")
    unit_m: float = 0.01
    axes: np.ndarray = field(default_factory=lambda: Y_UP)
    rest: str = "t"
    """"t", "a", "own x" (bones along each joint's own x), "bent trunk" (own x above the pelvis) or "zero" OFFSETs."""
    ground: str = ""
    """Name of a root on the ground above the hips."""
    places: bool = False
    """Position channels on every joint."""
    order: str = "ZXY"
    bind_first: bool = False
    """The bind pose as the first frame, which the reader leaves out."""
    parents: dict[str, str] = field(default_factory=dict)
    """Joints whose parent is another than in `BODY`."""
    extra: tuple[tuple[str, str, tuple[float, float, float]], ...] = ()
    """Further rigid joints, of the left side (fingers, rolls …): name, parent, place in it (m); both sides get them."""
    orders: dict[str, str] = field(default_factory=dict)
    """Rotation orders of some joints."""
    shifts: bool = False
    """Position channels of children are shifts from OFFSET."""
    offset: tuple[float, float, float] | None = None
    """OFFSET (file units) of the joint that travels, wherever it was when the skeleton was made."""
    still: bool = False
    """The root above the hips stays at the origin."""
    channels: str = "XYZ"
    """Order of the position channels."""
    rotations_first: bool = False
    style: tuple[tuple[str, str], ...] = ()
    """Replacements in the text: braces, white space, line ends."""

    def name(self, joint: str) -> str:
        """The file's name of a joint; further joints keep theirs."""
        side, _, part = joint.rpartition("_") if joint.startswith(("left", "right")) else ("", "", joint)
        return self.names.get(part, f"{{s}}{part}").replace("{s}", self.sides[side == "right"])


def _frames(convention: Convention, joints: list[str], parents: dict[str, str]) -> dict[str, np.ndarray]:
    """B of each joint: its own axes in the T-pose, in the world's."""
    rng, frames = np.random.default_rng(3), {}
    for joint in joints:
        frames[joint] = convention.axes.T
        if joint == "ground":
            continue
        if convention.rest == "a":
            frames[joint] = turn("x", A_POSE.get(joint, 0.0)).T @ convention.axes.T
        elif convention.rest in ("own x", "zero") or (
            convention.rest == "bent trunk" and joint.split("_")[-1] in UPPER
        ):
            child = next((c for c in joints if parents[c] == joint and c in OFFSETS), None)
            bone = OFFSETS[child] if child else np.array(SIDED_ENDS.get(joint, (0.1, 0, 0)))
            x = bone / max(np.linalg.norm(bone), 1e-9)
            y = np.cross(rng.normal(size=3), x)
            y /= np.linalg.norm(y)
            frames[joint] = np.stack([x, y, np.cross(x, y)], 1)
    return frames


def _euler(R: np.ndarray, order: str) -> np.ndarray:
    """Angles (deg) about the axes of `order`, the first outermost."""
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    second = np.arcsin(np.clip(sign * R[..., i, k], -1, 1))
    first = np.arctan2(-sign * R[..., j, k], R[..., k, k])
    third = np.arctan2(-sign * R[..., i, j], R[..., i, i])
    return np.degrees(np.stack([first, second, third], -1))


def _tree(convention: Convention, R: dict, p: dict) -> tuple[list[str], dict[str, str]]:
    """The file's joints and each one's parent; what only the file has is added to rotations and places."""
    joints, parents = [name for name in NAMES if name.split("_")[-1] in convention.names], {}
    for joint, above, offset in [*convention.extra, *_mirrored(convention.extra)]:
        joints.append(joint)
        parents[joint], R[joint], p[joint] = above, R[above], p[above] + R[above] @ np.array(offset)
    for joint in [joint for joint in joints if joint in PARENTS]:
        above = convention.parents.get(joint, PARENTS[joint])
        while above and above not in joints:
            above = PARENTS[above]
        parents[joint] = above
    if convention.ground:
        joints, parents = ["ground", *joints], {"ground": "", **parents, "pelvis": "ground"}
        yaw = np.arctan2(R["pelvis"][:, 1, 0], R["pelvis"][:, 0, 0])
        R["ground"], p["ground"] = turn("z", yaw), p["pelvis"] * np.array([1.0, 1, 0])
        if convention.still:
            R["ground"], p["ground"] = np.tile(np.eye(3), (len(yaw), 1, 1)), np.zeros((len(yaw), 3))
    return joints, parents


def write(path: Path, convention: Convention, R: dict, p: dict, fps: float = 60.0) -> dict[str, np.ndarray]:
    """Write a motion (world rotations and places by joint) as BVH of a convention.

    Returns what its numbers mean: the joints' places (file units) by the file's names.
    """
    R, p = dict(R), dict(p)
    joints, parents = _tree(convention, R, p)
    B = _frames(convention, joints, parents)
    M, scale = convention.axes, 1 / convention.unit_m
    world = {joint: M @ R[joint] @ B[joint] for joint in joints}
    local, place = {}, {}
    for joint in joints:
        above = parents[joint]
        local[joint] = np.swapaxes(world[above], -1, -2) @ world[joint] if above else world[joint]
        step = (p[joint] - (p[above] if above else 0)) @ M.T * scale
        place[joint] = (np.swapaxes(world[above], -1, -2) @ step[..., None])[..., 0] if above else step
    label = {joint: convention.ground if joint == "ground" else convention.name(joint) for joint in joints}
    columns, lines, stands = [], ["HIERARCHY"], {}

    def block(joint: str, depth: int) -> None:
        pad = "\t" * depth
        moves = convention.places or not parents[joint] or joint == "pelvis"
        zero = convention.rest == "zero" or not parents[joint]
        offset = np.zeros(3) if zero else place[joint].mean(0)
        if convention.offset and joint == "pelvis":
            offset = np.array(convention.offset)
        order = convention.orders.get(joint.split("_")[-1], convention.order)
        here = [place[joint][:, ["XYZ".index(axis) for axis in convention.channels]]] * moves
        if convention.shifts and parents[joint]:
            here = [block - offset[["XYZ".index(axis) for axis in convention.channels]] for block in here]
        parts = [([f"{axis}position" for axis in convention.channels] * moves, here)]
        parts.append(([f"{axis}rotation" for axis in order], [_euler(local[joint], order)]))
        parts = parts[::-1] if convention.rotations_first else parts
        channels = parts[0][0] + parts[1][0]
        lines.extend([f"{pad}{'JOINT' if depth else 'ROOT'} {label[joint]}", pad + "{"])
        lines.append(pad + "\tOFFSET {:.6f} {:.6f} {:.6f}".format(*offset))
        lines.append(f"{pad}\tCHANNELS {len(channels)} {' '.join(channels)}")
        columns.append(np.concatenate(parts[0][1] + parts[1][1], -1))
        above = parents[joint]
        step = place[joint] if moves else offset
        stands[joint] = stands[above] + (world[above] @ step[..., None])[..., 0] if above else step
        below = [child for child in joints if parents[child] == joint]
        for child in below:
            block(child, depth + 1)
        if not below:
            end = B[joint].T @ np.array(SIDED_ENDS.get(joint, (0.1, 0, 0))) * scale
            lines.extend([pad + "\tEnd Site", pad + "\t{"])
            lines.append(pad + "\t\tOFFSET {:.6f} {:.6f} {:.6f}".format(*end))
            lines.append(pad + "\t}")
        lines.append(pad + "}")

    block(joints[0], 0)
    path.write_bytes(_text(convention, lines, np.concatenate(columns, -1), fps).encode())
    return {label[joint]: places for joint, places in stands.items()}


def _text(convention: Convention, lines: list[str], table: np.ndarray, fps: float) -> str:
    """The file: its hierarchy's lines, and a row of numbers for each frame."""
    if convention.bind_first:
        bind = np.zeros((1, table.shape[1]))
        bind[0, :3] = table[0, :3]
        table = np.concatenate([bind, table])
    lines = [*lines, "MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / fps:.7f}"]
    lines += [" ".join(f"{value:.6f}" for value in row) for row in table]
    text = "\n".join(lines) + "\n"
    for old, new in convention.style:
        text = text.replace(old, new)
    return text


def _names(text: str) -> dict[str, str]:
    parts = ("pelvis", "spine", "spine2", "chest", "neck", "head", "collar", "shoulder", "elbow", "wrist", "hip", "knee",
             "ankle", "toe")  # fmt: skip
    return {part: name for part, name in zip(parts, text.split(), strict=True) if name != "-"}


_MIXAMO = "Hips Spine Spine1 Spine2 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}UpLeg {s}Leg {s}Foot {s}ToeBase"
CONVENTIONS = {
    "mixamo": Convention({k: f"mixamorig:{v}" for k, v in _names(_MIXAMO).items()}),
    "motionbuilder": Convention(_names(_MIXAMO), unit_m=1.0, rest="a", order="XYZ", places=True),
    "humanik": Convention({k: f"Character1_{v}" for k, v in _names(_MIXAMO).items()}, unit_m=0.001, ground="Reference"),
    "mvn": Convention(
        _names("Hips Chest Chest2 Chest4 Neck Head {s}Collar {s}Shoulder {s}Elbow {s}Wrist {s}Hip {s}Knee {s}Ankle {s}Toe"),
        order="YXZ",
    ),
    "rigify": Convention(
        _names("spine spine.001 spine.002 spine.003 spine.004 head shoulder.{s} upper_arm.{s} forearm.{s} hand.{s} "
               "thigh.{s} shin.{s} foot.{s} toe.{s}"),
        ("L", "R"), 1.0, Z_UP, "a", order="XYZ",
    ),
    "unity": Convention(
        _names("Hips Spine Chest UpperChest Neck Head {s}Shoulder {s}UpperArm {s}LowerArm {s}Hand {s}UpperLeg "
               "{s}LowerLeg {s}Foot {s}Toes"),
        unit_m=1.0, rest="own x",
    ),
    "daz": Convention(
        _names("hip abdomen abdomen2 chest neck head {s}Collar {s}Shldr {s}ForeArm {s}Hand {s}Thigh {s}Shin {s}Foot {s}Toe"),
        ("l", "r"), rest="a", order="YZX", bind_first=True,
    ),
    "cmu": Convention(
        _names("Hips LowerBack Spine Spine1 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}UpLeg {s}Leg {s}Foot "
               "{s}ToeBase"),
        unit_m=0.0254 / 0.45, bind_first=True, order="ZYX",
    ),
    "studio": Convention(_names(_MIXAMO), rest="own x", ground="Root", places=True, order="ZYX"),
    "unreal": Convention(
        _names("pelvis spine_01 spine_02 spine_03 neck_01 head clavicle_{s} upperarm_{s} lowerarm_{s} hand_{s} thigh_{s} "
               "calf_{s} foot_{s} ball_{s}"),
        ("l", "r"), 0.01, Z_UP, "own x", ground="root",
    ),
    "rokoko": Convention(
        _names("Hips Spine1 Spine2 Spine3 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}Thigh {s}Shin {s}Foot {s}Toe"),
        rest="zero", places=True,
    ),
    "biped": Convention(
        {part: "Bip01 " + name for part, name in zip(
            ("pelvis", "spine", "spine2", "chest", "neck", "head", "collar", "shoulder", "elbow", "wrist", "hip", "knee",
             "ankle", "toe"),
            ("Pelvis", "Spine", "Spine1", "Spine2", "Neck", "Head", "{s} Clavicle", "{s} UpperArm", "{s} Forearm",
             "{s} Hand", "{s} Thigh", "{s} Calf", "{s} Foot", "{s} Toe0"))},
        ("L", "R"), 0.0254, Z_UP, parents={"left_hip": "spine", "right_hip": "spine"}, places=True,
    ),
    "lafan": Convention(
        _names("Hips Spine Spine1 Spine2 Neck Head {s}Shoulder {s}Arm {s}ForeArm {s}Hand {s}UpLeg {s}Leg {s}Foot {s}Toe"),
        rest="own x", order="ZYX",
    ),
    "nameless": Convention(
        _names("j0 j1 j2 j3 j4 j5 j6{s} j7{s} j8{s} j9{s} j10{s} j11{s} j12{s} j13{s}"), ("a", "b"), 0.3048, rest="own x"
    ),
}  # fmt: skip
