"""HMD²'s feature encoding: head paths to conditions, poses to motion vectors and back."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.skeleton import FEET
from wearcap.data.features import LIMBS, deviations, first_repeated
from wearcap.errors import require_choice
from wearcap.geometry import rotation


@dataclass(frozen=True)
class HeadFeatures:
    """Encodes a head path (thesis §6.1: p = {t, R, v, ω}) and body poses in a gravity-keeping frame.

    frame "window": yaw and horizontal position of the window's first frame are removed (our reading of the thesis).
    frame "heading": every frame's own head yaw is removed and no absolute position enters (ours; the root's rotation
    is relative to the head's heading, so nothing has to be re-expressed when windows move).
    height "relative": height of the head above its first frame (m); "floor": above the floor (m); "stature": above
    the floor, as a share of the head's height in the rest pose.
    """

    frame: str = "heading"
    height: str = "stature"
    joints: int = 23
    contacts: bool = False
    """Whether the motion vector includes both feet's contacts as ±1 (as in EDGE; ours)."""
    spread: bool = False
    """Whether the motion vector includes the logarithm of every joint's standard deviation (ours)."""
    body: bool = False
    """Whether the condition includes the wearer's body size (ours): stature, length of leg, arm and trunk (m)."""

    def __post_init__(self):
        for name, allowed in (("frame", ("heading", "window")), ("height", ("stature", "floor", "relative"))):
            require_choice(getattr(self, name), allowed, f"head features have no {name} {getattr(self, name)!r}")

    @property
    def condition_size(self) -> int:
        return (13 if self.frame == "heading" else 15) + (len(LIMBS) if self.body else 0)

    @property
    def pose_size(self) -> int:
        """Values of the motion vector that are diffused: all but the deviations."""
        return 6 * self.joints + (FEET if self.contacts else 0)

    @property
    def motion_size(self) -> int:
        return self.pose_size + (self.joints if self.spread else 0)

    def frame_of(self, R_world_head: Float[Tensor, "batch time 3 3"]) -> Float[Tensor, "batch #time 3 3"]:
        """R_world_canonical of every frame, or one for all frames when `frame` is "window"."""
        if self.frame == "window":
            R_world_head = R_world_head[:, :1]
        return rotation.about_axis("z", rotation.yaw_of(R_world_head))

    def condition(
        self,
        R_world_head: Float[Tensor, "batch time 3 3"],
        t_world_head: Float[Tensor, "batch time 3"],
        floor_height: Float[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
        fps: float,
    ) -> Float[Tensor, "batch time condition"]:
        """Features of a head path; `size` holds the wearer's `body_size` (m)."""
        R_canonical_world = self.frame_of(R_world_head).transpose(-1, -2)
        velocity = first_repeated(t_world_head.diff(dim=1)) * fps
        step = rotation.log(R_world_head[:, :-1].transpose(-1, -2) @ R_world_head[:, 1:]) * fps
        angular_head = first_repeated(step)
        R_canonical_head = R_canonical_world @ R_world_head
        velocity = (R_canonical_world @ velocity[..., None])[..., 0]
        angular = (R_canonical_head @ angular_head[..., None])[..., 0]
        offset = R_canonical_world @ (t_world_head - t_world_head[:, :1])[..., None]
        height = offset[..., 2:, 0]
        if self.height != "relative":
            height = (t_world_head[..., 2] - floor_height)[..., None]
        if self.height == "stature":
            height = height / size[:, None, :1]
        horizontal = [offset[..., :2, 0]] if self.frame == "window" else []
        body_size = [size[:, None].expand(-1, height.shape[1], -1)] if self.body else []
        return torch.cat(
            [*horizontal, height, rotation.rot6d_from_matrix(R_canonical_head), velocity, angular, *body_size], -1
        )

    def encode(
        self,
        R_parent_joint: Float[Tensor, "batch time joint 3 3"],
        R_world_head: Float[Tensor, "batch time 3 3"],
        foot_contact: Float[Tensor, "batch time foot"],
    ) -> Float[Tensor, "batch time motion"]:
        """Local rotations as 6D, the root's in the canonical frame (thesis: F = 23 × 6); contacts if `contacts`; zeros in the
        places of deviations, which no motion has."""
        R_root = self.frame_of(R_world_head).transpose(-1, -2) @ R_parent_joint[:, :, 0]
        R = torch.cat([R_root[:, :, None], R_parent_joint[:, :, 1:]], 2)
        motion = rotation.rot6d_from_matrix(R).flatten(-2)
        motion = torch.cat([motion, 2 * foot_contact - 1], -1) if self.contacts else motion
        return F.pad(motion, (0, self.motion_size - self.pose_size))

    def decode(
        self, motion: Float[Tensor, "batch time motion"], R_world_head: Float[Tensor, "batch time 3 3"]
    ) -> tuple[Float[Tensor, "batch time joint 3 3"], Float[Tensor, "batch time foot"]]:
        """The inverse of `encode`: R_parent_joint (the root's in the world) and foot contact (0 without `contacts`)."""
        R = rotation.matrix_from_rot6d(motion[..., : 6 * self.joints].unflatten(-1, (-1, 6)))
        R_root = self.frame_of(R_world_head) @ R[:, :, 0]
        contact = (
            (motion[..., 6 * self.joints : self.pose_size] + 1) / 2
            if self.contacts
            else motion.new_zeros(*motion.shape[:2], FEET)
        )
        return torch.cat([R_root[:, :, None], R[:, :, 1:]], 2), contact.clamp(0, 1)

    def joint_std(self, motion: Float[Tensor, "batch time motion"]) -> Float[Tensor, "batch time deviation"]:
        """`deviations` of every joint; none without `spread`."""
        return deviations(motion[..., self.pose_size :])
