"""Training of ECHO: tri-variate diffusion of human, object and contacts (ECHO §3.2, eq. 5–7, 12, 13)."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.data.windows import MIN_SCALE, Windows, drawn_batches, standardize
from wearcap.diffusion.levels import LevelMix
from wearcap.diffusion.process import add_noise
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.models.point_encoder import PointNeXt
from wearcap.systems.echo.features import CONTACTS, HANDS, OBJECT_SIZE, POINTS, Body, EchoFeatures
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import EchoModel
from wearcap.systems.echo.training_windows import EchoContent, EchoWindow
from wearcap.training import losses
from wearcap.training.base import Optimization, Training

STANDING = 0.73
"""Share of the training frames in which a foot's patch is on the floor."""
SLOPE = 4.0
"""Logit of a contact per unit of the output: at its target, ±1, the probability is 0.98."""


class EchoDiffusion(Training):
    """x0-prediction with an independent noise level for every frame and modality.

    Loss terms, weighted by `loss_weights`: "human", "object" and "contact" are mean squares in normalised space (the
    first three of eq. 12; squares are ours: their minimiser is the posterior mean, which the sampler's step expects
    as x̂0); "object_vertices" (root mean square over the surface, in closed form without vertices), "joints" and
    "skate" are distances in metres (its last three). Ours: "velocity" of the joints; "held", how the object moves in the hand
    that touches it; "foot_contact", cross entropy of the feet's contact, both classes alike. Frames without an active object do
    not count in the object terms. An object that looks the same from several sides is asked for in the orientation that can
    be known (`training_windows.canonical`), unless clean frames show another.
    """

    _feet: Tensor

    system = Echo

    def __init__(
        self,
        net: Callable[..., EchoDenoiser],
        features: EchoFeatures,
        schedule: Schedule,
        skeleton: Skeleton,
        loss_weights: dict[str, float],
        levels: LevelMix,
        optimization: Optimization,
        encoder: PointNeXt | None = None,
        contacts: bool = True,
    ):
        """`encoder` (frozen) computes the objects' features. `contacts` False leaves that modality out, as in ECHO's
        ablation."""
        super().__init__(optimization, loss_weights)
        self.net = net(
            sizes=(features.human_size, OBJECT_SIZE, CONTACTS),
            condition_size=features.condition_size,
            object_condition_size=features.object_condition_size,
        )
        self.encoder = None if encoder is None else encoder.requires_grad_(False).eval()
        self.features, self.schedule, self.skeleton, self.mix = features, schedule, skeleton, levels
        self.contacts = contacts
        feet = skeleton.indices("left_ankle", "left_toe", "right_ankle", "right_toe")
        # A list of indices would go to a GPU in each step.
        self.register_buffer("_feet", torch.tensor(feet), persistent=False)

    def pipeline_parts(self) -> dict[str, EchoModel]:
        parts = self.net, self.features, self.schedule, self.skeleton, self.encoder, self.contacts
        return {"model": EchoModel(*parts)}

    def set_statistics(self, dataset: Windows, limit: int = 1500) -> None:
        content = dataset.content
        assert isinstance(content, EchoContent)
        if content.features != self.features:
            what = "windows of other features than the model's"
            raise WearcapError(what, expected="equal data.features and model.features")
        rows: dict[str, list[Tensor]] = {"human": [], "object": [], "condition": []}
        for batch in drawn_batches(dataset, limit, 100):
            frame = self.features.canonical(batch.points)
            rows["human"].append(self.features.encode_body(batch.body, frame)[batch.valid])
            canonical = Rigid(batch.R_world_canonical, batch.t_world_canonical)
            scene_object = self.features.encode_object(canonical, frame)
            rows["object"].append(scene_object[batch.valid & batch.has_object])
            rows["condition"].append(self.features.condition(batch.points, batch.floor_height, batch.size)[batch.valid])
        human, scene_object, condition = (torch.cat(part) for part in rows.values())
        ranges = [self._range(human), self._range(scene_object), (torch.zeros(CONTACTS), torch.ones(CONTACTS))]
        self.net.motion_normalizer.set(*(torch.cat(part) for part in zip(*ranges)))
        standardize(self.net.condition_normalizer, condition)
        if self.encoder is not None and content.encoder is not None:
            self.encoder.load_state_dict(content.encoder.state_dict())

    def _range(self, rows: Float[Tensor, "row value"]) -> tuple[Tensor, Tensor]:
        """Mean and scale per value. If outputs are re-expressed as the window advances, root and object vectors get
        zero mean and one scale each, so that isotropic noise stays isotropic under rotation."""
        if not len(rows):
            return torch.zeros(rows.shape[1]), torch.ones(rows.shape[1])
        mean, scale = rows.mean(0), rows.std(0).clamp_min(MIN_SCALE)
        if self.features.moves:
            for part in (slice(0, 3), slice(3, 9)):
                mean[part], scale[part] = 0.0, rows[:, part].square().mean().sqrt()
        return mean, scale

    def levels(self, batch: EchoWindow) -> Float[Tensor, "batch time modality"]:
        """Noise levels of a batch; absent modalities are at level 1, pure noise."""
        levels = self.mix.levels(batch.level_draws, batch.draws)
        human, scene_object, contact = levels.unbind(-1)
        scene_object = torch.where(batch.has_object, scene_object, 1.0)
        contact = contact if self.contacts else torch.ones_like(contact)
        return torch.stack([human, scene_object, contact], -1)

    def truth(self, batch: EchoWindow, frame: Rigid) -> Float[Tensor, "batch time feature"]:
        """Ground truth x0 in normalised space."""
        human = self.features.encode_body(batch.body, frame)
        scene_object = self.features.encode_object(batch.T_world_object, frame)
        x0 = self.net.motion_normalizer(torch.cat([human, scene_object, 2 * batch.contact - 1], -1))
        # Frames without an object have zeros for its pose, and no contact.
        human, scene_object, contact = x0.split(self.net.sizes, -1)
        blank = torch.cat([human, torch.zeros_like(scene_object), -torch.ones_like(contact)], -1)
        return torch.where(self._counts(batch), x0, blank)

    @staticmethod
    def knowable(batch: EchoWindow, levels: Float[Tensor, "batch time modality"]) -> EchoWindow:
        """The batch with canonical poses of all objects that no clean frame shows."""
        clean = batch.has_object & batch.valid & (levels[..., 1] == 0)
        same = (batch.object_mean[:, :, None] == batch.object_mean[:, None]).all(-1)
        shown = (same & clean[:, None]).any(-1)[..., None]
        return batch._replace(
            R_world_object=torch.where(shown[..., None], batch.R_world_object, batch.R_world_canonical),
            t_world_object=torch.where(shown, batch.t_world_object, batch.t_world_canonical),
        )

    def _counts(self, batch: EchoWindow) -> Tensor:
        """Mask of meaningful features: all with an active object, else human and foot contacts."""
        always = torch.ones(sum(self.net.sizes), dtype=torch.bool, device=batch.valid.device)
        first = self.net.sizes[0]
        always[first : first + OBJECT_SIZE + BODY_POINTS] = False
        return always | batch.has_object[..., None]

    def terms(self, batch: EchoWindow) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        with losses.exact(batch.valid):
            frame = self.features.canonical(batch.points)
            levels = self.levels(batch)
            batch = self.knowable(batch, levels)
            x0 = self.truth(batch, frame)
            x_t = add_noise(x0, batch.noise, self.net.per_feature(levels), self.schedule)
            condition = self.features.condition(batch.points, batch.floor_height, batch.size, frame)
        encoded = self.net.encode(condition, self.net.object(batch.object_code), batch.has_object, batch.valid)
        x0_hat = self.net(x_t, levels, encoded, batch.valid).float()
        with losses.exact(x0):
            square = (x0_hat - x0).square() * self._counts(batch)
            weight = batch.valid.float()
            terms = {
                name: losses.masked_mean(part.mean(-1), weight)
                for name, part in zip(MODALITIES, square.split(self.net.sizes, -1))
            }
            if not self.contacts:
                terms.pop("contact")
            else:
                feet = x0_hat[..., -len(FOOT_PATCHES) :]
                standing = batch.contact[..., BODY_POINTS:]
                terms["foot_contact"] = losses.balanced_cross_entropy(SLOPE * feet, standing, STANDING, weight)
            outputs = self.net.motion_normalizer.inverse(x0_hat)
            first = self.net.sizes[0]
            T_object = self.features.decode_object(outputs[..., first : first + OBJECT_SIZE], frame)
            terms["object_vertices"] = self.object_vertices(T_object, batch)
            terms["held"] = self.held(T_object, batch)
            body = self.features.decode_body(outputs[..., : self.net.sizes[0]], frame)
            predicted, true = self._joints(body, batch), self._joints(batch.body, batch)
            terms["joints"] = losses.joint_position(predicted, true, weight)
            terms["velocity"] = losses.joint_velocity(predicted, true, weight, self.features.fps)
            feet = predicted[:, :, self._feet].unflatten(2, (4, 1))
            terms["skate"] = losses.foot_skate(feet, batch.contact[..., BODY_POINTS:], weight, self.features.fps)
        return terms

    def _joints(self, body: Body, batch: EchoWindow) -> Float[Tensor, "batch time joint 3"]:
        """Joint positions in the world (m)."""
        return forward_kinematics(self.skeleton, *body, batch.t_parent_joint[:, None]).t

    @staticmethod
    def object_vertices(T_world_object: Rigid, batch: EchoWindow) -> Float[Tensor, ""]:
        """Root mean squared distance (m) between the points of the predicted and the true surface."""
        turn, shift = T_world_object.R - batch.R_world_object, T_world_object.t - batch.t_world_object
        square = _mean_square(turn, shift, batch.object_mean, batch.object_spread)
        distance = (square.clamp_min(0) + losses.EPSILON_M2).sqrt()
        return losses.masked_mean(distance, (batch.valid & batch.has_object).float())

    def held(self, T_world_object: Rigid, batch: EchoWindow) -> Float[Tensor, ""]:
        """Mean squared error (m²/s²) of the velocity of the object's surface relative to a wrist whose hand touches it, the
        wrists as they were measured."""
        term = T_world_object.t.new_zeros(())
        for wrist, points in HANDS.items():
            at = POINTS.index(wrist)
            if at >= len(self.features.points):
                continue
            T_wrist_world = Rigid(batch.R_world_point[:, :, at], batch.t_world_point[:, :, at]).inverse()
            found, true = map(T_wrist_world.chain, (T_world_object, batch.T_world_object))
            turn, shift = (self.features.fps * (a - b).diff(dim=1) for a, b in ((found.R, true.R), (found.t, true.t)))
            square = _mean_square(turn, shift, batch.object_mean[:, 1:], batch.object_spread[:, 1:])
            same = (batch.object_mean[:, 1:] == batch.object_mean[:, :-1]).all(-1)
            held = (batch.contact[..., points] > 0).any(-1) & batch.valid & batch.has_object
            term = term + losses.masked_mean(square, (held[:, 1:] & held[:, :-1] & same).float())
        return term


def _mean_square(
    turn: Float[Tensor, "batch time 3 3"],
    shift: Float[Tensor, "batch time 3"],
    mean: Float[Tensor, "batch time 3"],
    spread: Float[Tensor, "batch time 3 3"],
) -> Float[Tensor, "batch time"]:
    """Mean of ‖A p + b‖² over an object's points, from their mean and second moment: ‖b‖² + 2 b·A μ + tr A S Aᵀ."""
    along = (shift * (turn @ mean[..., None])[..., 0]).sum(-1)
    return shift.square().sum(-1) + 2 * along + (turn @ spread * turn).sum((-1, -2))
