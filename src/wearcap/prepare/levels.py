"""How a wearer's head and feet are level: constant tilts of a motion's joint frames, found from how people stand.

Marker sets leave the head's frame pitched by 5…45°, and bind poses that stand on tiptoe or on heels tilt the soles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.landmarks import head_level, upright_frames, with_head_face
from wearcap.body.skeleton import SIDES, Site, Skeleton
from wearcap.geometry.rotation import swing_between
from wearcap.recording.motion import Motion

STILL_M_S = 0.12
"""Speed of ankle and toes below which a foot may stand."""
LOW_M = 0.03
"""Height above the usual lowest ankle within which a slow foot stands."""
LEAST_FRAMES = 5
WALK_M_S, WALK_S = (0.5, 2.2), 1.5
"""Speed (m/s) of the pelvis over the floor of who walks, and time (s) from which that shows how a head looks."""
_LARGEST_TILT = 0.6
"""Largest tilt (rad) of a sole that is taken for a frame's; more is a foot that does not stand."""
_LEG_UPRIGHT = 0.97
"""Cosine of the largest angle (14°) between the legs of who stands and the vertical."""
_PELVIS_TILT = 0.14
"""Mean tilt (rad) of an upright person's pelvis from which its frame is taken to be tilted, not the person."""
_NOD = 0.35
"""Tilt (rad) of an upright person's head from which the bind pose's frame of the head is doubted."""


@dataclass(frozen=True)
class Levels:
    """Tilts of the captured frames: of head and pelvis, and of ankles and toes by joint; None or absent where level or not known."""

    R_head_face: Float[Tensor, "3 3"] | None
    R_joint_sole: dict[str, Float[Tensor, "3 3"]]
    R_pelvis: Float[Tensor, "3 3"] | None = None


def levels_in(motions: Sequence[Motion]) -> Levels:
    """Estimate the tilts from motions of one wearer, all on one skeleton."""
    soles = {}
    for side in ("left", "right"):
        still = [_standing(motion, side) for motion in motions]
        if sum(int(frames.sum()) for frames in still) < LEAST_FRAMES:
            continue
        for name in (f"{side}_ankle", f"{side}_toe"):
            up = torch.cat([motion.joint(name).R[frames, 2] for motion, frames in zip(motions, still)])
            direction = torch.nn.functional.normalize(up.median(0).values, dim=0)
            if direction[2] > torch.tensor(_LARGEST_TILT).cos():
                soles[name] = swing_between(direction.new_tensor([0.0, 0.0, 1.0]), direction)
    return Levels(face_in(motions), soles, pelvis_in(motions))


def face_in(motions: Sequence[Motion], trusted: bool = False) -> Float[Tensor, "3 3"] | None:
    """Tilt of the head's frame in the upright frames of motions of one wearer.

    A trusted frame is corrected only if it is clearly off.
    """
    face = head_level(motions[0].skeleton, torch.cat([motion.R_parent_joint for motion in motions]))
    return None if face is not None and trusted and face[2, 2] > math.cos(_NOD) else face


def pelvis_in(motions: Sequence[Motion]) -> Float[Tensor, "3 3"] | None:
    """Tilt of the pelvis' frame while trunk and both legs are upright, where it is more than people's."""
    stands = []
    for motion in motions:
        legs = torch.stack([motion.joint(f"{side}_hip").t - motion.joint(f"{side}_ankle").t for side in SIDES])
        stands.append((legs[..., 2] > _LEG_UPRIGHT * legs.norm(dim=-1)).all(0))
    local = torch.cat([motion.R_parent_joint[frames] for motion, frames in zip(motions, stands)])
    R = upright_frames(motions[0].skeleton, local)
    if len(R) < LEAST_FRAMES:
        return None
    up = torch.nn.functional.normalize(R[:, 0, 2].median(0).values, dim=0)
    return swing_between(up.new_tensor([0.0, 0.0, 1.0]), up) if up[2] < math.cos(_PELVIS_TILT) else None


def walking_face(motion: Motion) -> Float[Tensor, "3 3"] | None:
    """Tilt of the head's frame in the frames in which the wearer walks; None where that is for less than `WALK_S`."""
    step_s = (motion.timestamps[-1] - motion.timestamps[0]).item() / max(1, len(motion) - 1)
    half = max(1, round(0.25 / max(step_s, 1e-3)))  # a mean over half a second, which sway does not move
    if len(motion) <= 2 * half:
        return None
    path = motion.t_world_root[2 * half :, :2] - motion.t_world_root[: -2 * half, :2]
    speed = path.norm(dim=-1) / (2 * half * step_s)
    R = motion.R_parent_joint[half:-half][(speed > WALK_M_S[0]) & (speed < WALK_M_S[1])]
    return head_level(motion.skeleton, R) if len(R) * step_s >= WALK_S else None


def _standing(motion: Motion, side: str) -> Bool[Tensor, "time"]:
    """Frames in which a foot stands on its whole sole: ankle and toes are still, and the ankle is low."""
    still = torch.zeros(len(motion), dtype=torch.bool)
    if len(motion) < 3:
        return still
    step_s = (motion.timestamps[2:] - motion.timestamps[:-2]).to(motion.t_world_root)[:, None]
    ankle, toe = (motion.joint(f"{side}_{name}").t for name in ("ankle", "toe"))
    slow = [((t[2:] - t[:-2]) / step_s).norm(dim=-1) < STILL_M_S for t in (ankle, toe)]
    still[1:-1] = slow[0] & slow[1]
    return still & (ankle[:, 2] < ankle[still, 2].quantile(0.1) + LOW_M) if still.any() else still


def with_levels(motion: Motion, levels: Levels) -> Motion:
    """The motion with the frames of head, ankles and toes turned level; no joint moves."""
    R, skeleton = motion.R_parent_joint, motion.skeleton
    if levels.R_head_face is not None:
        R = with_head_face(skeleton, R, levels.R_head_face)
    offsets, R = skeleton.t_parent_joint.clone(), R.clone()
    for side in ("left", "right"):
        ankle, toe = skeleton.indices(f"{side}_ankle", f"{side}_toe")
        of_ankle, of_toe = (levels.R_joint_sole.get(f"{side}_{name}", torch.eye(3)) for name in ("ankle", "toe"))
        R[:, ankle] = R[:, ankle] @ of_ankle
        R[:, toe] = of_ankle.T @ R[:, toe] @ of_toe
        offsets[toe] = of_ankle.T @ offsets[toe]
    skeleton = replace(skeleton, t_parent_joint=offsets)
    return replace(motion, skeleton=_flat_soles(skeleton), R_parent_joint=R)


def _flat_soles(skeleton: Skeleton) -> Skeleton:
    """Heels and toe tips of each foot on one level, that of the lower one, when the foot is level."""
    sites = dict(skeleton.sites)
    for side in ("left", "right"):
        heel, tip = (sites[f"{side}_{name}"] for name in ("heel", "toe_tip"))
        toe_z = skeleton.t_parent_joint[skeleton.index(f"{side}_toe"), 2].item()
        low = min(heel.t_joint_site[2], tip.t_joint_site[2] + toe_z)
        sites[f"{side}_heel"] = Site(heel.joint, (*heel.t_joint_site[:2], low))
        sites[f"{side}_toe_tip"] = Site(tip.joint, (*tip.t_joint_site[:2], low - toe_z))
    return replace(skeleton, sites=sites)
