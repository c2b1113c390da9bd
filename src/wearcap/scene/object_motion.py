"""How an object follows the hands that hold it, within its degrees of freedom (thesis §5.3.3, eq. 5.3–5.7)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import SceneObject

ANCHORS = ("right", "middle")
"""What carries an object held by two hands: the right hand (document), or the middle of both (ours)."""
LEAST_APART_M = 0.05
"""Hands nearer to each other than this tell no direction: the last angle stays."""


@dataclass(frozen=True)
class ObjectState:
    """Where an object stands, and how far it has been turned or pulled."""

    T_world_object: Rigid
    value: float = 0.0
    """Angle of a hinge (rad) or way along an axis (m) since the initial pose; 0 for the others."""


def follow_hands(
    thing: SceneObject,
    state: ObjectState,
    palms_world: Float[Tensor, "time hand 3"],
    holds: Bool[Tensor, "hand"],
    anchor: str = "middle",
) -> tuple[Rigid, Float[Tensor, "time"]]:
    """Poses of an object from the frame at which it is taken (in `state`) on, and its angle or way (0 for others).

    `palms_world` are the keypoints in the middle of the left and the right hand (m); `holds` says which of them hold.
    A hinge or axis stays within its limits; what slides in the plane keeps its height.
    """
    held = palms_world[:, holds].double()
    kind = thing.freedom.kind
    if kind in ("hinge", "axis"):
        change = hinge_angle(thing, held) if kind == "hinge" else axis_way(thing, held)
        value = thing.freedom.clamped(state.value + change)
        return thing.freedom.moved(thing.T_world_object, value), value
    T = carried(state.T_world_object, held, anchor)
    if kind == "plane":
        T.t[:, 2] = state.T_world_object.t[2].to(T.t)
    return T, torch.zeros(len(held), dtype=torch.float64)


def hinge_angle(thing: SceneObject, held: Float[Tensor, "time held 3"]) -> Float[Tensor, "time"]:
    """Signed angle (rad, continuous through ±π) of the contact point about the hinge (eq. 5.6, 5.4); hands' mean."""
    arm = held[..., :2] - torch.tensor(thing.freedom.pivot, dtype=held.dtype)[:2]
    return turned(arm.transpose(0, 1)).mean(0)


def axis_way(thing: SceneObject, held: Float[Tensor, "time held 3"]) -> Float[Tensor, "time"]:
    """Way (m) of the hands along an object's axis; hands' mean."""
    axis = torch.tensor(thing.freedom.axis, dtype=held.dtype)
    return ((held - held[:1]) @ axis).mean(1)


def carried(start: Rigid, held: Float[Tensor, "time held 3"], anchor: str) -> Rigid:
    """O* = R^α (O − h) + h + t, α the turn of the vector from the right hand to the left (eq. 5.3–5.5, 5.7).

    h is the right hand or the hands' middle, t its translation; one hand alone gives a translation only. The height
    follows the hands too.
    """
    alone = held.shape[1] == 1
    point = held[:, -1] if alone or anchor == "right" else held.mean(1)
    angle = held.new_zeros(len(held)) if alone else turned((held[:, 0] - held[:, -1])[None, :, :2])[0]
    R = rotation.about_axis("z", angle)
    lever = start.t.to(held) - point[0]
    return Rigid(R @ start.R.to(held), point + (R @ lever[:, None])[..., 0])


def turned(vectors: Float[Tensor, "hand time 2"]) -> Float[Tensor, "hand time"]:
    """Signed angle (rad) from the first vector to each one, unwrapped over time; short vectors keep the last angle.

    Before the first vector that is long enough the angle is 0.
    """
    long = vectors.norm(dim=-1) > LEAST_APART_M
    first = long.long().argmax(-1, keepdim=True)
    frame = torch.where(long, torch.arange(vectors.shape[1]), first).cummax(-1).values
    kept = vectors.gather(1, frame[..., None].expand_as(vectors))
    before, after = kept[:, :-1], kept[:, 1:]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    step = torch.atan2(cross, (before * after).sum(-1))
    return torch.nn.functional.pad(step, (1, 0)).cumsum(-1)
