"""Body surface points whose contact with objects is labelled and predicted (ECHO §3.1: 64 of the body's vertices; the
choice of evenly spread, left-right symmetric points is ours)."""

from functools import cache

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import t_pose
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import MIRROR, xsens23

BODY_POINTS = 64
TOUCH_M = 0.05
"""Largest distance (m) of a point in contact to the object's surface: τ_c, which ECHO leaves open (ours)."""
HAND_POINTS = 7
"""Number of points on each hand, about the hands' share of SMPL-X's vertices."""


@cache
def _reference() -> BodyModel:
    return anny_body(xsens23())


@cache
def _rows() -> Int64[Tensor, "point"]:
    """Vertices of the default body: left hand, left side, then the same mirrored on the right.

    Farthest points of the surface in the T-pose, on the left half, and the nearest vertex to each one's mirror image.
    """
    body = _reference()
    at, main_joint = _in_t_pose(body), body.skin_joints[:, 0]
    hand = body.skeleton.index("left_wrist")
    left = at[:, 1] > 0.01
    wrist = _farthest(at, (main_joint == hand).nonzero()[:, 0], HAND_POINTS)
    rest = _farthest(at, (left & (main_joint != hand)).nonzero()[:, 0], BODY_POINTS // 2 - HAND_POINTS)
    left_points = torch.cat([wrist, rest])
    right = (at[:, 1] < -0.01).nonzero()[:, 0]
    twins = torch.cdist(at[left_points] * at.new_tensor(MIRROR), at[right]).argmin(1)
    return torch.cat([left_points, right[twins]])


def mirrored_points() -> Int64[Tensor, "point"]:
    """Index of each point's mirror twin on the other side."""
    return torch.arange(BODY_POINTS).roll(BODY_POINTS // 2)


def contact_points(body: BodyModel) -> BodyModel:
    """A body restricted to its contact points, in order; `vertices` returns their positions.

    On a body of another surface than the default one's: its vertices that are nearest in the T-pose, sizes aligned.
    """
    reference, rows = _reference(), _rows()
    if body.faces.shape != reference.faces.shape or not torch.equal(body.faces, reference.faces):
        wanted, given = _in_t_pose(reference)[rows], _in_t_pose(body)
        low, high = given.min(0).values, given.max(0).values
        first, last = (_in_t_pose(reference).min(0).values, _in_t_pose(reference).max(0).values)
        rows = torch.cdist((wanted - first) / (last - first) * (high - low) + low, given).argmin(1)
    blend = None if body.pose_blend is None else body.pose_blend[:, rows]
    return BodyModel(
        body.skeleton,
        body.rest_vertices[rows],
        torch.zeros(0, 3, dtype=torch.long),
        body.skin_joints[rows],
        body.skin_weights[rows],
        {},
        blend,
    )


def _in_t_pose(body: BodyModel) -> Float[Tensor, "vertex 3"]:
    """The surface with legs straight down and arms straight sideways, the root at the origin (m)."""
    R_parent_joint = local_rotations(body.skeleton, t_pose(body.skeleton).R)
    return body.vertices(forward_kinematics(body.skeleton, R_parent_joint.float(), torch.zeros(3)))


def _farthest(at: Float[Tensor, "vertex 3"], among: Int64[Tensor, "candidate"], count: int) -> Int64[Tensor, "count"]:
    """Farthest point sampling of some vertices, beginning at the one furthest from the body's middle plane."""
    places = at[among]
    chosen = [int(places[:, 1].argmax())]
    distance = (places - places[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (places - places[chosen[-1]]).norm(dim=1))
    return among[torch.tensor(chosen)]
