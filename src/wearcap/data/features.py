"""Features that the head-driven networks share: body size and frame differences."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton

LIMBS = {
    "stature": (),
    "leg": ("left_knee", "left_ankle"),
    "arm": ("left_elbow", "left_wrist"),
    "trunk": ("l5", "l3", "t12", "t8", "neck", "head"),
}
"""Measures of body size, each as the chain of joints whose bones add up to it."""


def body_size(skeleton: Skeleton) -> Float[Tensor, "limb"]:
    """`LIMBS` of a skeleton (m): height of the head joint in the rest pose, length of leg, arm and trunk."""
    lengths = [
        sum(float(skeleton.t_parent_joint[skeleton.index(name)].norm()) for name in names) for names in LIMBS.values()
    ]
    return torch.tensor([skeleton.height_of("head"), *lengths[1:]])


def first_repeated(step: Float[Tensor, "batch step *rest"]) -> Float[Tensor, "batch time *rest"]:
    """Differences to the previous frame for every frame; the first frame repeats the second's."""
    return torch.cat([step[:, :1], step], 1)
