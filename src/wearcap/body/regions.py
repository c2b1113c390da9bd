"""Named parts of a body's surface that touch the world: toes, heels, soles, palms."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.landmarks import landmarks
from wearcap.body.skeleton import Skeleton

SOLE_HEIGHT = 0.025
"""Largest height (m) of a sole's vertices above the foot's lowest vertex."""

FOOT_REGIONS = {
    "left_heel": "left_heel",
    "left_toe_tip": "left_toes",
    "right_heel": "right_heel",
    "right_toe_tip": "right_toes",
}
"""Surface region of each of `FOOT_PATCHES`, in their order."""


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
    down = -vertex_normals(vertices, faces)[:, 2]
    regions: dict[str, Tensor] = {}
    for side in ("left", "right"):
        ankle, wrist = marks.limb[f"{side}_leg"][2], marks.limb[f"{side}_arm"][2]
        foot = _carried_by(skeleton, weights, ankle) & (vertices[:, 2] < joints[ankle, 2] + 0.02)
        low, high = vertices[foot].min(0).values, vertices[foot].max(0).values
        along = (vertices[:, 0] - low[0]) / (high[0] - low[0])
        sole = foot & (vertices[:, 2] < low[2] + SOLE_HEIGHT) & (down > 0.3)
        regions[f"{side}_toes"] = (sole & (along > 0.75)).nonzero()[:, 0]
        regions[f"{side}_heel"] = (sole & (along < 0.30)).nonzero()[:, 0]
        regions[f"{side}_sole"] = sole.nonzero()[:, 0]
        hand = _carried_by(skeleton, weights, wrist)
        reach = (vertices[:, 1] - joints[wrist, 1]).abs()
        near = hand & (reach < 0.55 * reach[hand].max()) & (reach > 0.01)
        regions[f"{side}_palm"] = (near & (down > 0.5)).nonzero()[:, 0]
    return regions


def vertex_normals(vertices: Float[Tensor, "vertex 3"], faces: Int64[Tensor, "face 3"]) -> Float[Tensor, "vertex 3"]:
    """Unit normals, the faces' weighted by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    face = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], face)
    return torch.nn.functional.normalize(total, dim=-1)


def _carried_by(skeleton: Skeleton, weights: Float[Tensor, "vertex joint"], joint: int) -> Bool[Tensor, "vertex"]:
    """Vertices whose skinning weights on a joint and its descendants sum to more than one half."""
    below = [joint]
    below += [j for j in range(joint + 1, len(skeleton)) if _descends(skeleton, j, joint)]
    return weights[:, below].sum(1) > 0.5


def _descends(skeleton: Skeleton, joint: int, ancestor: int) -> bool:
    while joint > ancestor:
        joint = skeleton.parents[joint]
    return joint == ancestor
