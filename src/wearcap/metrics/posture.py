"""What a body does in a frame, by heights and angles of its joints, and errors by that. Pure functions on tensors."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.position import part_errors_cm

POSTURES = ("standing", "walking", "sitting", "squatting", "lying", "bending", "other", "head_down")
"""All but the last share out the frames. Lying includes crawling, squatting includes kneeling, walking running."""
PREFIX = "posture_"
"""Beginning of the names of scores by posture, which no table of whole recordings shows."""
SHARE = "share"
HEAD_DOWN_DEG, LEANING_DEG, BENT_DEG, WALKING_M_S = 40.0, 45.0, 60.0, 0.4
UPRIGHT, LOW = 0.85, 0.6
"""The pelvis' height as a share of that of somebody who stands straight: at least, and of those who are down."""
_SPEED_S = 0.5


def postures(
    skeleton: Skeleton, T_world_joint: Rigid, floor: Float[Tensor, "time"], fps: float
) -> dict[str, Bool[Tensor, "time"]]:
    """Which frames are of each of `POSTURES`, of a motion's joints (poses "time joint", m) over its floor (m)."""

    def middle(name: str) -> Tensor:
        return T_world_joint.t[:, skeleton.indices(*(f"{side}_{name}" for side in SIDES))].mean(1)

    def bend(side: str) -> Tensor:
        hip, knee, ankle = (T_world_joint.t[:, skeleton.index(f"{side}_{name}")] for name in ("hip", "knee", "ankle"))
        return _angle_deg(knee - hip, ankle - knee)

    pelvis = T_world_joint.t[:, 0]
    up = pelvis.new_tensor([0.0, 0.0, 1.0]).expand_as(pelvis)
    high = (pelvis[:, 2] - floor.to(pelvis)) / skeleton.root_height
    trunk = _angle_deg(middle("shoulder") - pelvis, up)
    folded = torch.stack([bend(side) for side in SIDES]).amin(0) > BENT_DEG
    thigh = skeleton.t_parent_joint[skeleton.index("left_knee")].norm()
    before = (middle("ankle") - middle("hip"))[:, :2].norm(dim=-1) > thigh.to(pelvis) / 2
    seat_thigh = _angle_deg(middle("knee") - middle("hip"), -up) > BENT_DEG
    step = min(max(1, round(_SPEED_S * fps)), len(pelvis) - 1)
    speed = (pelvis[step:, :2] - pelvis[:-step, :2]).norm(dim=-1) * fps / step if step else pelvis.new_zeros(1)
    speed = torch.cat([speed[:1].expand(step // 2), speed, speed[-1:].expand(step - step // 2)])[: len(pelvis)]
    left, found = torch.ones(len(pelvis), dtype=torch.bool), {}
    for name, of in (
        ("lying", (trunk > LEANING_DEG) & (high < LOW)),
        ("bending", trunk > LEANING_DEG),
        ("sitting", (high < UPRIGHT) & seat_thigh & before | (high < LOW / 2)),
        ("squatting", (high < UPRIGHT) & folded),
        ("walking", (high > UPRIGHT) & (speed > WALKING_M_S)),
        ("standing", high > UPRIGHT),
        ("other", left),
    ):
        found[name] = left & of
        left = left & ~of
    down = torch.asin(-T_world_joint.R[:, skeleton.index("head"), 2, 0].clamp(-1, 1)).rad2deg() > HEAD_DOWN_DEG
    return {name: found.get(name, down) for name in POSTURES}


def errors_by_posture(
    skeleton: Skeleton, of_truth: dict[str, Bool[Tensor, "time"]], error_cm: Float[Tensor, "time joint"], unit: str
) -> dict[str, float]:
    """Share of the frames of each posture, and mean errors of all joints and of each part in it, as scores by name.

    `unit` is that of the scores, "cm" or "mm". A posture that does not occur has a share of 0 alone.
    """
    scores, factor = {}, {"cm": 1.0, "mm": 10.0}[unit]
    for name, frames in of_truth.items():
        scores[f"{PREFIX}{name}_{SHARE}"] = frames.float().mean()
        if frames.any():
            error = factor * error_cm[frames]
            scores[f"{PREFIX}{name}_mpjpe_{unit}"] = error.mean()
            for part, value in part_errors_cm(skeleton, error).items():
                scores[f"{PREFIX}{name}_{part}_pe_{unit}"] = value
    return {name: value.item() for name, value in scores.items()}


def _angle_deg(a: Float[Tensor, "time 3"], b: Float[Tensor, "time 3"]) -> Float[Tensor, "time"]:
    return (normalize(a, dim=-1) * normalize(b, dim=-1)).sum(-1).clamp(-1, 1).acos().rad2deg()
