"""Arm posture for a hold: elbow and hand turned so that wrist and forearm are at ease."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.simulation.handling.grips import Hold
from wearcap.simulation.people.ik import two_bone
from wearcap.simulation.people.track import blur

SWIVELS = (-0.25, 0.05, 0.35, 0.65, 0.95, 1.25)
"""Candidate swivels of the elbow about the shoulder-wrist line (rad): 0 points down, positive lifts outwards."""
YAWS = (-0.70, -0.42, -0.14, 0.14, 0.42, 0.70)
"""Candidate yaws of the hand about the palm's normal, relative to the direction that the grip prefers (rad)."""
HABIT = 0.2
"""Swivel without any cost (rad)."""
EASE = {"twist": 0.8, "flexion": 0.65, "deviation": 0.30, "swivel": 0.7, "yaw": 0.5}
"""Scale of the cost of each angle (rad)."""
LIMITS = {"twist": 1.40, "flexion": 1.15, "deviation": 0.50}
"""Joint limits in both directions (rad): turn of the forearm from thumb-up, flexion of the wrist, and its deviation."""
STRETCHED = 0.985
SPACING_S, SMOOTH_S = 0.05, 0.15
SHARPNESS = 3.0


@dataclass(frozen=True)
class ArmBones:
    """Offsets of elbow and wrist in the rest pose, and the hinge axis of the elbow."""

    upper: Float[Tensor, "3"]
    fore: Float[Tensor, "3"]
    hinge: Float[Tensor, "3"]
    palm: Float[Tensor, "3"]
    """Position of the palm relative to the wrist (m)."""
    sign: float

    @property
    def axis(self) -> Float[Tensor, "3"]:
        """Unit vector along the forearm."""
        return self.fore / self.fore.norm()

    @property
    def length(self) -> float:
        return float(self.upper.norm() + self.fore.norm())


@dataclass(frozen=True)
class ArmPosture:
    """A hold with the arm posture chosen for it."""

    wrist: Float[Tensor, "time 3"]
    hand: Float[Tensor, "time 3 3"]
    swivel: Float[Tensor, "time"]


def elbow_pole(swivel: Float[Tensor, "*batch"], sign: float) -> Float[Tensor, "*batch 3"]:
    """Side to which the elbow points, in the chest's axes."""
    return torch.stack([torch.full_like(swivel, -0.35), sign * swivel.sin(), -swivel.cos()], -1)


def forearm_and_wrist(
    R_forearm: Float[Tensor, "*batch 3 3"], R_hand: Float[Tensor, "*batch 3 3"], axis: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Turn of the forearm about its axis (rad) and bend of the wrist (rotation vector, in the turned forearm's axes).

    R_hand = R_forearm · exp(turn axis) · exp(bend) with the bend perpendicular to the axis.
    """
    between = R_forearm.transpose(-1, -2) @ R_hand
    quat = rotation.quat_wxyz_from_matrix(between)
    quat = torch.where(quat[..., :1] < 0, -quat, quat)
    turn = 2 * torch.atan2(quat[..., 1:] @ axis, quat[..., 0])
    bend = rotation.log(rotation.exp(-turn[..., None] * axis) @ between)
    return turn, bend


def take(
    bones: ArmBones, hold: Hold, R_world_chest: Float[Tensor, "time 3 3"], shoulder: Float[Tensor, "time 3"], fps: float
) -> ArmPosture:
    """Choose elbow swivel and hand yaw over time: the softly least strained of a grid of both, smooth in time."""
    count = len(shoulder)
    some = np.unique(np.linspace(0, count - 1, max(int(count / fps / SPACING_S), 2)).round().astype(int))
    swivels, yaws = (torch.tensor(v, dtype=torch.float64) for v in (SWIVELS, YAWS))
    grid = torch.cartesian_prod(swivels, yaws)[:, :, None].expand(-1, -1, len(some))
    part = Hold(hold.palm[some], hold.normal[some], hold.fingers[some])
    strain = _strain(bones, part, R_world_chest[some], shoulder[some], grid[:, 0], grid[:, 1])
    share = torch.softmax(-SHARPNESS * strain, 0)
    chosen = (share[:, None] * grid).sum(0).numpy()
    full = np.stack([np.interp(np.arange(count), some, row) for row in chosen], 1)
    swivel, yaw = torch.from_numpy(blur(full, SMOOTH_S, fps)).unbind(-1)
    hand = hold.hand(bones.sign, yaw)
    return ArmPosture(hold.palm - hand @ bones.palm, hand, swivel)


def _strain(
    bones: ArmBones, hold: Hold, R_world_chest: Tensor, shoulder: Tensor, swivel: Tensor, yaw: Tensor
) -> Float[Tensor, "pick time"]:
    hand = hold.hand(bones.sign, yaw)
    wrist = hold.palm - hand @ bones.palm - shoulder
    pole = (R_world_chest @ elbow_pole(swivel, bones.sign)[..., None])[..., 0]
    shape = swivel.shape
    R_upper, flexion = two_bone(bones.upper, bones.fore, bones.hinge, wrist.reshape(-1, 3), pole.reshape(-1, 3))
    R_forearm = (R_upper @ rotation.exp(flexion[:, None] * bones.hinge)).reshape(*shape, 3, 3)
    turn, bend = forearm_and_wrist(R_forearm, hand, bones.axis)
    parts = {"twist": turn, "flexion": bend[..., 0], "deviation": bend[..., 2]}
    strain = ((swivel - HABIT) / EASE["swivel"]) ** 2 + (yaw / EASE["yaw"]) ** 2
    for name, angle in parts.items():
        strain = strain + (angle / EASE[name]) ** 2 + (10 * (angle.abs() - LIMITS[name]).clamp(min=0)) ** 2
    far = wrist.norm(dim=-1) / bones.length - STRETCHED
    return strain + (far.clamp(min=0) / 0.01) ** 2
