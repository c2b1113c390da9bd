"""The four patches of the feet that meet the floor: a few vertices of the body's surface each."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.regions import FOOT_REGIONS
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid

PATCH_VERTICES = 10


@dataclass(frozen=True, eq=False)
class FootPatches:
    """Vertices of the patches (B_k of thesis eq. 4.6), skinned alone: 40 instead of some thousand."""

    body: BodyModel
    vertex: Int64[Tensor, "vertex"]
    patch: Int64[Tensor, "vertex"]
    """Number in `FOOT_PATCHES` of each vertex."""

    @classmethod
    def of(cls, body: BodyModel, count: int = PATCH_VERTICES) -> "FootPatches":
        """`count` vertices of each region, spread out (all of them where a region has fewer)."""
        chosen = [_spread(body, body.regions[name], count) for name in FOOT_REGIONS.values()]
        patch = torch.cat([torch.full((len(v),), k) for k, v in enumerate(chosen)])
        return cls(body, torch.cat(chosen), patch)

    @property
    def legs(self) -> list[list[int]]:
        """Joints of the left and the right leg, from hip to toes; the last two hold the patches."""
        skeleton = self.body.skeleton
        return [chain_to(skeleton, skeleton.index(f"{side}_toe")) for side in ("left", "right")]

    def points(self, T_world_joint: Rigid) -> Float[Tensor, "time vertex 3"]:
        """Positions (m) in the world, given the poses of all joints."""
        return self._only.vertices(T_world_joint)

    def share(self, contact: Float[Tensor, "*batch patch"]) -> Float[Tensor, "*batch vertex"]:
        """Contact of each vertex's patch, divided by the patch's number of vertices: sums over vertices are means."""
        size = torch.bincount(self.patch, minlength=len(FOOT_REGIONS)).to(contact)
        return (contact / size)[..., self.patch]

    def middles(self, points: Float[Tensor, "time vertex 3"]) -> Float[Tensor, "time patch 3"]:
        """Mean position of each patch's vertices."""
        one = torch.nn.functional.one_hot(self.patch, len(FOOT_REGIONS)).to(points)
        return torch.einsum("tvi,vp->tpi", points, one / one.sum(0))

    @cached_property
    def _only(self) -> BodyModel:
        """The patches as a body of their own."""
        whole = self.body
        blend = None if whole.pose_blend is None else whole.pose_blend[:, self.vertex]
        return BodyModel(
            whole.skeleton, whole.rest_vertices[self.vertex], whole.faces[:0],
            whole.skin_joints[self.vertex], whole.skin_weights[self.vertex], pose_blend=blend,
        )  # fmt: skip


def chain_to(skeleton: Skeleton, joint: int) -> list[int]:
    """Joints from just below the root to `joint`."""
    chain = []
    while joint > 0:
        chain.append(joint)
        joint = skeleton.parents[joint]
    return chain[::-1]


def _spread(body: BodyModel, region: Int64[Tensor, "all"], count: int) -> Int64[Tensor, "chosen"]:
    """Vertices of a region chosen one by one, each the furthest from those before."""
    points = body.rest_vertices[region]
    chosen = [int((points - points.mean(0)).norm(dim=1).argmax())]
    while len(chosen) < min(count, len(region)):
        chosen.append(int(torch.cdist(points, points[chosen]).min(1).values.argmax()))
    return region[chosen]
