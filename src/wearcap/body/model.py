"""A skinned body surface on a skeleton, the common form of all parametric bodies of a given shape, and its named parts
that touch the world: toes, heels, soles, palms."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.body.landmarks import landmarks
from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid

_SOLE_HEIGHT = 0.025
"""Largest height (m) of a sole's vertices above the foot's lowest vertex."""
FOOT_REGIONS = {
    "left_heel": "left_heel",
    "left_toe_tip": "left_toes",
    "right_heel": "right_heel",
    "right_toe_tip": "right_toes",
}
"""Surface region of each of `FOOT_PATCHES`, in their order."""


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A mesh in its skeleton's rest pose (root at the origin, m) with its skinning weights."""

    skeleton: Skeleton
    rest_vertices: Float[Tensor, "vertex 3"]
    faces: Int64[Tensor, "face 3"]
    skin_joints: Int64[Tensor, "vertex 4"]
    skin_weights: Float[Tensor, "vertex 4"]
    """Skinning weights on `skin_joints`; rows sum to 1."""
    regions: dict[str, Int64[Tensor, "_"]] = field(default_factory=dict)
    """Vertices of {left,right}_{toes,heel,sole,palm}."""
    pose_blend: Float[Tensor, "feature vertex 3"] | None = None
    """Pose blend shapes (SMPL): offsets of the rest surface per entry of (R_parent_joint - I), without the root."""

    def vertices(self, T_world_joint: Rigid, region: str | None = None) -> Float[Tensor, "*batch vertex 3"]:
        """World positions (m) by linear blend skinning, of all vertices or of one region's.

        T_world_joint: R "*batch joint 3 3", t "*batch joint 3", as returned by forward kinematics.
        Raises WearcapError for an unknown region.
        """
        if region is not None and region not in self.regions:
            raise WearcapError(f"the body has no region {region!r}", expected=f"one of {', '.join(self.regions)}")
        rows = slice(None) if region is None else self.regions[region].to(self.rest_vertices.device)
        rest, weight = self.rest_vertices[rows].to(T_world_joint.t), self._weights[rows].to(T_world_joint.t)
        joints = self.skeleton.rest_joints.to(T_world_joint.t)
        # Joints' affine maps of rest points are blended per vertex in one matrix product.
        shift = T_world_joint.t - (T_world_joint.R @ joints[..., None])[..., 0]
        affine = torch.cat([T_world_joint.R, shift[..., None]], -1).flatten(-2)
        blended = (weight @ affine).unflatten(-1, (3, 4))
        if self.pose_blend is not None:
            local = local_rotations(self.skeleton, T_world_joint.R)[..., 1:, :, :]
            entries = (local - torch.eye(3, dtype=local.dtype, device=local.device)).flatten(-3)
            rest = rest + torch.einsum("...f,fvc->...vc", entries, self.pose_blend[:, rows].to(local))
        return (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]

    def with_offsets(self, t_parent_joint: Float[Tensor, "joint 3"]) -> "BodyModel":
        """The body with other bone offsets (m): vertices move with the joints that they are skinned to."""
        skeleton = replace(self.skeleton, t_parent_joint=t_parent_joint)
        moved = self._weights @ (skeleton.rest_joints - self.skeleton.rest_joints)
        return replace(self, skeleton=skeleton, rest_vertices=self.rest_vertices + moved)

    def scaled(self, scale: float) -> "BodyModel":
        """The body with all lengths scaled by one factor."""
        blend = None if self.pose_blend is None else self.pose_blend * scale
        rest = self.rest_vertices * scale
        return replace(self, skeleton=self.skeleton.scaled(scale), rest_vertices=rest, pose_blend=blend)

    @cached_property
    def _weights(self) -> Float[Tensor, "vertex joint"]:
        dense = self.skin_weights.new_zeros(len(self.rest_vertices), len(self.skeleton))
        return dense.scatter_add(1, self.skin_joints, self.skin_weights)

    @cached_property
    def volume(self) -> float:
        """Volume (m³) of the body in rest pose."""
        a, b, c = (self.rest_vertices[self.faces[:, corner]].double() for corner in range(3))
        return float((torch.linalg.cross(a, b) * c).sum() / 6)


def four_weights(weights: Float[Tensor, "vertex joint"]) -> tuple[Int64[Tensor, "vertex 4"], Float[Tensor, "vertex 4"]]:
    """The four joints with the largest weights on each vertex, and these weights, normalised to sum to 1."""
    top = weights.topk(4, dim=1)
    return top.indices, top.values / top.values.sum(1, keepdim=True).clamp_min(1e-12)


def contact_regions(
    skeleton: Skeleton,
    joints: Float[Tensor, "joint 3"],
    vertices: Float[Tensor, "vertex 3"],
    faces: Int64[Tensor, "face 3"],
    weights: Float[Tensor, "vertex joint"],
) -> dict[str, Int64[Tensor, "_"]]:
    """Vertex indices by region, from joints and vertices of the T-pose (feet flat and forward, palms down).

    Toes and heel are the ends of the sole (front 25 %, back 30 % of the foot's length); the palm is what faces
    down within the half of the hand next to the wrist.
    """
    marks = landmarks(skeleton)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    face, normal = torch.linalg.cross(b - a, c - a), torch.zeros_like(vertices)
    for corner in range(3):
        normal.index_add_(0, faces[:, corner], face)
    down = -torch.nn.functional.normalize(normal, dim=-1)[:, 2]
    regions: dict[str, Tensor] = {}
    for side in SIDES:
        ankle, wrist = marks.limb[f"{side}_leg"][2], marks.limb[f"{side}_arm"][2]
        foot = _carried_by(skeleton, weights, ankle) & (vertices[:, 2] < joints[ankle, 2] + 0.02)
        low, high = vertices[foot].min(0).values, vertices[foot].max(0).values
        along = (vertices[:, 0] - low[0]) / (high[0] - low[0])
        sole = foot & (vertices[:, 2] < low[2] + _SOLE_HEIGHT) & (down > 0.3)
        regions[f"{side}_toes"] = (sole & (along > 0.75)).nonzero()[:, 0]
        regions[f"{side}_heel"] = (sole & (along < 0.30)).nonzero()[:, 0]
        regions[f"{side}_sole"] = sole.nonzero()[:, 0]
        hand = _carried_by(skeleton, weights, wrist)
        reach = (vertices[:, 1] - joints[wrist, 1]).abs()
        near = hand & (reach < 0.55 * reach[hand].max()) & (reach > 0.01)
        regions[f"{side}_palm"] = (near & (down > 0.5)).nonzero()[:, 0]
    return regions


def _carried_by(skeleton: Skeleton, weights: Float[Tensor, "vertex joint"], joint: int) -> Bool[Tensor, "vertex"]:
    """Vertices whose skinning weights on a joint and its descendants sum to more than one half."""
    below = [other for other in range(len(skeleton)) if joint in skeleton.ancestors(other)]
    return weights[:, below].sum(1) > 0.5
