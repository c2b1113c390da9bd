"""ECHO's guidance (ECHO §3.3): the prediction is pulled to the contacts that it itself predicts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.kinematics import forward_kinematics, site_positions
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry.rigid import Rigid
from wearcap.systems.echo.features import OBJECT_SIZE, EchoFeatures
from wearcap.systems.echo.model import EchoDenoiser
from wearcap.systems.echo.queue import Conditioning


@dataclass(frozen=True)
class Guidance:
    """How far x̂0 goes down the gradient in every step. Costs are squares of metres, each frame's mean over its points;
    ours are the weights, and that the body is moved less than the object: it is known better."""

    object: float = 3.0
    """By which the object comes to the body's points that touch it."""
    human: float = 0.3
    """By which the body comes to the object."""
    feet: float = 1.0
    """By which feet that touch the floor come to it."""
    threshold: float = 0.5
    """From which probability on something touches."""

    def corrected(
        self, x0_hat: Float[Tensor, "batch frame feature"], scene: "GuidedScene"
    ) -> Float[Tensor, "batch frame feature"]:
        """x̂0 after one step down the gradient (classifier guidance, Dhariwal and Nichol 2021)."""
        with torch.enable_grad():
            x = x0_hat.detach().clone().requires_grad_(True)
            touch, stand = scene.costs(x, self.threshold)
            grad_touch, grad_stand = (
                torch.autograd.grad(cost, x, retain_graph=True)[0] if cost.requires_grad else zero
                for cost, zero in ((touch, torch.zeros_like(x)), (stand, torch.zeros_like(x)))
            )
        human = scene.net.sizes[0]
        step = torch.zeros_like(x0_hat)
        step[..., :human] = self.human * grad_touch[..., :human] + self.feet * grad_stand[..., :human]
        step[..., human : human + OBJECT_SIZE] = self.object * grad_touch[..., human : human + OBJECT_SIZE]
        return x0_hat - step


@dataclass(frozen=True, eq=False)
class GuidedScene:
    """What a window's prediction is held against."""

    net: EchoDenoiser
    features: EchoFeatures
    conditioning: Conditioning
    frame: Rigid
    surfaces: Sequence[BodyModel]
    """Each lane's contact points."""
    objects: Sequence[Sequence[KDTree]]
    """Points of each lane's objects, about their middles."""

    def costs(
        self, x0_hat: Float[Tensor, "batch frame feature"], threshold: float
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Squared distances (m²) of touching points to the object, and of standing feet to the floor: means over each
        frame's points, summed over frames."""
        mean, scale = self.net.motion_normalizer.mean.to(x0_hat), self.net.motion_normalizer.scale.to(x0_hat)
        human, scene_object, contact = (x0_hat * scale + mean).split(self.net.sizes, -1)
        body, T_object = (
            self.features.decode_body(human, self.frame),
            self.features.decode_object(scene_object, self.frame),
        )
        outputs = (contact.detach() + 1) / 2 > threshold
        there = self.conditioning.valid & self.conditioning.has_object
        touch, stand = x0_hat.new_zeros(()), x0_hat.new_zeros(())
        for item, surface in enumerate(self.surfaces):
            pose = forward_kinematics(surface.skeleton, body.R_parent_joint[item], body.t_world_root[item])
            touches = outputs[item, :, :BODY_POINTS] & there[item, :, None]
            if touches.any():
                touch = touch + self._to_object(item, surface, pose, T_object[item], touches)
            stands = outputs[item, :, BODY_POINTS:] & self.conditioning.valid[item, :, None]
            soles = site_positions(surface.skeleton, pose, FOOT_PATCHES)
            height = soles[..., 2] - self.conditioning.floor_height[item, :, None]
            stand = stand + (height.square() * stands / stands.sum(1, keepdim=True).clamp_min(1)).sum()
        return touch, stand

    def _to_object(
        self, item: int, surface: BodyModel, pose: Rigid, T_object: Rigid, touches: Tensor
    ) -> Float[Tensor, ""]:
        """Of one lane, to the nearest point of the surface, through which the gradient goes."""
        frame, point = touches.nonzero(as_tuple=True)
        arm = surface.vertices(pose)[frame, point] - T_object.t[frame]
        local = (T_object.R[frame].mT @ arm[..., None])[..., 0]
        number = self.conditioning.object_number[item, frame].long()
        share = 1 / touches.sum(1)[frame]
        total = local.new_zeros(())
        for index in number.unique().tolist():
            tree = self.objects[item][int(index)]
            mine = local[number == index]
            _, nearest = tree.query(mine.detach().double().numpy())
            target = torch.from_numpy(np.asarray(tree.data, np.float32)[nearest])
            total = total + ((mine - target).square().sum(1) * share[number == index]).sum()
        return total
