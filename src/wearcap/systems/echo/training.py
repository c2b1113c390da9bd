"""Training of ECHO: tri-variate diffusion of human, object and contacts (ECHO §3.2, eq. 5–7, 12, 13)."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.data.windows import MIN_SCALE, Windows, drawn_batches, standardize
from wearcap.diffusion.levels import LevelMix
from wearcap.diffusion.process import add_noise
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.models.point_encoder import PointNeXt
from wearcap.systems.echo.features import CONTACTS, OBJECT_SIZE, Body, EchoFeatures
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.queue import EchoModel
from wearcap.systems.echo.training_windows import EchoContent, EchoWindow
from wearcap.training import losses
from wearcap.training.base import OptimizerOf, SchedulerOf, Training


class EchoDiffusion(Training):
    """x0-prediction with an independent noise level for every frame and modality.

    Loss terms, weighted by `loss_weights`: "human", "object" and "contact" are mean squares in normalised space (the
    first three of eq. 12; squares are ours: their minimiser is the posterior mean, which the sampler's step expects
    as x̂0); "object_vertices" (root mean square over the surface, in closed form without vertices), "joints" and
    "skate" are distances in metres (its last three); "velocity" of the joints is ours. Frames without an active
    object do not count in the object terms.
    """

    system = Echo
    """The system that captures with the network."""

    def __init__(
        self,
        net: Callable[..., EchoDenoiser],
        features: EchoFeatures,
        schedule: Schedule,
        skeleton: Skeleton,
        loss_weights: dict[str, float],
        levels: LevelMix,
        optimizer: OptimizerOf,
        scheduler: SchedulerOf = None,
        encoder: PointNeXt | None = None,
        contacts: bool = True,
        seed: int = 0,
    ):
        """`encoder` (frozen) computes the objects' features. `contacts` False leaves that modality out, as in ECHO's
        ablation."""
        super().__init__(optimizer, scheduler, loss_weights, seed)
        self.net = net(
            human_size=features.human_size,
            object_size=OBJECT_SIZE,
            contact_size=CONTACTS,
            condition_size=features.condition_size,
            object_condition_size=features.object_condition_size,
        )
        self.encoder = None if encoder is None else encoder.requires_grad_(False).eval()
        self.features, self.schedule, self.skeleton, self.mix = features, schedule, skeleton, levels
        self.contacts = contacts
        self._feet = skeleton.indices("left_ankle", "left_toe", "right_ankle", "right_toe")

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
            scene_object = self.features.encode_object(batch.T_world_object, frame)
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

    def _counts(self, batch: EchoWindow) -> Tensor:
        """Mask of meaningful features: all with an active object, else human and foot contacts."""
        always = torch.ones(sum(self.net.sizes), dtype=torch.bool, device=batch.valid.device)
        first = self.net.sizes[0]
        always[first : first + OBJECT_SIZE + BODY_POINTS] = False
        return always | batch.has_object[..., None]

    def terms(self, batch: EchoWindow) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        frame = self.features.canonical(batch.points)
        x0, levels = self.truth(batch, frame), self.levels(batch)
        x_t = add_noise(x0, batch.noise, self.net.per_feature(levels), self.schedule)
        condition = self.features.condition(batch.points, batch.floor_height, batch.size, frame)
        encoded = self.net.encode(condition, self.net.object(batch.object_code), batch.has_object, batch.valid)
        x0_hat = self.net(x_t, levels, encoded, batch.valid).float()
        # Half precision is too coarse for millimetres.
        with torch.autocast(x0_hat.device.type, enabled=False):
            square = (x0_hat - x0).square() * self._counts(batch)
            weight = batch.valid.float()
            terms = {
                name: losses.masked_mean(part.mean(-1), weight)
                for name, part in zip(MODALITIES, square.split(self.net.sizes, -1))
            }
            if not self.contacts:
                terms.pop("contact")
            outputs = self.net.motion_normalizer.inverse(x0_hat)
            terms["object_vertices"] = self.object_vertices(outputs, batch, frame)
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

    def object_vertices(
        self, outputs: Float[Tensor, "batch time feature"], batch: EchoWindow, frame: Rigid
    ) -> Float[Tensor, ""]:
        """Root mean squared distance (m) between the points of the predicted and the true surface:
        ‖Δt‖² + 2 Δt·ΔR μ + tr ΔR S ΔRᵀ."""
        first = self.net.sizes[0]
        T = self.features.decode_object(outputs[..., first : first + OBJECT_SIZE], frame)
        turn, shift = T.R - batch.R_world_object, T.t - batch.t_world_object
        mean = (turn @ batch.object_mean[..., None])[..., 0]
        turned = (turn @ batch.object_spread * turn).sum((-1, -2))
        square = shift.square().sum(-1) + 2 * (shift * mean).sum(-1) + turned
        distance = (square.clamp_min(0) + losses.EPSILON_M2).sqrt()
        return losses.masked_mean(distance, (batch.valid & batch.has_object).float())
