"""What predicted contacts change: guidance pulls body and object together in every step (ECHO §3.3), and objects without
contact are static (ours)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.kinematics import forward_kinematics, site_positions
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import HANDS, OBJECT_SIZE, POINTS, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.queue import Conditioning, Outputs

INSIDE = 10
"""Frames (at 30 Hz) to trim from both ends of a contact, where predicted object poses are less accurate."""
FADE = 20
"""Frames over which an object that is touched again blends from its static pose to its predicted pose."""


@dataclass(frozen=True)
class Guidance:
    """Step sizes along the negative gradient that x̂0 takes in every denoising step.

    Costs are squared distances (m²), each frame's mean over its points. The weights are ours, and so is moving the body
    less than the object: its pose is more certain.
    """

    object: float = 3.0
    """Step size of the object towards the body points in contact."""
    human: float = 0.3
    """Step size of the body towards the object."""
    feet: float = 1.0
    """Step size of the body that brings feet in contact to the floor."""
    held: float = 0.0
    """Step size of an object that stays where it is relative to the wrists whose hands touch it."""
    threshold: float = 0.5
    """Contact probability from which a point counts as in contact."""
    within_m: float = 0.0
    """Distance to the surface (m) at which a point in contact is near enough."""

    def corrected(
        self, x0_hat: Float[Tensor, "batch frame feature"], scene: "GuidedScene"
    ) -> Float[Tensor, "batch frame feature"]:
        """x̂0 after one gradient step (classifier guidance, Dhariwal and Nichol 2021)."""
        with torch.enable_grad():
            x = x0_hat.detach().clone().requires_grad_(True)
            grad_touch, grad_stand, grad_held = (
                torch.autograd.grad(cost, x, retain_graph=True)[0] if cost.requires_grad else torch.zeros_like(x)
                for cost in scene.costs(x, self.threshold, self.within_m)
            )
        human = scene.net.sizes[0]
        step = torch.zeros_like(x0_hat)
        step[..., :human] = self.human * grad_touch[..., :human] + self.feet * grad_stand[..., :human]
        scene_object = slice(human, human + OBJECT_SIZE)
        step[..., scene_object] = self.object * grad_touch[..., scene_object] + self.held * grad_held[..., scene_object]
        return x0_hat - step


@dataclass(frozen=True)
class ContactUse:
    """What the predicted contacts change; without effect if the network was trained without contacts."""

    guidance: Guidance | None = None
    """None: no guidance."""
    static_threshold: float | None = 0.7
    """Objects stay static in frames whose largest contact probability is below this (ours); None: objects keep their
    sampled poses (ECHO)."""


@dataclass(frozen=True, eq=False)
class GuidedScene:
    """Bodies, objects and conditioning of one window, against which its prediction is guided."""

    net: EchoDenoiser
    features: EchoFeatures
    conditioning: Conditioning
    frame: Rigid
    surfaces: Sequence[BodyModel]
    """Contact points on the body of each batch item."""
    objects: Sequence[Sequence[KDTree]]
    """Surface points of the objects of each batch item, relative to the objects' centres (m)."""

    def costs(
        self, x0_hat: Float[Tensor, "batch frame feature"], threshold: float, within_m: float = 0.0
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
        """Squared distances (m²) of body points in contact to the object, from `within_m` on, and of feet in contact to the
        floor, means over each frame's points; and of the displacement of the touching wrists from frame to frame in the
        object's axes. Sums over frames. Observed contacts are what they were observed to be, others the network's.
        """
        mean, scale = self.net.motion_normalizer.mean.to(x0_hat), self.net.motion_normalizer.scale.to(x0_hat)
        human, scene_object, contact = (x0_hat * scale + mean).split(self.net.sizes, -1)
        body = self.features.decode_body(human, self.frame)
        T_object = self.features.decode_object(scene_object, self.frame)
        in_contact = (contact.detach() + 1) / 2 > threshold
        in_contact = torch.where(self.conditioning.is_observed[..., 2:], self.conditioning.contact > 0.5, in_contact)
        has_object = self.conditioning.valid & self.conditioning.has_object
        touch, stand = x0_hat.new_zeros(()), x0_hat.new_zeros(())
        for item, surface in enumerate(self.surfaces):
            pose = forward_kinematics(surface.skeleton, body.R_parent_joint[item], body.t_world_root[item])
            touches = in_contact[item, :, :BODY_POINTS] & has_object[item, :, None]
            if touches.any():  # the nearest surface points stay fixed in the gradient
                frame, point = touches.nonzero(as_tuple=True)
                T = T_object[item][frame]
                local = (T.R.mT @ (surface.vertices(pose)[frame, point] - T.t)[..., None])[..., 0]
                number = self.conditioning.object_number[item, frame].long()
                share = 1 / touches.sum(1)[frame]
                total = local.new_zeros(())
                for index in number.unique().tolist():
                    tree = self.objects[item][int(index)]
                    mine = local[number == index]
                    _, nearest = tree.query(mine.detach().double().numpy())
                    target = torch.from_numpy(np.asarray(tree.data, np.float32)[nearest])
                    away = F.relu((mine - target).norm(dim=1) - within_m)
                    total = total + (away.square() * share[number == index]).sum()
                touch = touch + total
            stands = in_contact[item, :, BODY_POINTS:] & self.conditioning.valid[item, :, None]
            soles = site_positions(surface.skeleton, pose, FOOT_PATCHES)
            height = soles[..., 2] - self.conditioning.floor_height[item, :, None]
            stand = stand + (height.square() * stands / stands.sum(1, keepdim=True).clamp_min(1)).sum()
        return touch, stand, self._slip(T_object, in_contact)

    def _slip(self, T_object: Rigid, in_contact: Bool[Tensor, "batch frame contact"]) -> Float[Tensor, ""]:
        """Squared displacements (m²) from frame to frame of the tracked wrists in the axes of the object that they hold."""
        there, number = self.conditioning.valid & self.conditioning.has_object, self.conditioning.object_number
        same = there[:, 1:] & there[:, :-1] & (number[:, 1:] == number[:, :-1])
        slip = T_object.t.new_zeros(())
        for wrist, points in HANDS.items():
            at = self.conditioning.t_world_point[:, :, POINTS.index(wrist)]
            local = (T_object.R.mT @ (at - T_object.t)[..., None])[..., 0]
            holds = in_contact[..., points].any(-1) & self.conditioning.seen[:, :, POINTS.index(wrist)]
            slip = slip + (local.diff(dim=1).square().sum(-1) * (same & holds[:, 1:] & holds[:, :-1])).sum()
        return slip


def _is_touched(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Bool[Tensor, "batch frame"]:
    """Whether a contact probability on the active object reaches the threshold, or the object's pose is observed."""
    touch = outputs.contact_prob[..., :BODY_POINTS].amax(-1) >= threshold
    return conditioning.has_object & (touch | conditioning.is_observed[..., 1])


def _ends(touched: Bool[Tensor, "batch frame"]) -> tuple[Int64[Tensor, "batch frame"], Int64[Tensor, "batch frame"]]:
    """First and last frame of the contact that each frame belongs to."""
    count = touched.shape[1]
    frames = torch.arange(count).expand(touched.shape)
    start = torch.where(touched & ~F.pad(touched[:, :-1], (1, 0)), frames, 0).cummax(1).values
    stop = torch.where(touched & ~F.pad(touched[:, 1:], (0, 1)), frames, count - 1)
    return start, stop.flip(1).cummin(1).values.flip(1)


def inside(touched: Bool[Tensor, "batch frame"]) -> Bool[Tensor, "batch frame"]:
    """Contacts without their first and last `INSIDE` frames; of a short contact the middle remains. Contacts at the
    first or last frame count as continuing beyond it."""
    count = touched.shape[1]
    frames, far = torch.arange(count), 2 * count
    start, stop = _ends(touched)
    start, stop = torch.where(start > 0, start, -far), torch.where(stop < count - 1, stop, count + far)
    middle = ((start + stop) // 2).clamp(0, count - 1)
    deepest = torch.minimum(middle - start, stop - middle).clamp_max(INSIDE)
    return touched & (torch.minimum(frames - start, stop - frames) >= deepest)


def with_static_objects(conditioning: Conditioning, outputs: Outputs, threshold: float) -> Outputs:
    """Outputs in which untouched objects are static: at their pose in the last contact or, before their first
    contact, at its pose, both `INSIDE` frames within the contact. At the start of the next contact an object blends
    to its predicted pose over `FADE` frames. Objects without any contact are unchanged."""
    touched, observed = _is_touched(conditioning, outputs, threshold), conditioning.is_observed[..., 1]
    active = torch.where(conditioning.has_object, conditioning.object_number, -1.0)
    count = active.shape[1]
    frames = torch.arange(count).expand_as(active)
    at, left, found, weight = frames, frames, frames, torch.zeros_like(active)
    for number in active.unique():
        mine = active == number
        hit = inside(touched & mine) | (observed & mine)
        last, first = torch.where(hit, frames, -1).cummax(1).values, torch.where(hit, frames, count).amin(1)
        beside = torch.where(last >= 0, last, first[:, None])
        at = torch.where(mine & (beside < count), beside, at)
        begin, end = _ends(hit)
        before = F.pad(last[:, :-1], (1, 0), value=-1).take_along_dim(begin, 1)
        seen = torch.where(observed & mine, frames, -1).cummax(1).values >= begin
        fades = hit & (before >= 0) & (frames < end) & ~seen
        left, found = torch.where(fades, before, left), torch.where(fades, begin, found)
        share = 1 - (frames - begin) / (end - begin).clamp(1, FADE)
        weight = torch.where(fades, share.clamp_min(0), weight)
    R, t = outputs.R_world_object, outputs.t_world_object
    predicted, left, found = (
        Rigid(R.take_along_dim(frame[..., None, None], 1), t.take_along_dim(frame[..., None], 1))
        for frame in (at, left, found)
    )
    return _static(outputs, predicted, left, found, weight)


def _static(
    outputs: Outputs, predicted: Rigid, left: Rigid, found: Rigid, weight: Float[Tensor, "batch frame"]
) -> Outputs:
    """Predicted object poses, corrected by the share `weight` of the difference between the static pose (`left`) and
    the predicted pose at the contact's start (`found`); rotation in world axes about the centre."""
    turn = rotation.exp(weight[..., None] * rotation.log(left.R @ found.R.mT))
    return outputs._replace(
        R_world_object=turn @ predicted.R, t_world_object=predicted.t + weight[..., None] * (left.t - found.t)
    )


class StaticObjects:
    """The causal static-object constraint, frame by frame for one batch item: an untouched object keeps its last
    touched pose and blends from it when touched again; before its first contact it is unchanged."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._last: dict[float, Rigid] = {}
        """Pose of each object in its last frame with contact, by object number."""
        self._fading: tuple[float, Rigid, Rigid, int] | None = None
        """The object in contact, its static pose, its predicted pose at the contact's start, and frames since then."""

    def __call__(self, conditioning: Conditioning, outputs: Outputs) -> Outputs:
        """Outputs of one frame with static objects."""
        number, predicted = (conditioning.object_number.item(), Rigid(outputs.R_world_object, outputs.t_world_object))
        if not conditioning.has_object.item():
            self._fading = None
            return outputs
        if not _is_touched(conditioning, outputs, self.threshold).item():
            self._fading = None
            last = self._last.get(number)
            return outputs if last is None else outputs._replace(R_world_object=last.R, t_world_object=last.t)
        if conditioning.is_observed[..., 1].item():
            self._fading = (number, predicted, predicted, 0)
        elif self._fading is None or self._fading[0] != number:
            self._fading = (number, self._last.get(number, predicted), predicted, 0)
        _, left, found, ago = self._fading
        self._fading = (number, left, found, ago + 1)
        weight = outputs.contact_prob.new_full((1, 1), max(0.0, 1 - ago / FADE))
        static = _static(outputs, predicted, left, found, weight)
        self._last[number] = Rigid(static.R_world_object, static.t_world_object)
        return static
