"""A skinned body surface on a skeleton: the common form of all parametric bodies of a given shape."""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid


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
