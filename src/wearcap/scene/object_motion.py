"""Object motion from the hands that hold the object, within its degrees of freedom (thesis §5.3.3, eq. 5.3–5.7)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import SceneObject

ANCHORS = ("right", "middle")
"""Reference point of an object held by two hands: the right hand (thesis), or the middle of both (ours)."""
_LEAST_APART_M = 0.05
"""Smallest distance between the hands that defines a direction; below it the last angle is kept."""


@dataclass(frozen=True)
class ObjectState:
    """Pose of an object, and its hinge angle or displacement."""

    T_world_object: Rigid
    value: float = 0.0
    """Hinge angle (rad) or displacement along the axis (m) from the initial pose; 0 for other kinds."""


def follow_hands(
    item: SceneObject,
    state: ObjectState,
    palms_world: Float[Tensor, "time hand 3"],
    holds: Bool[Tensor, "hand"],
    anchor: str = "middle",
) -> tuple[Rigid, Float[Tensor, "time"]]:
    """Poses of an object from the frame of the grasp (in `state`) on, and its angle or displacement (0 for others).

    `palms_world` holds the palm centres of the left and the right hand (m); `holds` marks the hands that hold the
    object. A hinge or axis stays within its limits; an object that slides in the plane keeps its height.
    """
    palms = palms_world[:, holds].double()
    kind = item.freedom.kind
    if kind in ("hinge", "axis"):
        if kind == "hinge":  # signed angle of the palms about the hinge (eq. 5.6, 5.4), averaged over hands
            arm = palms[..., :2] - torch.tensor(item.freedom.pivot, dtype=palms.dtype)[:2]
            change = _turned(arm.transpose(0, 1)).mean(0)
        else:
            change = ((palms - palms[:1]) @ torch.tensor(item.freedom.axis, dtype=palms.dtype)).mean(1)
        value = item.freedom.clamped(state.value + change)
        return item.freedom.moved(item.T_world_object, value), value
    # O* = R^α (O − h) + h + t, α the turn of the vector from the right hand to the left (eq. 5.3–5.5, 5.7). h is the
    # right hand or the middle of both, t its translation; a single hand gives a translation only.
    alone = palms.shape[1] == 1
    point = palms[:, -1] if alone or anchor == "right" else palms.mean(1)
    angle = palms.new_zeros(len(palms)) if alone else _turned((palms[:, 0] - palms[:, -1])[None, :, :2])[0]
    R = rotation.about_axis("z", angle)
    start = state.T_world_object
    t = point + (R @ (start.t.to(palms) - point[0])[:, None])[..., 0]
    if kind == "plane":
        t[:, 2] = start.t[2].to(t)
    return Rigid(R @ start.R.to(palms), t), torch.zeros(len(palms), dtype=torch.float64)


def _turned(vectors: Float[Tensor, "hand time 2"]) -> Float[Tensor, "hand time"]:
    """Signed angle (rad) from the first vector to each one, unwrapped over time; short vectors keep the last angle.

    Before the first vector that is long enough the angle is 0.
    """
    long = vectors.norm(dim=-1) > _LEAST_APART_M
    first = long.long().argmax(-1, keepdim=True)
    frame = torch.where(long, torch.arange(vectors.shape[1]), first).cummax(-1).values
    kept = vectors.gather(1, frame[..., None].expand_as(vectors))
    before, after = kept[:, :-1], kept[:, 1:]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    step = torch.atan2(cross, (before * after).sum(-1))
    return torch.nn.functional.pad(step, (1, 0)).cumsum(-1)
