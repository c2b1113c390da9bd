"""What a motion autoencoder sees of a window: a body's movement, wherever it is and whichever way it faces."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation

CONTACT_SPEED_M_S = 0.3
CONTACT_HEIGHT_M = {"ankle": 0.14, "toe": 0.07}
"""About 5 cm above where ankle and toe joint are when the foot is flat on the floor."""


@dataclass(frozen=True, eq=False)
class MotionFeatures:
    """Features per frame in the root's own heading frame (yaw removed), after Guo et al. 2020 and 2022.

    In this order: yaw rate (rad/s), the root's horizontal velocity (m/s) and height over the floor (m); the other
    joints' positions (m), seen from where the root stands on the floor; all joints' velocities (m/s); whether
    ankles and toes stand on the floor (0 or 1; low and slow). Every `every`-th frame counts: 20 per second of 60.
    """

    skeleton: Skeleton
    fps: float = 60.0
    every: int = 3

    @property
    def size(self) -> int:
        return 6 * len(self.skeleton) + 5

    def frames(self, window: int) -> int:
        """How many frames are left of a window. Raises WearcapError when `every` does not divide it."""
        if window % self.every:
            raise WearcapError(f"every {self.every}rd frame of a window of {window}", expected="a multiple")
        return window // self.every

    def encode(
        self,
        joints: Float[Tensor, "window time joint 3"],
        R_world_root: Float[Tensor, "window time 3 3"],
        floor_height: Float[Tensor, "window time"],
    ) -> Float[Tensor, "window frame feature"]:
        """Features of joint positions in the world (m)."""
        joints, R_world_root = joints[:, :: self.every], R_world_root[:, :: self.every]
        rate = self.fps / self.every
        yaw = rotation.yaw_of(R_world_root)
        R_heading_world = rotation.about_axis("z", -yaw)[:, :, None]
        ground = torch.cat([joints[:, :, 0, :2], floor_height[:, :: self.every, None]], -1)[:, :, None]
        local = (R_heading_world @ (joints - ground)[..., None])[..., 0]
        velocity_world = _difference(joints) * rate
        velocity = (R_heading_world @ velocity_world[..., None])[..., 0]
        yaw_rate = rotation.wrap_angle(_difference(yaw)) * rate
        contact = self._contact(local[..., 2], velocity.norm(dim=-1))
        root = [yaw_rate[..., None], velocity[:, :, 0, :2], local[:, :, 0, 2:]]
        return torch.cat([*root, local[:, :, 1:].flatten(-2), velocity.flatten(-2), contact], -1)

    def _contact(
        self, height: Float[Tensor, "window frame joint"], speed: Float[Tensor, "window frame joint"]
    ) -> Float[Tensor, "window frame 4"]:
        feet = [
            (self.skeleton.index(f"{side}_{name}"), highest)
            for side in ("left", "right")
            for name, highest in CONTACT_HEIGHT_M.items()
        ]
        found = [(height[..., joint] < top) & (speed[..., joint] < CONTACT_SPEED_M_S) for joint, top in feet]
        return torch.stack(found, -1).to(height.dtype)

    def joints(
        self, features: Float[Tensor, "window frame feature"]
    ) -> Float[Tensor, "window frame joint 3"]:
        """Joint positions (m) in the heading frame above the root's place on the floor, out of their features."""
        others = features[..., 4 : 1 + 3 * len(self.skeleton)].unflatten(-1, (-1, 3))
        root = torch.cat([torch.zeros_like(features[..., :2]), features[..., 3:4]], -1)
        return torch.cat([root[..., None, :], others], -2)


def _difference(value: Float[Tensor, "window frame *rest"]) -> Float[Tensor, "window frame *rest"]:
    """Backward difference; the first frame repeats the second's."""
    step = value.diff(dim=1)
    return torch.cat([step[:, :1], step], 1)
