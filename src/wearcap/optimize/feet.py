"""The four contact patches of the feet (left/right heel and toe): a few vertices of the body's surface each."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.model import FOOT_REGIONS, BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid

PATCH_VERTICES = 10


@dataclass(frozen=True, eq=False)
class FootPatches:
    """Vertices of the patches (B_k of thesis eq. 4.6), skinned without the rest of the body: 40 instead of
    thousands."""

    body: BodyModel
    vertex: Int64[Tensor, "vertex"]
    patch: Int64[Tensor, "vertex"]
    """Index in `FOOT_PATCHES` of each vertex's patch."""

    @classmethod
    def of(cls, body: BodyModel, count: int = PATCH_VERTICES) -> "FootPatches":
        """Choose `count` evenly spread vertices of each region (all vertices of a smaller region)."""
        chosen = [_spread(body, body.regions[name], count) for name in FOOT_REGIONS.values()]
        patch = torch.cat([torch.full((len(v),), k) for k, v in enumerate(chosen)])
        return cls(body, torch.cat(chosen), patch)

    @property
    def legs(self) -> list[list[int]]:
        """Joints of the left and the right leg, from hip to toe; the patches are skinned to the last two."""
        skeleton = self.body.skeleton
        return [chain_to(skeleton, skeleton.index(f"{side}_toe")) for side in ("left", "right")]

    def points(self, T_world_joint: Rigid) -> Float[Tensor, "time vertex 3"]:
        """World positions (m) of the vertices, given the poses of all joints."""
        return self._only.vertices(T_world_joint)

    def share(self, contact: Float[Tensor, "*batch patch"]) -> Float[Tensor, "*batch vertex"]:
        """Contact of each vertex's patch, divided by its number of vertices, so that sums over vertices are patch
        means."""
        size = torch.bincount(self.patch, minlength=len(FOOT_REGIONS)).to(contact)
        return (contact / size)[..., self.patch]

    def middles(self, points: Float[Tensor, "time vertex 3"]) -> Float[Tensor, "time patch 3"]:
        """Mean position of each patch's vertices."""
        one = torch.nn.functional.one_hot(self.patch, len(FOOT_REGIONS)).to(points)
        return torch.einsum("tvi,vp->tpi", points, one / one.sum(0))

    @cached_property
    def _only(self) -> BodyModel:
        """Body model that consists of the patches only."""
        whole = self.body
        blend = None if whole.pose_blend is None else whole.pose_blend[:, self.vertex]
        return BodyModel(
            whole.skeleton,
            whole.rest_vertices[self.vertex],
            whole.faces[:0],
            whole.skin_joints[self.vertex],
            whole.skin_weights[self.vertex],
            pose_blend=blend,
        )


def chain_to(skeleton: Skeleton, joint: int) -> list[int]:
    """Joints on the chain from the root (excluded) to `joint`."""
    chain = []
    while joint > 0:
        chain.append(joint)
        joint = skeleton.parents[joint]
    return chain[::-1]


def _spread(body: BodyModel, region: Int64[Tensor, "all"], count: int) -> Int64[Tensor, "chosen"]:
    """Farthest-point sampling of a region's vertices."""
    points = body.rest_vertices[region]
    chosen = [int((points - points.mean(0)).norm(dim=1).argmax())]
    while len(chosen) < min(count, len(region)):
        chosen.append(int(torch.cdist(points, points[chosen]).min(1).values.argmax()))
    return region[chosen]
