"""What makes skeletons comparable: landmark joints by body part, the T-pose, and the direction of the face.

Hips, knees, ankles, shoulders, elbows, wrists and the head are found by name; spine, neck, collars and toes by their
position in the tree, since their number and names differ most.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.joint_matching import joints_by_name
from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import swing_between

_SPLAY = 0.17
"""Lateral angle (rad) of a bind pose's shins above which its feet are taken to be rolled with them."""
_UPRIGHT = math.cos(math.radians(15))
_NATURAL_PITCH = math.radians(7)
"""Average downward pitch of the head of an upright person (ours)."""


@dataclass(frozen=True)
class Landmarks:
    """Joint indices by part of the body; `limb["left_leg"]` is (hip, knee, ankle), `…_arm` the same."""

    root: int
    spine: tuple[int, ...]
    """Joints from the first one above the root to the parent of neck and arms."""
    neck: tuple[int, ...]
    """Joints between spine and head (empty if the head's parent is in the spine)."""
    head: int
    limb: dict[str, tuple[int, int, int]]
    collar: dict[str, int | None]
    toe: dict[str, int | None]
    forearm: dict[str, int]
    """Joint that rotates the forearm at the wrist, by side (the elbow, or a twist joint below it)."""


def landmarks(skeleton: Skeleton) -> Landmarks:
    """Find the parts of the body. Raises WearcapError naming the limb that is not recognised."""
    found = joints_by_name(skeleton.joint_names, skeleton.parents, skeleton.name)
    head, limb, collar, toe, forearm = found.head, found.limb, {}, {}, {}
    for side in SIDES:
        below = [joint for joint, parent in enumerate(skeleton.parents) if parent == limb[f"{side}_leg"][2]]
        toe[side] = max(below, key=lambda joint: skeleton.t_parent_joint[joint, 0].item(), default=None)
        forearm[side] = skeleton.parents[limb[f"{side}_arm"][2]]
    above_head = skeleton.ancestors(head)
    top = next(j for j in skeleton.ancestors(limb["left_arm"][0]) if j in above_head)
    for side in SIDES:
        above = skeleton.parents[limb[f"{side}_arm"][0]]
        collar[side] = above if above not in above_head else None
    spine = skeleton.ancestors(top)[-2::-1]
    if not spine:
        raise WearcapError(f"skeleton {skeleton.name!r} has no spine", expected="a joint between root and arms")
    neck = above_head[1 : above_head.index(top)][::-1]
    return Landmarks(0, tuple(spine), tuple(neck), head, limb, collar, toe, forearm)


@dataclass(frozen=True)
class TPose:
    """A skeleton in T-pose with its root at the origin: landmarks, rotations and joint positions."""

    marks: Landmarks
    R: Float[Tensor, "joint 3 3"]
    """Rotations from the bind pose."""
    t: Float[Tensor, "joint 3"]

    @property
    def hip_centre(self) -> Float[Tensor, "3"]:
        return (self.t[self.marks.limb["left_leg"][0]] + self.t[self.marks.limb["right_leg"][0]]) / 2

    def site(self, skeleton: Skeleton, name: str, scale: float = 1.0) -> Float[Tensor, "3"]:
        """Position (m) of one of the skeleton's sites, its offset from the joint scaled."""
        site = skeleton.sites[name]
        joint = skeleton.index(site.joint)
        return self.t[joint] + scale * (self.R[joint] @ torch.tensor(site.t_joint_site, dtype=torch.float64))


def t_pose(skeleton: Skeleton) -> TPose:
    """The T-pose, whatever the bind pose: legs straight down, arms straight sideways, all else as in the bind pose."""
    marks = landmarks(skeleton)
    rest = skeleton.rest_joints.double()
    aim: dict[int, tuple[Tensor, Tensor]] = {}
    feet = {}
    for name, (first, second, third) in marks.limb.items():
        y = 1.0 if name.startswith("left") else -1.0
        direction = torch.tensor([0.0, 0.0, -1.0] if name.endswith("leg") else [0.0, y, 0.0], dtype=rest.dtype)
        aim[first] = (rest[second] - rest[first], direction)
        aim[second] = (rest[third] - rest[second], direction)
        if name.endswith("leg"):
            feet[third] = aim[second]
    R = [torch.eye(3, dtype=rest.dtype)] * len(skeleton)
    for joint in range(1, len(skeleton)):
        R[joint] = R[skeleton.parents[joint]]
        if joint in aim:
            R[joint] = swing_between(*aim[joint])
        elif joint in feet:
            bone, down = feet[joint]
            splayed = bone[1].abs() > _SPLAY * bone.norm()
            R[joint] = swing_between(bone, down) if splayed else torch.eye(3, dtype=rest.dtype)
    R_t = torch.stack(R)
    local = local_rotations(skeleton, R_t)
    t = forward_kinematics(skeleton, local, torch.zeros(3, dtype=rest.dtype)).t
    return TPose(marks, R_t, t)


def upright_frames(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "time joint 3 3"]
) -> Float[Tensor, "frame joint 3 3"]:
    """World rotations in the frames in which the line from hips to shoulders is within 15° of the vertical."""
    marks = landmarks(skeleton)
    T = forward_kinematics(skeleton, R_parent_joint, R_parent_joint.new_zeros(len(R_parent_joint), 3))
    hips, shoulders = (T.t[:, [marks.limb[f"{side}_{part}"][0] for side in SIDES]].mean(1) for part in ("leg", "arm"))
    up = torch.nn.functional.normalize(shoulders - hips, dim=-1)[:, 2] > _UPRIGHT
    return T.R[up]


def head_level(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "time joint 3 3"], at_least: int = 30
) -> Float[Tensor, "3 3"] | None:
    """R_head_face: the constant tilt of the face in the head joint's axes, found from the upright frames.

    Marker sets such as CMU's leave the head frame pitched by 5…45°, by subject. Over frames whose trunk is
    upright, the face is taken to look 7° down in the median and not to lean sideways; heading is not touched.
    None if fewer than `at_least` frames are upright. For subjects with many motions, average the results.
    """
    R_world = upright_frames(skeleton, R_parent_joint)
    if len(R_world) < at_least:
        return None
    up_head = R_world[:, skeleton.index("head"), 2, :].median(0).values
    sin, cos = math.sin(_NATURAL_PITCH), math.cos(_NATURAL_PITCH)
    return swing_between(up_head.new_tensor([-sin, 0.0, cos]), up_head)


def with_head_face(
    skeleton: Skeleton, R_parent_joint: Float[Tensor, "*batch joint 3 3"], R_head_face: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch joint 3 3"]:
    """The motion with the head joint's axes rotated to the face's; joints above the head are unchanged."""
    origin = R_parent_joint.new_zeros(*R_parent_joint.shape[:-3], 3)
    R_world = forward_kinematics(skeleton, R_parent_joint, origin).R.clone()
    head = skeleton.index("head")
    R_world[..., head, :, :] = R_world[..., head, :, :] @ R_head_face.to(R_world)
    return local_rotations(skeleton, R_world)
