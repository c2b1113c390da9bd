"""Input and output encoding of MocapEvery's estimator: head path and two wrists in, body motion out (§3.2)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FOOT_JOINTS, MIRROR, WRISTS, Skeleton
from wearcap.data.features import LIMBS, first_repeated
from wearcap.errors import require_choice
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.imu import acceleration

ENDS = (*WRISTS, *FOOT_JOINTS)
"""End-effectors whose positions the first stage predicts: hands and feet."""
FRAMES = ("own", "heading", "head", "world")
TRACKED = ("watches", "positions")
ROOTS = ("head", "window")
ACCELERATION_FRAMES = 4
"""Half span n of the finite difference in eq. 8, in frames."""


class Sensed(NamedTuple):
    """Sensor inputs, frame by frame at the estimator's rate."""

    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    R_world_wrist: Float[Tensor, "*batch time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "*batch time wrist 3"]
    """Free acceleration (m/s²), filtered."""
    t_world_wrist: Float[Tensor, "*batch time wrist 3"]
    """Positions (m) of tracked hands (AvatarPoser's protocol 1); zeros for watches."""

    def mirrored(self) -> "Sensed":
        """The inputs mirrored, left and right swapped."""
        flip = self.t_world_head.new_tensor(MIRROR)
        turn = torch.outer(flip, flip)
        return Sensed(
            self.R_world_head * turn,
            self.t_world_head * flip,
            self.R_world_wrist.flip(-3) * turn,
            self.acc_world_wrist.flip(-2) * flip,
            self.t_world_wrist.flip(-2) * flip,
        )


def synthetic_wrists(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "time joint 3 3"],
    t_world_root: Float[Tensor, "time 3"],
    fps: float,
    every: int = 1,
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"], Float[Tensor, "time wrist 3"]]:
    """Orientation, filtered acceleration (m/s²) and position (m) of both wrists of a motion (MocapEvery eq. 8).

    Acceleration is computed at the estimator's rate, `fps` / `every`: n = 4 and a mean filter over 7 of its frames.
    """
    body = forward_kinematics(skeleton, R_parent_joint, t_world_root)
    wrists = skeleton.indices(*WRISTS)
    t_world_wrist = body.t[:, wrists]
    return body.R[:, wrists], watch_acceleration(t_world_wrist, fps, every), t_world_wrist


def watch_acceleration(
    t_world_wrist: Float[Tensor, "time *wrist 3"], fps: float, every: int = 1
) -> Float[Tensor, "time *wrist 3"]:
    """Acceleration (m/s²) of points as watches give it (MocapEvery eq. 8), as `synthetic_wrists` does."""
    acc = acceleration(t_world_wrist.flatten(1), fps, ACCELERATION_FRAMES * every)
    frames = torch.arange(len(acc))[:, None] + every * torch.arange(-3, 4)
    return acc[frames.clamp(0, len(acc) - 1)].mean(1).reshape(t_world_wrist.shape)


@dataclass(frozen=True)
class WatchFeatures:
    """Encodes sensor windows and body motions in canonical, head-based coordinates."""

    frame: str
    """Canonical frame. "head": the pose of the window's first head (the paper). "heading": the same without its tilt,
    so that z stays up (ours). "own" (ours): head-centred, yaw-aligned coordinates of each frame's own head, with
    velocities instead of a path, so that the features do not depend on the position in the window. "world": world
    axes above the first frame's floor, as in AvatarPoser."""
    root: str = "head"
    """Origin of the predicted root and end-effectors: "head", the head of the same frame (ours: the values do not
    depend on the position in the window), or "window", the canonical frame's origin (the paper)."""
    absolute: bool = True
    """Whether the head's height above the floor and its up-vector are inputs. The up-vector is in world axes (the
    paper); with frame "heading" it is in the window's axes, which makes it independent of the world's heading."""
    wrists: str = "watches"
    """watches: orientation and acceleration. positions: orientation and position (three-point tracking)."""
    body: bool = False
    """Whether the wearer's body size is an input (ours; the paper uses a mean body)."""
    spread: bool = False
    """Whether the logarithm of every joint's standard deviation is among the outputs (ours)."""
    joints: int = 23
    fps: float = 30.0

    def __post_init__(self):
        for name, allowed in (("frame", FRAMES), ("wrists", TRACKED), ("root", ROOTS)):
            require_choice(getattr(self, name), allowed, f"watch features have no {name} {getattr(self, name)!r}")

    @property
    def size(self) -> int:
        """Number of input features: 27, 4 more for height and up-vector (the paper's 31), and the body size.

        With frame "own", velocities replace the position (3 more) and the tilt replaces the up-vector (3 fewer).
        """
        path, absolute = (30, 1) if self.frame == "own" else (27, 4)
        return path + (absolute if self.absolute else 0) + (len(LIMBS) if self.body else 0)

    @property
    def motion_size(self) -> int:
        """Number of output features: root translation, 6D rotations of all joints, and with `spread` their deviations."""
        return self.pose_size + (self.joints if self.spread else 0)

    @property
    def pose_size(self) -> int:
        return 3 + 6 * self.joints

    def canonical(self, sensed: Sensed, floor_height: Float[Tensor, "batch time"]) -> Rigid:
        """World poses of the windows' canonical frames, one per window or time step: R "batch #time 3 3"."""
        if self.frame == "own":
            heading = rotation.about_axis("z", rotation.yaw_of(sensed.R_world_head))
            return Rigid(heading, sensed.t_world_head)
        R, t = sensed.R_world_head[:, :1], sensed.t_world_head[:, :1]
        if self.frame == "heading":
            return Rigid(rotation.about_axis("z", rotation.yaw_of(R)), t)
        if self.frame == "world":
            up = t.new_tensor([0.0, 0.0, 1.0])
            return Rigid(torch.eye(3).to(R).expand_as(R), floor_height[:, :1, None] * up)
        return Rigid(R, t)

    def encode(
        self,
        sensed: Sensed,
        floor_height: Float[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
        canonical: Rigid,
    ) -> Float[Tensor, "batch time feature"]:
        """Input features of windows in their canonical frames; `size` holds the wearers' `body_size` (m)."""
        R_canonical_world, t = canonical.R.mT, canonical.t
        R_canonical_head = R_canonical_world @ sensed.R_world_head
        R_canonical_wrist = R_canonical_world[:, :, None] @ sensed.R_world_wrist
        vectors = sensed.acc_world_wrist if self.wrists == "watches" else sensed.t_world_wrist - t[:, :, None]
        vectors = (R_canonical_world[:, :, None] @ vectors[..., None])[..., 0]
        head, wrists = rotation.rot6d_from_matrix(R_canonical_head), rotation.rot6d_from_matrix(R_canonical_wrist)
        parts = [head, self._path(sensed, canonical), wrists.flatten(-2), vectors.flatten(-2)]
        if self.absolute:
            height = (sensed.t_world_head[..., 2] - floor_height)[..., None]
            up = R_canonical_head if self.frame == "heading" else sensed.R_world_head
            parts += [height / size[:, None, :1]] if self.frame == "own" else [height, up[..., :, 2]]
        if self.body:
            parts.append(size[:, None].expand(-1, sensed.t_world_head.shape[1], -1))
        return torch.cat(parts, -1)

    def _path(self, sensed: Sensed, canonical: Rigid) -> Float[Tensor, "batch time value"]:
        """Head position (m); with frame "own" its velocity (m/s) and angular velocity (rad/s, in head axes)."""
        R, t = canonical.R, canonical.t
        if self.frame != "own":
            return (R.mT @ (sensed.t_world_head - t)[..., None])[..., 0]
        velocity = first_repeated(sensed.t_world_head.diff(dim=1)) * self.fps
        angle = rotation.log(sensed.R_world_head[:, :-1].mT @ sensed.R_world_head[:, 1:])
        return torch.cat([(R.mT @ velocity[..., None])[..., 0], first_repeated(angle) * self.fps], -1)

    def encode_motion(
        self,
        R_parent_joint: Float[Tensor, "batch time joint 3 3"],
        t_world_root: Float[Tensor, "batch time 3"],
        sensed: Sensed,
        canonical: Rigid,
    ) -> Float[Tensor, "batch time motion"]:
        """Target features: root translation and local rotations, with the root's pose in the canonical frame; zeros in the
        places of deviations."""
        R, t = canonical.R, canonical.t
        root = (R.mT @ (t_world_root - t)[..., None])[..., 0] - self.origin(sensed, canonical)
        turned = torch.cat([(R.mT @ R_parent_joint[:, :, 0])[:, :, None], R_parent_joint[:, :, 1:]], 2)
        motion = torch.cat([root, rotation.rot6d_from_matrix(turned).flatten(-2)], -1)
        return F.pad(motion, (0, self.motion_size - self.pose_size))

    def decode_motion(
        self, motion: Float[Tensor, "batch predicted motion"], sensed: Sensed, canonical: Rigid
    ) -> tuple[Float[Tensor, "batch predicted joint 3 3"], Float[Tensor, "batch predicted 3"]]:
        """Local rotations and root translation (m) of the window's last frames, in the world."""
        count = motion.shape[1]
        R_parent_joint = rotation.matrix_from_rot6d(motion[..., 3 : self.pose_size].unflatten(-1, (-1, 6)))
        t_root = motion[..., :3] + self.origin(sensed, canonical)[:, -count:]
        R, t = canonical.R[:, -count:], canonical.t[:, -count:]
        turned = torch.cat([(R @ R_parent_joint[:, :, 0])[:, :, None], R_parent_joint[:, :, 1:]], 2)
        return turned, t + (R @ t_root[..., None])[..., 0]

    def origin(self, sensed: Sensed, canonical: Rigid) -> Float[Tensor, "batch time 3"]:
        """Origin of the predicted translations, in the canonical frame (m)."""
        if self.root == "window":
            return torch.zeros_like(sensed.t_world_head)
        return (canonical.R.mT @ (sensed.t_world_head - canonical.t)[..., None])[..., 0]
