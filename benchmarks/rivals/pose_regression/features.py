"""Input features of the pose regressor: tracked head, and hands where tracked, as in AvatarPoser."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid


@dataclass(frozen=True)
class TrackedPoints:
    """Features per point: rotation (6D), its change, position and velocity (Jiang et al. 2022: 18 numbers).

    Each frame is expressed in its own head-centred, yaw-aligned coordinates (ours; in AvatarPoser's world frame the
    features depend on where the wearer is). height "stature": heights above the floor, and positions, as shares of the
    head's height in the rest pose; "floor": above the floor (m); "world": AvatarPoser's, heights in the world (m).
    """

    points: Sequence[str] = ("head",)
    """Names of the tracked joints, the head first."""
    height: str = "stature"

    def __post_init__(self):
        if not self.points or self.points[0] != "head":
            what = f"tracked points {', '.join(self.points) or '(none)'}"
            raise WearcapError(what, expected="the head, then what else is tracked")
        if self.height not in ("stature", "floor", "world"):
            what = f"tracked points have no height {self.height!r}"
            raise WearcapError(what, expected="one of stature, floor, world")

    @property
    def size(self) -> int:
        return 18 * len(self.points)

    def poses(
        self,
        skeleton: Skeleton,
        T_world_head: Rigid,
        R_parent_joint: Float[Tensor, "*batch joint 3 3"] | None = None,
        t_parent_joint: Float[Tensor, "*#batch joint 3"] | None = None,
    ) -> Rigid:
        """World poses "*batch point" of the points: the measured head, and a true body's joints anchored to it.

        `R_parent_joint` is required when more than the head is tracked.
        """
        if len(self.points) == 1:
            return Rigid(T_world_head.R[..., None, :, :], T_world_head.t[..., None, :])
        assert R_parent_joint is not None
        body = forward_kinematics(skeleton, R_parent_joint, torch.zeros_like(T_world_head.t), t_parent_joint)
        others = list(skeleton.indices(*self.points[1:]))
        t_head_point = body.t[..., others, :] - body.t[..., [skeleton.index("head")], :]
        t_head = T_world_head.t[..., None, :]
        return Rigid(
            torch.cat([T_world_head.R[..., None, :, :], body.R[..., others, :, :]], -3),
            torch.cat([t_head, t_head + t_head_point], -2),
        )

    def encode(
        self,
        R_world_point: Float[Tensor, "batch time point 3 3"],
        t_world_point: Float[Tensor, "batch time point 3"],
        floor_height: Float[Tensor, "batch time"],
        stature: Float[Tensor, "batch"],
        fps: float,
    ) -> Float[Tensor, "batch time feature"]:
        """Features of the points' paths. Changes are from the previous frame (per second), 0 in the first frame."""
        R_heading_world = rotation.about_axis("z", rotation.yaw_of(R_world_point[:, :, 0])).mT[:, :, None]
        R_heading_point = R_heading_world @ R_world_point
        step = R_world_point[:, :-1].mT @ R_world_point[:, 1:] - torch.eye(3).to(R_world_point)
        velocity = (R_heading_world[:, 1:] @ t_world_point.diff(dim=1)[..., None])[..., 0]
        origin = t_world_point[:, :, :1] * t_world_point.new_tensor([1.0, 1.0, 0.0])
        if self.height != "world":
            origin = origin + floor_height[..., None, None] * origin.new_tensor([0.0, 0.0, 1.0])
        position = (R_heading_world @ (t_world_point - origin)[..., None])[..., 0]
        if self.height == "stature":
            position = position / stature[:, None, None, None]
        turned, change = rotation.rot6d_from_matrix(R_heading_point), rotation.rot6d_from_matrix(step) * fps
        return torch.cat([turned, _after_first(change), position, _after_first(velocity * fps)], -1).flatten(-2)


def _after_first(change: Float[Tensor, "batch step point value"]) -> Float[Tensor, "batch time point value"]:
    return torch.nn.functional.pad(change, (0, 0, 0, 0, 1, 0))


def pasts(
    features: Float[Tensor, "batch time feature"], ends: Int64[Tensor, "batch end"], window: int
) -> tuple[Float[Tensor, "batch end window feature"], Bool[Tensor, "batch end window"]]:
    """The `window` frames up to and including each end, and which of them exist (not before the first frame)."""
    frames = ends[..., None] + torch.arange(1 - window, 1, device=ends.device)
    rows = torch.arange(len(features), device=ends.device)[:, None, None]
    return features[rows, frames.clamp_min(0)], frames >= 0
