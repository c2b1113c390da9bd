"""ECHO's guidance (ECHO §3.3): gradient steps pull body and object towards the contacts that the network predicts."""

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
    threshold: float = 0.5
    """Contact probability from which a point counts as in contact."""

    def corrected(
        self, x0_hat: Float[Tensor, "batch frame feature"], scene: "GuidedScene"
    ) -> Float[Tensor, "batch frame feature"]:
        """x̂0 after one gradient step (classifier guidance, Dhariwal and Nichol 2021)."""
        with torch.enable_grad():
            x = x0_hat.detach().clone().requires_grad_(True)
            grad_touch, grad_stand = (
                torch.autograd.grad(cost, x, retain_graph=True)[0] if cost.requires_grad else torch.zeros_like(x)
                for cost in scene.costs(x, self.threshold)
            )
        human = scene.net.sizes[0]
        step = torch.zeros_like(x0_hat)
        step[..., :human] = self.human * grad_touch[..., :human] + self.feet * grad_stand[..., :human]
        step[..., human : human + OBJECT_SIZE] = self.object * grad_touch[..., human : human + OBJECT_SIZE]
        return x0_hat - step


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
        self, x0_hat: Float[Tensor, "batch frame feature"], threshold: float
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Squared distances (m²) of body points in contact to the object, and of feet in contact to the floor: means
        over each frame's points, summed over frames."""
        mean, scale = self.net.motion_normalizer.mean.to(x0_hat), self.net.motion_normalizer.scale.to(x0_hat)
        human, scene_object, contact = (x0_hat * scale + mean).split(self.net.sizes, -1)
        body = self.features.decode_body(human, self.frame)
        T_object = self.features.decode_object(scene_object, self.frame)
        in_contact = (contact.detach() + 1) / 2 > threshold
        has_object = self.conditioning.valid & self.conditioning.has_object
        touch, stand = x0_hat.new_zeros(()), x0_hat.new_zeros(())
        for item, surface in enumerate(self.surfaces):
            pose = forward_kinematics(surface.skeleton, body.R_parent_joint[item], body.t_world_root[item])
            touches = in_contact[item, :, :BODY_POINTS] & has_object[item, :, None]
            if touches.any():
                touch = touch + self._to_object(item, surface, pose, T_object[item], touches)
            stands = in_contact[item, :, BODY_POINTS:] & self.conditioning.valid[item, :, None]
            soles = site_positions(surface.skeleton, pose, FOOT_PATCHES)
            height = soles[..., 2] - self.conditioning.floor_height[item, :, None]
            stand = stand + (height.square() * stands / stands.sum(1, keepdim=True).clamp_min(1)).sum()
        return touch, stand

    def _to_object(
        self, item: int, surface: BodyModel, pose: Rigid, T_object: Rigid, touches: Tensor
    ) -> Float[Tensor, ""]:
        """Squared distances of one batch item's touching points to the nearest surface points, which stay fixed in the
        gradient."""
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
