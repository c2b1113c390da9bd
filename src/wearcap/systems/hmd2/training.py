"""Training of the conditional motion diffusion model (thesis §6.2, eq. 6.1–6.4)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from einops import rearrange
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.skeleton import FEET, Skeleton
from wearcap.data.windows import MIN_SCALE, Windows, drawn_batches
from wearcap.diffusion.process import add_noise
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.systems.hmd2.conditions import CONDITIONS
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.training_windows import HeadContent, HeadWindow
from wearcap.systems.hmd2.windows import DiffusionModel
from wearcap.training import losses
from wearcap.training.base import Optimization, Training

CONTACT_LOGIT = 4.0
"""Logit of a contact whose predicted feature is 1; features of contacts are from -1 to 1."""
_TAIL_FRAMES = 20
"""Decay length, in frames, of the extra loss weight of a window's last frames."""


@dataclass(frozen=True)
class Levels:
    """Which noise levels windows are trained at."""

    tilt: float
    """Their density is proportional to the level to this power: 0 draws them uniformly, as the thesis does; more (ours)
    favours high levels, on which sampling in few steps depends."""
    pure: float
    """Share of the windows that are pure noise (level 1), on which the mean in one step depends (ours)."""

    def __post_init__(self):
        if not 0 <= self.pure < 1:
            raise WearcapError(f"a share pure={self.pure} of the windows", expected="from 0 to less than 1")

    def of(self, uniform: Tensor) -> Tensor:
        """Levels from uniform random numbers."""
        return (uniform / (1 - self.pure)).clamp_max(1) ** (1 / (1 + self.tilt))


@dataclass(frozen=True)
class Loss:
    """What is minimised: terms by their `weights` (`MotionDiffusion`)."""

    weights: dict[str, float]
    tail: float
    """A window's last frames weigh up to 1 + `tail` (ours): with small strides they are the output."""
    contact_share: float | None
    """Share of the labels that are contact, by which both classes weigh alike; None: plain cross entropy."""


class MotionDiffusion(Training):
    """x0-prediction under one noise level per window.

    Terms of the loss: "motion" is the thesis's plain MSE; "joints", "velocity", "skate", "contact" (cross entropy) and
    "spread" (of the joints' deviations, whose errors teach nothing else) are ours (0 leaves them out). Conditions beside the head's path are dropped at random (`Condition.drop`).
    """

    system = HMD2
    _feet: Tensor

    def __init__(
        self,
        net: Callable[..., MotionDenoiser],
        features: HeadFeatures,
        schedule: Schedule,
        skeleton: Skeleton,
        fps: float,
        levels: Levels,
        loss: Loss,
        optimization: Optimization,
        conditions: Mapping[str, Mapping[str, Any]] | None = None,
    ):
        """`conditions`: settings of those of `CONDITIONS` that the network has beside the head's path, by name."""
        super().__init__(optimization, loss.weights, spread=features.spread)
        given = {name: CONDITIONS[name](**settings) for name, settings in (conditions or {}).items()}
        self.net = net(
            motion_size=features.motion_size,
            condition_size=features.condition_size,
            conditions={name: condition.size for name, condition in given.items()},
        )
        self.given, self.levels, self.loss = given, levels, loss
        for condition in given.values():
            if condition.weights is not None:
                self.add_module(condition.weights, condition.encoder)
        self.features, self.schedule, self.skeleton, self.fps = features, schedule, skeleton, fps
        feet = skeleton.indices("left_ankle", "left_toe", "right_ankle", "right_toe")
        self.register_buffer("_feet", torch.tensor(feet), persistent=False)

    def pipeline_parts(self) -> dict[str, DiffusionModel]:
        parts = self.features, self.schedule, self.skeleton, self.fps, self.given, self.fitted_dof
        return {"model": DiffusionModel(self.net, *parts)}

    def set_statistics(self, dataset: Windows, limit: int = 2000) -> None:
        """Set normalisation from a training split. Raises WearcapError unless its windows have the model's inputs."""
        content, net = dataset.content, self.net
        assert isinstance(content, HeadContent)
        sizes = {name: condition.size for name, condition in content.conditions.items()}
        if [*sizes.items()] != [*net.conditions.items()]:
            fix = "Set data.dataset.content.conditions and model.conditions alike (surroundings=…)."
            raise WearcapError(
                f"windows with features {sizes}", expected=f"{net.conditions}, as the model has", fix=fix
            )
        for name, condition in self.given.items():
            made_by = content.conditions[name].encoder
            if condition.weights is not None:
                condition.encoder.load_state_dict(made_by.state_dict())
            elif condition.encoder != made_by:
                raise WearcapError(f"{name} of {made_by!r}", expected=condition.encoder)
        statistics = feature_statistics(dataset, self.features, net.conditions, limit)
        for value, part in zip((0.0, 1.0), statistics["motion"]):
            part[self.features.pose_size :] = value
        net.motion_normalizer.set(*statistics["motion"])
        net.condition_encoder.normalizer.set(*statistics["head"])
        for name in net.conditions:
            net.condition_encoder.get_submodule(f"{name}.normalizer").set(*statistics[name])

    def conditions(self, batch: HeadWindow) -> Conditions:
        """Conditioning of a batch; what is dropped is decided by the windows' random numbers."""
        given, floor = batch.given.clone(), batch.floor_from_head
        for number, (name, condition) in enumerate(self.given.items()):
            chance = batch.chance[:, [*CONDITIONS].index(name), None]
            given[..., number] &= chance >= condition.drop
            if condition.measures_floor:  # the floor's height is dropped with them
                floor = torch.where(given[..., number], batch.floor_height, floor)
        head = self.features.condition(batch.R_world_head, batch.t_world_head, floor, batch.size, self.fps)
        return Conditions(head, batch.others, given)

    def _predicted(self, batch: HeadWindow, x0: Tensor) -> Tensor:
        """x̂0 of a batch in normalised motion space; half the windows are self-conditioned on a first estimate."""
        with losses.exact(x0):
            conditions = self.conditions(batch)
        encoded = self.net.encode(conditions, batch.valid)
        level = self.levels.of(batch.level)
        noise = batch.noise[..., : self.features.pose_size]
        noise = F.pad(noise, (0, x0.shape[-1] - noise.shape[-1]))
        x_t = add_noise(x0, noise, level, self.schedule)
        if not self.net.self_conditioning:
            return self.net(x_t, level, encoded, batch.valid)
        with torch.no_grad():
            guess = self.net(x_t, level, encoded, batch.valid)
        last = guess * (batch.chance[:, -1] < 0.5)[:, None, None]
        return self.net(x_t, level, encoded, batch.valid, last)

    def terms(self, batch: HeadWindow) -> dict[str, Tensor]:
        with losses.exact(batch.t_world_head):
            motion = self.features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
            x0 = self.net.motion_normalizer(motion)
            x0[..., self.features.pose_size :] = 0.0
        x0_hat = self._predicted(batch, x0)
        with losses.exact(x0):
            return self._errors(x0_hat.float(), x0, batch)

    def away(self, batch: HeadWindow) -> Tensor | None:
        """Of one step from noise, which gives the mean."""
        if not self.features.spread:
            return None
        batch = batch._replace(level=torch.ones_like(batch.level))
        motion = self.features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
        x0_hat = self._predicted(batch, self.net.motion_normalizer(motion)).float()
        R_hat, _ = self.features.decode(self.net.motion_normalizer.inverse(x0_hat), batch.R_world_head)
        found, true = (batch.joints_from_head(self.skeleton, R) for R in (R_hat, batch.R_parent_joint))
        return ((found - true).abs() / self.features.joint_std(x0_hat)[..., None])[batch.valid]

    def _errors(self, x0_hat: Tensor, x0: Tensor, batch: HeadWindow) -> dict[str, Tensor]:
        valid = batch.valid  # padding weighs nothing
        left = valid.sum(1, keepdim=True) - 1 - torch.arange(valid.shape[1], device=valid.device)
        weight = valid * (1 + self.loss.tail * torch.exp(-left.clamp_min(0) / _TAIL_FRAMES))
        pose = slice(self.features.pose_size)
        terms = {"motion": losses.masked_mean((x0_hat - x0)[..., pose].square().mean(-1), weight)}
        if any(self.loss_weights.get(name) for name in ("joints", "velocity", "skate", "contact")):
            motion_hat = self.net.motion_normalizer.inverse(x0_hat)
            R_hat, _ = self.features.decode(motion_hat, batch.R_world_head)
            # As anchoring the body to the true head gives them.
            predicted, true = (batch.joints_from_head(self.skeleton, R) for R in (R_hat, batch.R_parent_joint))
            terms["joints"] = losses.joint_position(predicted, true, weight)
            terms["velocity"] = losses.joint_velocity(predicted, true, weight, self.fps)
            if self.features.spread:
                spread = self.features.joint_std(x0_hat)
                terms["spread"] = losses.surprise(predicted.detach() - true, spread, weight)
            feet = predicted[:, :, self._feet]
            feet = rearrange(feet, "batch time (foot point) xyz -> batch time foot point xyz", foot=FEET)
            feet = feet + batch.t_world_head[:, :, None, None]
            terms["skate"] = losses.foot_skate(feet, batch.foot_contact, weight, self.fps)
            if self.features.contacts:
                logit = CONTACT_LOGIT * motion_hat[..., -FEET:]
                terms["contact"] = losses.balanced_cross_entropy(
                    logit, batch.foot_contact, self.loss.contact_share, weight
                )
        return terms


def feature_statistics(
    dataset: Windows, features: HeadFeatures, sizes: Mapping[str, int], limit: int = 2000
) -> dict[str, tuple[Tensor, Tensor]]:
    """(mean, scale) of "motion", "head" and the other conditions over at most `limit` windows drawn by dataset weights."""
    sums: dict[str, list[Tensor]] = {}
    for batch in drawn_batches(dataset, min(limit, 4 * len(dataset)), 64):
        motion = features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
        head = features.condition(batch.R_world_head, batch.t_world_head, batch.floor_height, batch.size, dataset.fps)
        given = batch.valid[..., None] & batch.given
        others = zip(sizes, batch.others.split([*sizes.values()], -1), given.unbind(-1))
        for name, value, valid in (("motion", motion, batch.valid), ("head", head, batch.valid), *others):
            rows = value[valid].double()
            moments = torch.stack([torch.ones_like(rows).sum(0), rows.sum(0), rows.square().sum(0)])
            sums.setdefault(name, []).append(moments)
    result = {}
    for name, parts in sums.items():
        number, total, squares = torch.stack(parts).sum(0)
        mean = total / number.clamp_min(1)
        scale = (squares / number.clamp_min(1) - mean**2).clamp_min(0).sqrt().clamp_min(MIN_SCALE)
        result[name] = (mean.float(), scale.float())
    return result
