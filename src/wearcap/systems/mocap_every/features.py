"""What MocapEvery's estimator is told and says: a head's path and two wrists in, a moving body out."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.features import LIMBS, first_repeated
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.sensors.imu import acceleration

WRISTS = ("left_wrist", "right_wrist")
ENDS = ("left_wrist", "right_wrist", "left_toe", "right_toe")
"""End-effectors whose positions stand between the two stages: hands and feet."""
FRAMES = ("own", "heading", "head", "world")
TRACKED = ("watches", "positions")
ROOTS = ("head", "window")
ACCELERATION_FRAMES = 4
"""n of eq. 8."""


class Sensed(NamedTuple):
    """What is worn, frame by frame at the estimator's rate."""

    R_world_head: Float[Tensor, "*batch time 3 3"]
    t_world_head: Float[Tensor, "*batch time 3"]
    R_world_wrist: Float[Tensor, "*batch time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "*batch time wrist 3"]
    """Free acceleration (m/s²), filtered."""
    t_world_wrist: Float[Tensor, "*batch time wrist 3"]
    """Where the hands are tracked (AvatarPoser's protocol 1); zeros otherwise."""


def mirrored(sensed: Sensed) -> Sensed:
    """The same seen in a mirror that swaps left and right."""
    flip = sensed.t_world_head.new_tensor(MIRROR)
    turn = torch.outer(flip, flip)
    return Sensed(
        sensed.R_world_head * turn, sensed.t_world_head * flip, sensed.R_world_wrist.flip(-3) * turn,
        sensed.acc_world_wrist.flip(-2) * flip, sensed.t_world_wrist.flip(-2) * flip,
    )  # fmt: skip


class Canonical(NamedTuple):
    """Poses in the world of the frames that a window is told in: one for all, or one per frame."""

    R: Float[Tensor, "batch #time 3 3"]
    t: Float[Tensor, "batch #time 3"]

    def last(self, count: int) -> "Canonical":
        """Those of the last frames."""
        return Canonical(self.R[:, -count:], self.t[:, -count:])


def synthetic_wrists(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "time joint 3 3"],
    t_world_root: Float[Tensor, "time 3"],
    fps: float,
    every: int = 1,
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"], Float[Tensor, "time wrist 3"]]:
    """Orientation, filtered acceleration (m/s²) and position (m) of both wrists of a motion (MocapEvery eq. 8).

    The acceleration is that of the estimator's rate, `fps` / `every`: n = 4 and a mean over 7 of its frames.
    """
    body = forward_kinematics(skeleton, R_parent_joint, t_world_root)
    wrists = skeleton.indices(*WRISTS)
    t_world_wrist = body.t[:, wrists]
    acc = acceleration(t_world_wrist.flatten(1), fps, ACCELERATION_FRAMES * every)
    frames = torch.arange(len(acc))[:, None] + every * torch.arange(-3, 4)
    acc = acc[frames.clamp(0, len(acc) - 1)].mean(1)
    return body.R[:, wrists], acc.unflatten(1, (-1, 3)), t_world_wrist


@dataclass(frozen=True)
class WatchFeatures:
    """Encodes windows of what is sensed, and body motions, in one frame per window.

    frame "head": the pose of the window's first head (the document's). "heading": the same without its tilt, so that
    z stays up (ours). "own" (ours): each frame in its own head's heading and place, with velocities instead of a path,
    so that nothing depends on where in the window it happens. "world": as sensed over the first frame's floor, as
    AvatarPoser has it.
    """

    frame: str = "heading"
    root: str = "head"
    """Where root and end-effectors are said from: "head", of the same frame (ours: a stride is then no matter of where
    in the window it happens), or "window", its frame's origin (the document)."""
    absolute: bool = True
    """Whether the head's height over the floor and its up-vector are told, too, this in the world (the document), or
    seen from the window's heading, so that north makes no difference."""
    wrists: str = "watches"
    """watches: orientation and acceleration. positions: orientation and position (three tracked points)."""
    body: bool = False
    """Whether the wearer's size is told (ours; the document knows a mean body alone)."""
    joints: int = 23
    fps: float = 30.0

    def __post_init__(self):
        for name, allowed in (("frame", FRAMES), ("wrists", TRACKED), ("root", ROOTS)):
            if getattr(self, name) not in allowed:
                raise WearcapError(f"watch features have no {name} {getattr(self, name)!r}",
                                   expected=f"one of {', '.join(allowed)}")  # fmt: skip

    @property
    def size(self) -> int:
        """27 and, where told, 4 of height and up-vector (the document's 31) and the body's size.

        In its own frame a head has velocities for a place (3 more), and its tilt is its up-vector (3 fewer).
        """
        path, absolute = (30, 1) if self.frame == "own" else (27, 4)
        return path + (absolute if self.absolute else 0) + (len(LIMBS) if self.body else 0)

    @property
    def motion_size(self) -> int:
        """Root translation, and 6D rotations of all joints."""
        return 3 + 6 * self.joints

    def canonical(self, sensed: Sensed, floor_height: Float[Tensor, "batch time"]) -> Canonical:
        """Poses in the world of the windows' frames."""
        if self.frame == "own":
            heading = rotation.about_axis("z", rotation.yaw_of(sensed.R_world_head))
            return Canonical(heading, sensed.t_world_head)
        R, t = sensed.R_world_head[:, :1], sensed.t_world_head[:, :1]
        if self.frame == "heading":
            return Canonical(rotation.about_axis("z", rotation.yaw_of(R)), t)
        if self.frame == "world":
            up = t.new_tensor([0.0, 0.0, 1.0])
            return Canonical(torch.eye(3).to(R).expand_as(R), floor_height[:, :1, None] * up)
        return Canonical(R, t)

    def encode(
        self,
        sensed: Sensed,
        floor_height: Float[Tensor, "batch time"],
        size: Float[Tensor, "batch limb"],
        canonical: Canonical,
    ) -> Float[Tensor, "batch time feature"]:
        """Features of windows in their frames; `size` holds the wearers' `body_size` (m)."""
        R, t = canonical
        R_canonical_world = R.mT
        R_canonical_head = R_canonical_world @ sensed.R_world_head
        turned = R_canonical_world[:, :, None] @ sensed.R_world_wrist
        places = sensed.acc_world_wrist if self.wrists == "watches" else sensed.t_world_wrist - t[:, :, None]
        places = (R_canonical_world[:, :, None] @ places[..., None])[..., 0]
        parts = [
            rotation.rot6d_from_matrix(R_canonical_head), self._path(sensed, canonical),
            rotation.rot6d_from_matrix(turned).flatten(-2), places.flatten(-2),
        ]  # fmt: skip
        if self.absolute:
            height = (sensed.t_world_head[..., 2] - floor_height)[..., None]
            up = R_canonical_head if self.frame == "heading" else sensed.R_world_head
            parts += [height / size[:, None, :1]] if self.frame == "own" else [height, up[..., :, 2]]
        if self.body:
            parts.append(size[:, None].expand(-1, sensed.t_world_head.shape[1], -1))
        return torch.cat(parts, -1)

    def _path(self, sensed: Sensed, canonical: Canonical) -> Float[Tensor, "batch time value"]:
        """Where the head is, or how it moves (m/s) and turns (rad/s, seen from itself)."""
        R, t = canonical
        if self.frame != "own":
            return (R.mT @ (sensed.t_world_head - t)[..., None])[..., 0]
        velocity = first_repeated(sensed.t_world_head.diff(dim=1)) * self.fps
        turn = rotation.log(sensed.R_world_head[:, :-1].mT @ sensed.R_world_head[:, 1:])
        return torch.cat([(R.mT @ velocity[..., None])[..., 0], first_repeated(turn) * self.fps], -1)

    def encode_motion(
        self,
        R_parent_joint: Float[Tensor, "batch time joint 3 3"],
        t_world_root: Float[Tensor, "batch time 3"],
        sensed: Sensed,
        canonical: Canonical,
    ) -> Float[Tensor, "batch time motion"]:
        """Root and local rotations, the root's pose in the window's frame."""
        R, t = canonical
        root = (R.mT @ (t_world_root - t)[..., None])[..., 0] - self.origin(sensed, canonical)
        turned = torch.cat([(R.mT @ R_parent_joint[:, :, 0])[:, :, None], R_parent_joint[:, :, 1:]], 2)
        return torch.cat([root, rotation.rot6d_from_matrix(turned).flatten(-2)], -1)

    def decode_motion(
        self, motion: Float[Tensor, "batch predicted motion"], sensed: Sensed, canonical: Canonical
    ) -> tuple[Float[Tensor, "batch predicted joint 3 3"], Float[Tensor, "batch predicted 3"]]:
        """R_parent_joint and root (m) of the window's last frames, still in the window's frame."""
        R = rotation.matrix_from_rot6d(motion[..., 3:].unflatten(-1, (-1, 6)))
        return R, motion[..., :3] + self.origin(sensed, canonical)[:, -motion.shape[1] :]

    def origin(self, sensed: Sensed, canonical: Canonical) -> Float[Tensor, "batch time 3"]:
        """Where translations are said from, in the window's frame."""
        if self.root == "window":
            return torch.zeros_like(sensed.t_world_head)
        return (canonical.R.mT @ (sensed.t_world_head - canonical.t)[..., None])[..., 0]


def to_world(
    R_parent_joint: Float[Tensor, "batch predicted joint 3 3"],
    t_root: Float[Tensor, "batch predicted 3"],
    canonical: Canonical,
) -> tuple[Float[Tensor, "batch predicted joint 3 3"], Float[Tensor, "batch predicted 3"]]:
    """A motion of the last frames out of its windows' frames."""
    R, t = canonical.last(t_root.shape[1])
    turned = torch.cat([(R @ R_parent_joint[:, :, 0])[:, :, None], R_parent_joint[:, :, 1:]], 2)
    return turned, t + (R @ t_root[..., None])[..., 0]
