"""What the head-driven networks see and say: head paths to conditions, poses to vectors and back."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation


@dataclass(frozen=True)
class HeadFeatures:
    """Encodes a head path (thesis §6.1: p = {t, R, v, ω}) and body poses in a gravity-keeping frame.

    frame "window": yaw and horizontal position of the window's first frame are removed (the document, as we read
    it). frame "heading": every frame's own head yaw is removed and no absolute position enters (ours; the root's
    rotation is told relative to where the head points, so nothing has to be re-expressed when windows move).
    height "relative": height of the head over its first frame's; "floor": over the floor (m); "stature": over the
    floor, as a share of the head's height in the rest pose.
    """

    frame: str = "heading"
    height: str = "stature"
    joints: int = 23

    def __post_init__(self):
        for name, allowed in (("frame", ("heading", "window")), ("height", ("stature", "floor", "relative"))):
            if getattr(self, name) not in allowed:
                raise WearcapError(f"head features have no {name} {getattr(self, name)!r}",
                                   expected=f"one of {', '.join(allowed)}")  # fmt: skip

    @property
    def condition_size(self) -> int:
        return 13 if self.frame == "heading" else 15

    @property
    def motion_size(self) -> int:
        return 6 * self.joints

    def frame_of(self, R_world_head: Float[Tensor, "batch time 3 3"]) -> Float[Tensor, "batch #time 3 3"]:
        """R_world_canonical of every frame (one for all frames when the frame is the window's)."""
        if self.frame == "window":
            R_world_head = R_world_head[:, :1]
        return rotation.about_axis("z", rotation.yaw_of(R_world_head))

    def condition(
        self,
        R_world_head: Float[Tensor, "batch time 3 3"],
        t_world_head: Float[Tensor, "batch time 3"],
        floor_height: Float[Tensor, "batch time"],
        stature: Float[Tensor, "batch"],
        fps: float,
    ) -> Float[Tensor, "batch time condition"]:
        """Features of a head path; `stature` is the head joint's height in the rest pose (m)."""
        R_canonical_world = self.frame_of(R_world_head).transpose(-1, -2)
        velocity = _difference(t_world_head) * fps
        step = rotation.log(R_world_head[:, :-1].transpose(-1, -2) @ R_world_head[:, 1:]) * fps
        angular_head = torch.cat([step[:, :1], step], 1)
        R_canonical_head = R_canonical_world @ R_world_head
        velocity = (R_canonical_world @ velocity[..., None])[..., 0]
        angular = (R_canonical_head @ angular_head[..., None])[..., 0]
        offset = R_canonical_world @ (t_world_head - t_world_head[:, :1])[..., None]
        height = offset[..., 2:, 0]
        if self.height != "relative":
            height = (t_world_head[..., 2] - floor_height)[..., None]
        if self.height == "stature":
            height = height / stature[:, None, None]
        horizontal = [offset[..., :2, 0]] if self.frame == "window" else []
        return torch.cat(
            [*horizontal, height, rotation.rot6d_from_matrix(R_canonical_head), velocity, angular], -1
        )

    def encode(
        self,
        R_parent_joint: Float[Tensor, "batch time joint 3 3"],
        R_world_head: Float[Tensor, "batch time 3 3"],
    ) -> Float[Tensor, "batch time motion"]:
        """Local rotations as 6D, the root's in the canonical frame (thesis: F = 23 × 6)."""
        R_root = self.frame_of(R_world_head).transpose(-1, -2) @ R_parent_joint[:, :, 0]
        R = torch.cat([R_root[:, :, None], R_parent_joint[:, :, 1:]], 2)
        return rotation.rot6d_from_matrix(R).flatten(-2)

    def decode(
        self, motion: Float[Tensor, "batch time motion"], R_world_head: Float[Tensor, "batch time 3 3"]
    ) -> Float[Tensor, "batch time joint 3 3"]:
        """The inverse of `encode`: R_parent_joint, the root's entry in the world."""
        R = rotation.matrix_from_rot6d(motion.unflatten(-1, (-1, 6)))
        R_root = self.frame_of(R_world_head) @ R[:, :, 0]
        return torch.cat([R_root[:, :, None], R[:, :, 1:]], 2)


def _difference(value: Float[Tensor, "batch time 3"]) -> Float[Tensor, "batch time 3"]:
    """Backward difference; the first frame repeats the second's."""
    step = value.diff(dim=1)
    return torch.cat([step[:, :1], step], 1)
