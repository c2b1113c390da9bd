"""Features of the motion autoencoder: a body's movement, independent of its place and heading, and its windows.

The windows of the head-driven networks have floors and heads as they were sensed; here the body is what it was.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.data.batch import Batch
from wearcap.data.features import first_repeated
from wearcap.data.packing import Track
from wearcap.data.transforms import joint_twins
from wearcap.data.windows import Content
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.metrics.physics import CONTACT_SPEED_M_S, local_floor
from wearcap.recording import Motion, Recording
from wearcap.recording.store import RecordingFile, RecordingStore

CONTACT_HEIGHT_M = {"ankle": 0.12, "toe": 0.05}
"""Heights (m) about 5 cm above those of ankle and toe joint in a flat foot; the floor here is at the toe joints."""
FLOOR_WINDOW_S = 1.0
"""Half width (s) of the interval whose lowest true joint is the floor. The ten seconds of floor penetration would span
a flight of stairs, and heights above its foot do not describe a pose."""


class Movement(NamedTuple):
    """Joint positions of a motion at the autoencoder's frame rate, or windows of one (with leading axes)."""

    joints: Float[Tensor, "*window frame joint 3"]
    R_world_root: Float[Tensor, "*window frame 3 3"]
    floor_height: Float[Tensor, "*window frame"]

    def windows(self, length: int, stride: int) -> "Movement":
        """All complete windows of a movement, along a new leading axis."""
        count = max(0, len(self.floor_height) - length) // stride + (len(self.floor_height) >= length)
        frames = stride * torch.arange(count)[:, None] + torch.arange(length)
        return Movement(*(part[frames] for part in self))


@dataclass(frozen=True, eq=False)
class MotionFeatures:
    """Features per frame in the root's own heading frame (yaw removed), after Guo et al. 2020 and 2022.

    In this order: yaw rate (rad/s), the root's horizontal velocity (m/s) and height over the floor (m); the other
    joints' positions (m), seen from where the root stands on the floor; all joints' velocities (m/s); whether
    ankles and toes stand on the floor (0 or 1; low and slow). Of a motion at `fps` only every `every`-th frame is
    used: 20 of 60 in a second. Bodies keep their size.
    """

    skeleton: Skeleton
    fps: float = 60.0
    every: int = 3

    @property
    def size(self) -> int:
        return 6 * len(self.skeleton) + 5

    def movement(self, motion: Motion, floor_height: Float[Tensor, "frame"] | None = None) -> Movement:
        """Joint positions of a whole motion, by default above its own floor (the lowest joint within a second).

        Raises WearcapError for a motion of other joints, or at another rate than `fps`.
        """
        if motion.skeleton.joint_names != self.skeleton.joint_names:
            what = f"a motion of skeleton {motion.skeleton.name!r}"
            raise WearcapError(what, expected=f"the joints of {self.skeleton.name!r}")
        if len(motion) > 1 and abs(motion.fps - self.fps) > 0.01 * self.fps:
            what = f"a motion of {motion.fps:.2f} frames per second"
            raise WearcapError(what, expected=f"{self.fps}", fix="Resample it first.")
        seen = slice(None, None, self.every)
        R = motion.R_parent_joint[seen]
        joints = forward_kinematics(motion.skeleton, R, motion.t_world_root[seen]).t
        if floor_height is None:
            floor_height = local_floor(joints, self.fps / self.every, FLOOR_WINDOW_S)
        return Movement(joints, R[:, 0], floor_height)

    def encode(self, movement: Movement) -> Float[Tensor, "window frame feature"]:
        """Features of windows."""
        joints, R_world_root, floor_height = movement
        rate = self.fps / self.every
        yaw = rotation.yaw_of(R_world_root)
        R_heading_world = rotation.about_axis("z", -yaw)[:, :, None]
        ground = torch.cat([joints[:, :, 0, :2], floor_height[..., None]], -1)[:, :, None]
        local = (R_heading_world @ (joints - ground)[..., None])[..., 0]
        velocity = (R_heading_world @ (first_repeated(joints.diff(dim=1)) * rate)[..., None])[..., 0]
        yaw_rate = rotation.wrap_angle(first_repeated(yaw.diff(dim=1))) * rate
        speed, contact = velocity.norm(dim=-1), []
        for side in ("left", "right"):
            for name, highest in CONTACT_HEIGHT_M.items():
                joint = self.skeleton.index(f"{side}_{name}")
                contact.append((local[:, :, joint, 2] < highest) & (speed[:, :, joint] < CONTACT_SPEED_M_S))
        root = [yaw_rate[..., None], velocity[:, :, 0, :2], local[:, :, 0, 2:]]
        feet = torch.stack(contact, -1).to(local.dtype)
        return torch.cat([*root, local[:, :, 1:].flatten(-2), velocity.flatten(-2), feet], -1)

    def joints(self, features: Float[Tensor, "window frame feature"]) -> Float[Tensor, "window frame joint 3"]:
        """Joint positions (m) decoded from features, in the heading frame with origin on the floor below the root."""
        others = features[..., 4 : 1 + 3 * len(self.skeleton)].unflatten(-1, (-1, 3))
        root = torch.cat([torch.zeros_like(features[..., :2]), features[..., 3:4]], -1)
        return torch.cat([root[..., None, :], others], -2)


class MovementContent(Content):
    """Complete windows of true motion, of which every `features.every`-th frame is used."""

    own_rate = True

    def __init__(self, features: MotionFeatures):
        self.features = features

    def settings(self) -> Any:
        return self.features

    def twins(self, file: RecordingFile) -> dict[str, list[int]]:
        return {"t_world_joint": joint_twins(self.features.skeleton)}

    def track(self, store: RecordingStore, name: str, recording: Recording, every: int) -> Track:
        assert recording.motion is not None
        if every != self.features.every:
            what, expected = f"windows of every {every}th frame", f"every {self.features.every}th, as the features"
            raise WearcapError(what, where=store.path_of(name), expected=expected)
        joints, R_world_root, floor_height = self.features.movement(recording.motion)
        return Track({"t_world_joint": joints, "R_world_root": R_world_root, "floor_height": floor_height})

    def batch(self, batch: Batch) -> Movement:
        return Movement(*(batch.values[name] for name in ("t_world_joint", "R_world_root", "floor_height")))
