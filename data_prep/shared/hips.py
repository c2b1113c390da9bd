"""Hip joints of a person, where a motion capture system put them wrong: found from how knees bend, and moved.

CMU's solved skeletons have hips too low and too far ahead in the pelvis, so that legs are too long for the way from hip
to ankle and people crouch: in all 17 walkers the knee is bent by 20 to 39° in stance, where it is by 5 to 18° in healthy
adults. One shift in the pelvis's axes per person takes this back; feet stay where they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import minimize
from torch import Tensor

from wearcap.body.kinematics import local_rotations
from wearcap.body.retarget import reach
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.gait import cycle_times, normal_knee_deg, standing
from wearcap.recording.motion import Motion

SPREAD_M = (0.015, 0.01)
"""Deviations of the shift ahead and up from the usual one among CMU's walkers (m)."""
STRAIGHTEST_DEG = 3.0
"""Flexion at which a corrected knee stops: people's knees do not snap straight."""
SOFT_M = 0.004
"""Width (m) of the transition to `STRAIGHTEST_DEG`."""
_CURVE_DEG, _STANDING_DEG = 10.0, 8.0
"""Deviations from the normal curve, and of a standing knee from `_STANDS_DEG`, from which people are taken to act."""
_STANDS_DEG, _STANDING_SHARE = 4.0, 0.25
"""Usual flexion of standing knees, and the quantile of a person's that is held against it: some stand bent for a while."""
_MOST_CYCLES, _LEAST_STANDING = 40, 60
"""Number of cycles beyond which more say nothing new, and of poses that show how somebody stands."""


@dataclass(frozen=True)
class _Legs:
    """Ways from ankle to hip of one leg in many poses, and the pelvis's axes ahead and up (world axes, m)."""

    hip: Float64[Tensor, "*pose 3"]
    ahead: Float64[Tensor, "*pose 3"]
    up: Float64[Tensor, "*pose 3"]
    thigh: Float64[Tensor, "*pose"]
    shank: Float64[Tensor, "*pose"]

    def moved(self, shift: Float64[Tensor, "2"]) -> tuple[Float64[Tensor, "*pose"], Float64[Tensor, "*pose"]]:
        """Flexion (degrees) of the knees and what the legs lack (m), after the hips' shift ahead and up (m)."""
        distance = (self.hip + shift[0] * self.ahead + shift[1] * self.up).norm(dim=-1)
        lacking = _lacking(distance, self.thigh, self.shank)
        thigh, shank = self.thigh, self.shank
        cos = ((distance - lacking).square() - thigh**2 - shank**2) / (2 * thigh * shank)
        return cos.clamp(-1, 1).acos().rad2deg(), lacking


def _lacking(distance: Tensor, thigh: Tensor, shank: Tensor) -> Tensor:
    """What a leg of nearly straight knee lacks to a distance of hip and ankle, softly from 0 (m)."""
    bend = torch.tensor(STRAIGHTEST_DEG, dtype=distance.dtype).deg2rad()
    farthest = (thigh**2 + shank**2 + 2 * thigh * shank * bend.cos()).sqrt()
    return SOFT_M * torch.nn.functional.softplus((distance - farthest) / SOFT_M)


def find_shift(
    motions: Sequence[Motion], usual_m: Sequence[float], R_pelvis_level: Float[Tensor, "3 3"] | None = None
) -> Float64[Tensor, "2"]:
    """How far (m) a person's hips belong ahead and up in the pelvis, from motions of one xsens23 skeleton.

    `R_pelvis_level` turns the motions' pelvis to the axes in which the shift is wanted.

    Knees of level walking are held against the normal curve and standing ones against 4°, legs that are too short cost,
    and so does what differs from `usual_m`, which remains for people who neither walk nor stand. People who act are
    outliers (Geman and McClure's cost).
    """
    walks, stands = _poses(motions, torch.eye(3) if R_pelvis_level is None else R_pelvis_level)
    normal, usual = normal_knee_deg().double(), torch.tensor(usual_m, dtype=torch.float64)
    cycles = min(len(walks.hip), _MOST_CYCLES)

    def cost(shift_cm: np.ndarray) -> float:
        shift = torch.from_numpy(shift_cm).double() / 100
        total = 0.5 * ((shift - usual) / torch.tensor(SPREAD_M)).square().sum()
        if cycles:
            flexion, lacking = walks.moved(shift)
            outlying = _outlying((flexion - normal).square().mean(1) / _CURVE_DEG**2).mean()
            total += cycles * (outlying + 0.25 * (100 * lacking).square().mean())
        if len(stands.hip) >= _LEAST_STANDING:
            flexion, lacking = stands.moved(shift)
            bent = (flexion.quantile(_STANDING_SHARE) - _STANDS_DEG) / _STANDING_DEG
            total += 3 * _outlying(bent**2) + 1.5 * (100 * lacking).square().mean()
        return total.item()

    return torch.from_numpy(minimize(cost, 100 * usual.numpy(), method="Nelder-Mead").x) / 100


def _outlying(square: Tensor) -> Tensor:
    return square / (1 + square)


def _poses(motions: Sequence[Motion], R_pelvis_level: Float[Tensor, "3 3"]) -> tuple[_Legs, _Legs]:
    """Both legs over all cycles of walking, and in standing frames (at most 10 a second)."""
    walks, stands = [], []
    for motion in motions:
        pelvis, still = (motion.joint("pelvis").R @ R_pelvis_level).double(), standing(motion)
        still = still.nonzero()[:: max(round(motion.fps / 10), 1), 0]
        for side, times in zip(("left", "right"), cycle_times(motion)):
            hip, knee, ankle = (motion.joint(f"{side}_{name}").t.double() for name in ("hip", "knee", "ankle"))
            thigh, shank = ((a - b).norm(dim=-1) for a, b in ((hip, knee), (knee, ankle)))
            each = torch.cat([hip - ankle, pelvis[..., 0], pelvis[..., 2], thigh[:, None], shank[:, None]], -1)
            walks.append(interpolate_clamped(motion.timestamps, each, times))
            stands.append(each[still])
    split = lambda rows: _Legs(*(part.squeeze(-1) for part in torch.cat(rows).split([3, 3, 3, 1, 1], -1)))  # noqa: E731
    return split(walks), split(stands)


def _nearer(
    way: Float[Tensor, "time leg 3"], length: Float[Tensor, "time leg"], steps: int = 6
) -> Float[Tensor, "time 3"]:
    """Small displacement (m) of the hips after which both ways from ankle to hip are at most `length`."""
    total = torch.zeros_like(way[:, 0])
    for _ in range(steps):
        here = way + total[:, None]
        excess = (here.norm(dim=-1) - length).clamp_min(0)
        weight = excess / excess.sum(1, keepdim=True).clamp_min(1e-9)
        total = total - ((weight * excess)[..., None] * torch.nn.functional.normalize(here, dim=-1)).sum(1)
    return total


def with_shift(motion: Motion, shift: Float64[Tensor, "2"]) -> Motion:
    """The motion with its hips moved ahead and up in the pelvis (m), and the knees that follow; soles and trunk stay.

    The pelvis joint remains between the hips. Where legs are too short for it, the body comes nearer to the feet.
    """
    skeleton, T = motion.skeleton, motion.T_world_joint
    moved = torch.stack([shift[0], shift[0] * 0, shift[1]]).to(T.t)
    offsets = skeleton.t_parent_joint.clone()
    trunk = skeleton.index("l5")
    offsets[trunk] -= moved
    t_root = motion.t_world_root + T.R[:, 0] @ moved
    legs = [skeleton.indices(*(f"{side}_{name}" for name in ("hip", "knee", "ankle"))) for side in ("left", "right")]
    way = torch.stack([t_root + T.R[:, 0] @ offsets[hip] - T.t[:, ankle] for hip, _, ankle in legs], 1)
    thigh, shank = (torch.stack([offsets[leg[k]].norm() for leg in legs]) for k in (1, 2))
    nearer = _nearer(way, way.norm(dim=-1) - _lacking(way.norm(dim=-1), thigh, shank))
    t_root = t_root + nearer
    R = T.R.clone()
    for hip, knee, ankle in legs:
        start = t_root + T.R[:, 0] @ offsets[hip]
        middle = start + (R[:, hip] @ offsets[knee])
        end = middle + (R[:, knee] @ offsets[ankle])
        points = (point.double() for point in (start, middle, end, T.t[:, ankle], 0.01 * R[:, knee, :, 0]))
        upper, lower = (turn.to(R) for turn in reach(*points))
        R[:, hip], R[:, knee] = upper @ R[:, hip], lower @ R[:, knee]
    return replace(
        motion,
        skeleton=replace(skeleton, t_parent_joint=offsets),
        R_parent_joint=local_rotations(skeleton, R),
        t_world_root=t_root,
        provenance=motion.provenance | {"hips_moved_m": f"{shift[0]:.4f} ahead, {shift[1]:.4f} up"},
    )
