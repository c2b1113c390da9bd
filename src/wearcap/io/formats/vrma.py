"""Motion as VRM animation (.vrma): glTF 2.0 binary with the extension VRMC_vrm_animation 1.0, which moves any VRM avatar.

A node per humanoid bone and no others, in VRM's rest pose: a T-pose that stands on y = 0 and faces +z, in metres with y up,
all nodes without rotation. Every bone has rotations, the hips also translations; a player scales these by the height of the
avatar's hips. VRM has no place for objects, contacts or deviations.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.retarget import reach
from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.geometry.rotation import swing_between
from wearcap.io.formats.gltf import Figure, require_drawable
from wearcap.recording.motion import Motion

EXTENSION = "VRMC_vrm_animation"
_SPINE = ("spine", "chest", "upperChest")
_LIMBS = {"leg": ("UpperLeg", "LowerLeg", "Foot"), "arm": ("UpperArm", "LowerArm", "Hand")}
_FINGER = re.compile(r"(?:.*[:_ ])?(left|right).*?(thumb|index|middle|ring|pinky|little)\D*([123])", re.IGNORECASE)
_THUMB, _OTHER = ("Metacarpal", "Proximal", "Distal"), ("Proximal", "Intermediate", "Distal")
"""VRM's names of a finger's three bones."""

_R_VRM_WORLD = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
"""VRM's axes (x left, y up, z forward) of wearcap's (x forward, y left, z up)."""


def _bones(skeleton: Skeleton, pose: TPose) -> dict[str, int]:
    """VRM's bones by name, parents first, each with the joint at its start; a skeleton's further joints have no bone.

    Of a spine of more than three joints `chest` is the one nearest to its middle. Fingers are those of SMPL+H, and
    others whose names hold side, finger and a number from 1 to 3.
    """
    marks = pose.marks
    spine = marks.spine
    if len(spine) > 3:
        length = (pose.t[list(spine)] - pose.t[spine[0]]).norm(dim=-1)
        middle = int((length[1:-1] - length[-1] / 2).abs().argmin()) + 1
        spine = (spine[0], spine[middle], spine[-1])
    bones = {"hips": marks.root, **dict(zip(_SPINE, spine)), "head": marks.head}
    if marks.neck:
        bones["neck"] = marks.neck[0]
    for side in SIDES:
        for part, names in _LIMBS.items():
            bones |= {f"{side}{name}": joint for name, joint in zip(names, marks.limb[f"{side}_{part}"])}
        for name, joint in ((f"{side}Shoulder", marks.collar[side]), (f"{side}Toes", marks.toe[side])):
            if joint is not None:
                bones[name] = joint
    for joint, name in enumerate(skeleton.joint_names):
        if found := _FINGER.fullmatch(name):
            side, finger, number = found[1].lower(), found[2].lower(), int(found[3]) - 1
            finger = "Little" if finger == "pinky" else finger.capitalize()
            bones.setdefault(f"{side}{finger}{(_THUMB if finger == 'Thumb' else _OTHER)[number]}", joint)
    return dict(sorted(bones.items(), key=lambda bone: bone[1]))


@dataclass(frozen=True)
class _Humanoid:
    """A motion on VRM's bones, in wearcap's axes."""

    bones: dict[str, int]
    parents: list[int]
    rest: Float[Tensor, "bone 3"]
    """Positions (m) in T-pose, standing on the floor at the origin."""
    turn: Float[Tensor, "time bone 3 3"]
    """World rotations from the T-pose."""

    @classmethod
    def of(cls, motion: Motion) -> "_Humanoid":
        skeleton, pose = motion.skeleton, t_pose(motion.skeleton)
        bones = _bones(skeleton, pose)
        joints = list(bones.values())
        T = forward_kinematics(skeleton, motion.R_parent_joint.double(), motion.t_world_root.double())
        turn = T.R @ pose.R.mT
        marks = pose.marks
        if (
            len(marks.spine) > 3
        ):  # the chest's bend replaces those of the joints left out: the shoulders stay where they are
            first, middle, last = (bones[name] for name in _SPINE)
            end = T.t[:, middle] + (turn[:, middle] @ (pose.t[last] - pose.t[middle])[:, None])[..., 0]
            turns = reach(T.t[:, first], T.t[:, middle], end, T.t[:, last])
            turn[:, [first, middle]] = torch.stack(turns, 1) @ turn[:, [first, middle]]
        if len(marks.neck) > 1:
            neck = marks.neck[0]
            bone = (turn[:, neck] @ (pose.t[marks.head] - pose.t[neck])[:, None])[..., 0]
            turn[:, neck] = swing_between(bone, T.t[:, marks.head] - T.t[:, neck]) @ turn[:, neck]
        above = [next((a for a in skeleton.ancestors(joint)[1:] if a in joints), None) for joint in joints]
        parents = [-1 if joint is None else joints.index(joint) for joint in above]
        soles = [pose.site(skeleton, name)[2] for name in skeleton.sites]
        floor = torch.stack([*soles, *pose.t[:, 2]]).min()
        rest = pose.t[joints] - floor * torch.tensor([0.0, 0.0, 1.0])
        return cls(bones, parents, rest, turn[:, joints])


def write_vrma(motion: Motion, path: str | Path) -> None:
    """Write a motion as .vrma; its animation starts at 0 s.

    Raises WearcapError for a motion that is empty, not finite or not rising in time, and for a skeleton whose limbs are not
    recognised.
    """
    require_drawable(motion, path)
    humanoid = _Humanoid.of(motion)
    turn = _R_VRM_WORLD @ humanoid.turn @ _R_VRM_WORLD.mT
    rest, hips = humanoid.rest @ _R_VRM_WORLD.mT, motion.t_world_root.double() @ _R_VRM_WORLD.mT
    figure = Figure(start_s=motion.timestamps[0].item())
    local = turn.clone()
    for bone, (name, parent) in enumerate(zip(humanoid.bones, humanoid.parents)):
        offset = rest[bone] if parent < 0 else rest[bone] - rest[parent]
        figure.nodes.append({"name": name, "translation": offset.tolist()})
        if children := [child for child, above in enumerate(humanoid.parents) if above == bone]:
            figure.nodes[-1]["children"] = children
        if parent >= 0:
            local[:, bone] = turn[:, parent].mT @ turn[:, bone]
    figure.animate(motion.timestamps, dict(enumerate(local.unbind(1))), {0: hips})
    human_bones = {name: {"node": bone} for bone, name in enumerate(humanoid.bones)}
    document = {
        "asset": {"version": "2.0", "generator": "wearcap", "extras": dict(motion.provenance)},
        "extensionsUsed": [EXTENSION],
        "extensions": {EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": human_bones}}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": figure.nodes,
        "animations": [{"name": "motion", "samplers": figure.samplers, "channels": figure.channels}],
    }
    figure.write(path, document)
