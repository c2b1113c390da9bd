"""The named skeletons, at the size of a 1.75 m adult.

Joint names and their order are those of SMPL, SMPL+H, SMPL-X and CMU. The offsets are this project's own
proportions, shared with `xsens23`, and not those of SMPL's licensed template: to get a wearer's or a model
file's, use `retarget.fit_offsets`.
"""

from dataclasses import replace

import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton, build_skeleton, xsens23
from wearcap.errors import require_choice
from wearcap.geometry.rotation import about_axis

_SMPL_BODY = (
    ("pelvis", "", (0.0, 0.0, 0.0)),
    ("left_hip", "pelvis", (0.0, 0.085, -0.075)), ("right_hip", "pelvis", (0.0, -0.085, -0.075)),
    ("spine1", "pelvis", (0.0, 0.0, 0.110)),
    ("left_knee", "left_hip", (0.0, 0.0, -0.430)), ("right_knee", "right_hip", (0.0, 0.0, -0.430)),
    ("spine2", "spine1", (0.0, 0.0, 0.110)),
    ("left_ankle", "left_knee", (0.0, 0.0, -0.420)), ("right_ankle", "right_knee", (0.0, 0.0, -0.420)),
    ("spine3", "spine2", (0.0, 0.0, 0.095)),
    ("left_foot", "left_ankle", (0.155, 0.0, -0.062)), ("right_foot", "right_ankle", (0.155, 0.0, -0.062)),
    ("neck", "spine3", (0.0, 0.0, 0.135)),
    ("left_collar", "spine3", (0.0, 0.035, 0.085)), ("right_collar", "spine3", (0.0, -0.035, 0.085)),
    ("head", "neck", (0.0, 0.0, 0.090)),
    ("left_shoulder", "left_collar", (0.0, 0.145, 0.0)), ("right_shoulder", "right_collar", (0.0, -0.145, 0.0)),
    ("left_elbow", "left_shoulder", (0.0, 0.290, 0.0)), ("right_elbow", "right_shoulder", (0.0, -0.290, 0.0)),
    ("left_wrist", "left_elbow", (0.0, 0.250, 0.0)), ("right_wrist", "right_elbow", (0.0, -0.250, 0.0)),
)  # fmt: skip
FINGERS = {
    "index": ((0.025, 0.085, 0.0), 0.032),
    "middle": ((0.003, 0.088, 0.0), 0.034),
    "pinky": ((-0.038, 0.072, -0.004), 0.022),
    "ring": ((-0.019, 0.082, 0.0), 0.031),
    "thumb": ((0.022, 0.030, -0.012), 0.028),
}
"""SMPL+H's order of fingers: first knuckle from the wrist, length of each of the two bones that follow (m)."""


FINGER_JOINTS = tuple(f"{side}_{finger}{k}" for side in ("left", "right") for finger in FINGERS for k in (1, 2, 3))
"""SMPL+H's finger joints, in its order."""


def _hand(side: str) -> list[tuple[str, str, tuple[float, float, float]]]:
    y = 1.0 if side == "left" else -1.0
    rows = []
    for finger, (knuckle, bone) in FINGERS.items():
        along = (0.6 * bone, 0.8 * bone, 0.0) if finger == "thumb" else (0.0, bone, 0.0)
        for joint in (1, 2, 3):
            parent = f"{side}_wrist" if joint == 1 else f"{side}_{finger}{joint - 1}"
            x, out, z = knuckle if joint == 1 else along
            rows.append((f"{side}_{finger}{joint}", parent, (x, y * out, z)))
    return rows


def smplx22() -> Skeleton:
    """SMPL-X's (and SMPL+H's) root and 21 body joints."""
    return build_skeleton("smplx22", _SMPL_BODY, "left_foot")


def smpl24() -> Skeleton:
    """SMPL's 24 joints."""
    hands = [("left_hand", "left_wrist", (0.0, 0.080, 0.0)), ("right_hand", "right_wrist", (0.0, -0.080, 0.0))]
    return build_skeleton("smpl24", [*_SMPL_BODY, *hands], "left_foot")


def smplh52() -> Skeleton:
    """SMPL+H's 52 joints: the body and fifteen finger joints of each hand."""
    return build_skeleton("smplh52", [*_SMPL_BODY, *_hand("left"), *_hand("right")], "left_foot")


def _cmu_side(letter: str) -> list[tuple[str, str, tuple[float, float, float]]]:
    y = 1.0 if letter == "l" else -1.0
    return [
        (f"{letter}{name}", parent.replace("*", letter), (x, y * out, z))
        for name, parent, (x, out, z) in (
            ("hipjoint", "root", (0.0, 0.0, 0.0)), ("femur", "*hipjoint", (0.035, 0.085, -0.105)),
            ("tibia", "*femur", (0.0, 0.0, -0.430)), ("foot", "*tibia", (0.0, 0.0, -0.420)),
            ("toes", "*foot", (0.135, 0.0, -0.045)), ("clavicle", "thorax", (0.0, 0.0, 0.115)),
            ("humerus", "*clavicle", (0.0, 0.180, 0.030)), ("radius", "*humerus", (0.0, 0.290, 0.0)),
            ("wrist", "*radius", (0.0, 0.165, 0.0)), ("hand", "*wrist", (0.0, 0.085, 0.0)),
            ("fingers", "*hand", (0.0, 0.040, 0.0)), ("thumb", "*wrist", (0.0, 0.085, 0.0)),
        )
    ]  # fmt: skip


def cmu31() -> Skeleton:
    """The 31 nodes of CMU's .asf files, each joint a node's start, in their bind pose: legs 20° astride."""
    spine = [
        ("root", "", (0.0, 0.0, 0.0)), ("lowerback", "root", (0.0, 0.0, 0.0)),
        ("upperback", "lowerback", (-0.015, 0.0, 0.110)), ("thorax", "upperback", (0.0, 0.0, 0.112)),
        ("lowerneck", "thorax", (0.0, 0.0, 0.115)), ("upperneck", "lowerneck", (0.0, 0.0, 0.090)),
        ("head", "upperneck", (0.0, 0.0, 0.090)),
    ]  # fmt: skip
    left, right = _cmu_side("l"), _cmu_side("r")
    rows = [spine[0], *left[:5], *right[:5], *spine[1:], *left[5:], *right[5:]]
    upright = build_skeleton("cmu31", rows)
    R = torch.eye(3).repeat(len(upright), 1, 1)
    splay = torch.tensor(20.0).deg2rad()
    R[upright.index("lfemur")], R[upright.index("rfemur")] = about_axis("x", splay), about_axis("x", -splay)
    t = forward_kinematics(upright, R, torch.zeros(3)).t
    return replace(upright, t_parent_joint=t - t[[max(parent, 0) for parent in upright.parents]])


_BY_NAME = {"xsens23": xsens23, "smpl24": smpl24, "smplh52": smplh52, "smplx22": smplx22, "cmu31": cmu31}


def skeleton_by_name(name: str) -> Skeleton:
    """One of the named skeletons. Raises WearcapError listing them."""
    require_choice(name, _BY_NAME, f"no skeleton is called {name!r}")
    return _BY_NAME[name]()
