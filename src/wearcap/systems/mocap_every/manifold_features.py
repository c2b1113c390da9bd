"""Encoding of motion windows for MocapEvery's manifold: X of contacts, root translation and 6D rotations (§3.4)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import FEET
from wearcap.geometry import rotation


class Posed(NamedTuple):
    """A window of motion in the world."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    t_world_root: Float[Tensor, "batch time 3"]
    foot_contact: Float[Tensor, "batch time foot"]


class Origin(NamedTuple):
    """Canonical frame of a window: heading and position of its first root."""

    R: Float[Tensor, "batch 1 3 3"]
    t: Float[Tensor, "batch 1 3"]


def origin_of(window: Posed) -> Origin:
    """Canonical frame of each window. The paper uses the first root's full pose; ours is yaw-aligned, so z stays up."""
    yaw = rotation.yaw_of(window.R_parent_joint[:, :1, 0])
    return Origin(rotation.about_axis("z", yaw), window.t_world_root[:, :1])


def encode_window(window: Posed, origin: Origin) -> Float[Tensor, "batch time feature"]:
    """X: 5 + 6 per joint features (137 with 22 joints), in the window's canonical frame."""
    R_origin_world = origin.R.mT
    root = (R_origin_world @ (window.t_world_root - origin.t)[..., None])[..., 0]
    R = torch.cat([(R_origin_world @ window.R_parent_joint[:, :, 0])[:, :, None], window.R_parent_joint[:, :, 1:]], 2)
    return torch.cat([window.foot_contact, root, rotation.rot6d_from_matrix(R).flatten(-2)], -1)


def decode_window(X: Float[Tensor, "batch time feature"], origin: Origin) -> Posed:
    """The inverse of `encode_window`; predicted contacts are not clipped to 0…1."""
    R = rotation.matrix_from_rot6d(X[..., FEET + 3 :].unflatten(-1, (-1, 6)))
    R = torch.cat([(origin.R @ R[:, :, 0])[:, :, None], R[:, :, 1:]], 2)
    root = origin.t + (origin.R @ X[..., FEET : FEET + 3, None])[..., 0]
    return Posed(R, root, X[..., :FEET])
