"""Training of the conditional motion diffusion model (thesis §6.2, eq. 6.1–6.4)."""

from collections.abc import Callable

import torch
from einops import rearrange
from torch import Tensor

from wearcap.body.skeleton import FEET, Skeleton
from wearcap.data.windows import MIN_SCALE, Windows, drawn_batches
from wearcap.diffusion.process import add_noise
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2, DiffusionModel
from wearcap.systems.hmd2.training_windows import HeadContent, HeadWindow
from wearcap.training import losses
from wearcap.training.base import Optimization, Training

CONTACT_LOGIT = 4.0
"""Logit of a contact whose predicted feature is 1; features of contacts are from -1 to 1."""
_TAIL_FRAMES = 20
"""Decay length, in frames, of the extra loss weight of a window's last frames."""


class MotionDiffusion(Training):
    """x0-prediction under one noise level per window; loss terms are weighed by `loss_weights`.

    "motion" is the thesis's plain MSE; "joints", "velocity", "skate" and "contact" (cross entropy in which both classes
    weigh alike, if `contact_share` says what share of the labels is contact) are ours (0 leaves them out). Levels are drawn
    with a density proportional to the level to the power of `level_tilt`: 0 draws them uniformly, as the thesis does;
    more (ours) favours high noise levels, on which sampling in few steps depends; a share `pure` of the windows is pure
    noise (level 1), on which the mean in one step depends (ours). Points and images are each replaced by their null vector
    with probability `drop` per window, so that one checkpoint runs with any subset of them.
    A window's last frames weigh up to 1 + `tail` in the loss (ours): with small strides they are the output.
    """

    system = HMD2

    def __init__(
        self,
        net: Callable[..., MotionDenoiser],
        features: HeadFeatures,
        schedule: Schedule,
        skeleton: Skeleton,
        fps: float,
        loss_weights: dict[str, float],
        optimization: Optimization,
        level_tilt: float = 0.0,
        pure: float = 0.0,
        drop: float = 0.0,
        tail: float = 0.0,
        contact_share: float | None = None,
        place_encoder: VoxelAutoencoder | None = None,
        image_encoder: str | None = None,
        image_size: int = 0,
        compile: bool = False,
    ):
        """`place_encoder` (frozen, thesis §6.2) encodes the points; `image_encoder` names the encoder of the image
        embeddings, `image_size` features each. None leaves that modality out."""
        super().__init__(optimization, loss_weights)
        if not 0 <= pure < 1:
            raise WearcapError(f"a share pure={pure} of the windows", expected="from 0 to less than 1")
        self.net = net(
            motion_size=features.motion_size,
            condition_size=features.condition_size,
            points_size=place_encoder.size if place_encoder else 0,
            image_size=image_size if image_encoder else 0,
        )
        self.place_encoder = None if place_encoder is None else place_encoder.requires_grad_(False).eval()
        self.image_encoder, self.drop, self.tail = image_encoder, drop, tail
        self.features, self.schedule, self.skeleton, self.fps = features, schedule, skeleton, fps
        self.level_tilt, self.pure, self.contact_share = level_tilt, pure, contact_share
        self._feet = [skeleton.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("ankle", "toe")]
        # Methods, since compiled modules would put every weight into checkpoints a second time.
        self._denoise = torch.compile(self.net.forward) if compile else self.net.forward
        self._encode = torch.compile(self.net.encode) if compile else self.net.encode

    def pipeline_parts(self) -> dict[str, DiffusionModel]:
        parts = self.features, self.schedule, self.skeleton, self.fps, self.place_encoder, self.image_encoder
        return {"model": DiffusionModel(self.net, *parts)}

    def set_statistics(self, dataset: Windows) -> None:
        """Set normalisation from a training split. Raises WearcapError unless its windows have the model's inputs."""
        content = dataset.content
        assert isinstance(content, HeadContent)
        net, places, images = self.net, content.surroundings.places, content.surroundings.images
        points_size = 0 if places is None else places.size
        if (net.points_size, net.image_size) != (points_size, content.image_size):
            what = f"windows with points of {points_size} and images of {content.image_size} features"
            fix = "Set data.dataset.content.surroundings and model.{place_encoder,image_encoder,image_size} alike."
            raise WearcapError(what, expected=f"{net.points_size} and {net.image_size}, as the model has", fix=fix)
        if self.image_encoder != images and net.image_size:
            raise WearcapError(f"embeddings of {images!r}", expected=self.image_encoder)
        statistics = feature_statistics(dataset, self.features)
        net.motion_normalizer.set(*statistics["motion"])
        encoder = net.condition_encoder
        encoder.normalizer.set(*statistics["head"])
        for name, optional in (("points", encoder.points), ("image", encoder.image)):
            if optional is not None:
                optional.normalizer.set(*statistics[name])
        if self.place_encoder is not None and places is not None:
            self.place_encoder.load_state_dict(places.encoder.state_dict())

    def conditions(self, batch: HeadWindow) -> Conditions:
        """Conditioning of a batch, with modalities dropped by the windows' random numbers."""
        kept = batch.chance[:, None] >= self.drop
        points_valid, image_valid = batch.points_valid & kept[..., 0], batch.image_valid & kept[..., 1]
        # The floor height comes from the points, so it is dropped with them.
        floor = torch.where(points_valid, batch.floor_height, batch.floor_from_head)
        head = self.features.condition(batch.R_world_head, batch.t_world_head, floor, batch.size, self.fps)
        return Conditions(head, batch.points, points_valid, batch.image, image_valid)

    def _predicted(self, batch: HeadWindow, x0: Tensor) -> Tensor:
        """x̂0 of a batch in normalised motion space; half the windows are self-conditioned on a first estimate."""
        encoded = self._encode(self.conditions(batch), batch.valid)
        level = (batch.level / (1 - self.pure)).clamp_max(1) ** (1 / (1 + self.level_tilt))
        x_t = add_noise(x0, batch.noise[..., : x0.shape[-1]], level, self.schedule)
        if not self.net.self_conditioning:
            return self._denoise(x_t, level, encoded, batch.valid)
        with torch.no_grad():
            guess = self._denoise(x_t, level, encoded, batch.valid)
        last = guess * (batch.chance[:, 2] < 0.5)[:, None, None]
        return self._denoise(x_t, level, encoded, batch.valid, last)

    def terms(self, batch: HeadWindow) -> dict[str, Tensor]:
        valid = batch.valid  # padding weighs nothing
        left = valid.sum(1, keepdim=True) - 1 - torch.arange(valid.shape[1], device=valid.device)
        weight = valid * (1 + self.tail * torch.exp(-left.clamp_min(0) / _TAIL_FRAMES))
        motion = self.features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
        x0 = self.net.motion_normalizer(motion)
        x0_hat = self._predicted(batch, x0)
        terms = {"motion": losses.motion_mse(x0_hat, x0, weight)}
        if any(self.loss_weights.get(name) for name in ("joints", "velocity", "skate", "contact")):
            motion_hat = self.net.motion_normalizer.inverse(x0_hat.float())
            R_hat, _ = self.features.decode(motion_hat, batch.R_world_head)
            # As anchoring the body to the true head gives them.
            predicted, true = (batch.joints_from_head(self.skeleton, R) for R in (R_hat, batch.R_parent_joint))
            terms["joints"] = losses.joint_position(predicted, true, weight)
            terms["velocity"] = losses.joint_velocity(predicted, true, weight, self.fps)
            feet = predicted[:, :, self._feet]
            feet = rearrange(feet, "batch time (foot point) axis -> batch time foot point axis", foot=FEET)
            feet = feet + batch.t_world_head[:, :, None, None]
            terms["skate"] = losses.foot_skate(feet, batch.foot_contact, weight, self.fps)
            if self.features.contacts:
                logit = CONTACT_LOGIT * motion_hat[..., -FEET:]
                terms["contact"] = losses.balanced_cross_entropy(logit, batch.foot_contact, self.contact_share, weight)
        return terms


def feature_statistics(dataset: Windows, features: HeadFeatures) -> dict[str, tuple[Tensor, Tensor]]:
    """(mean, scale) of "motion", "head", "points" and "image" over at most 2000 windows drawn by dataset weights."""
    sums: dict[str, list[Tensor]] = {}
    for batch in drawn_batches(dataset, min(2000, 4 * len(dataset)), 64):
        motion = features.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
        head = features.condition(batch.R_world_head, batch.t_world_head, batch.floor_height, batch.size, dataset.fps)
        for name, value, valid in (
            ("motion", motion, batch.valid),
            ("head", head, batch.valid),
            ("points", batch.points, batch.valid & batch.points_valid),
            ("image", batch.image, batch.valid & batch.image_valid),
        ):
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
