"""Training of the conditional motion diffusion model (thesis §6.2, eq. 6.1–6.4)."""

from collections.abc import Callable
from typing import Any

import lightning
import torch
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.data.features import HeadFeatures
from wearcap.data.statistics import feature_statistics
from wearcap.data.windows import Window, WindowDataset
from wearcap.diffusion.process import add_noise
from wearcap.diffusion.schedule import Schedule
from wearcap.models.denoiser import MotionDenoiser
from wearcap.training import losses


class MotionDiffusion(lightning.LightningModule):
    """x0-prediction under one noise level per window; loss terms are weighed by `loss_weights`.

    "motion" is the document's plain MSE; "joints" and "velocity" are ours (0 leaves them out). Levels are drawn with a
    density that grows with the level to the power of `level_tilt`: 0 draws them uniformly, as the document does; more
    (ours) trains what sampling in few steps depends on, the way from noise to a first guess.
    """

    def __init__(
        self,
        net: Callable[..., MotionDenoiser],
        features: HeadFeatures,
        schedule: Schedule,
        skeleton: Skeleton,
        fps: float,
        loss_weights: dict[str, float],
        optimizer: Callable[..., torch.optim.Optimizer],
        scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None,
        level_tilt: float = 0.0,
        seed: int = 0,
        compile: bool = False,
    ):
        super().__init__()
        self.net = net(motion_size=features.motion_size, condition_size=features.condition_size)
        self.features, self.schedule, self.skeleton, self.fps = features, schedule, skeleton, fps
        self.loss_weights, self.level_tilt, self.seed = dict(loss_weights), level_tilt, seed
        self._optimizer, self._scheduler = optimizer, scheduler
        self._denoise = torch.compile(self.net) if compile else self.net

    def set_statistics(self, dataset: WindowDataset) -> None:
        """Take normalisation from a training split; a resumed run brings its own with the weights."""
        statistics = feature_statistics(dataset, self.features)
        self.net.motion_normalizer.set(*statistics["motion"])
        self.net.condition_normalizer.set(*statistics["condition"])

    def on_train_batch_start(self, batch: Window, batch_idx: int) -> None:
        """Dropout, too, is a function of seed and step, so that a resumed run repeats it."""
        torch.manual_seed((self.seed + 1) * 1_000_003 + self.global_step * 64 + self.global_rank)

    def terms(self, batch: Window) -> dict[str, Tensor]:
        """Every loss term of a batch, unweighted."""
        motion = self.features.encode(batch.R_parent_joint, batch.R_world_head)
        x0 = self.net.motion_normalizer(motion)
        condition = self.features.condition(
            batch.R_world_head, batch.t_world_head, batch.floor_height, batch.stature, self.fps
        )
        level = batch.level ** (1 / (1 + self.level_tilt))
        x_t = add_noise(x0, batch.noise, level, self.schedule)
        x0_hat = self._denoise(x_t, level, condition, batch.valid)
        terms = {"motion": losses.motion_mse(x0_hat, x0, batch.valid)}
        if self.loss_weights.get("joints") or self.loss_weights.get("velocity"):
            R_hat = self.features.decode(
                self.net.motion_normalizer.inverse(x0_hat.float()), batch.R_world_head
            )
            predicted, true = self._from_head(R_hat, batch), self._from_head(batch.R_parent_joint, batch)
            terms["joints"] = losses.joint_position(predicted, true, batch.valid)
            terms["velocity"] = losses.joint_velocity(predicted, true, batch.valid, self.fps)
        return terms

    def _from_head(self, R_parent_joint: Tensor, batch: Window) -> Tensor:
        """Joint positions seen from the head joint: where hanging the body from the true head puts them."""
        origin = torch.zeros_like(batch.t_world_head)
        joints = forward_kinematics(self.skeleton, R_parent_joint, origin, batch.t_parent_joint[:, None]).t
        return joints - joints[:, :, self.skeleton.index("head"), None]

    def _loss(self, batch: Window, stage: str) -> Tensor:
        terms = self.terms(batch)
        loss = torch.stack([self.loss_weights.get(name, 0.0) * term for name, term in terms.items()]).sum()
        log: dict[str, Any] = {f"{stage}/loss": loss} | {f"{stage}/{name}": v for name, v in terms.items()}
        self.log_dict(
            log, batch_size=len(batch.valid), prog_bar=stage == "train", sync_dist=stage == "val",
            on_step=stage == "train", on_epoch=stage == "val",
        )  # fmt: skip
        return loss

    def training_step(self, batch: Window, batch_idx: int) -> Tensor:
        return self._loss(batch, "train")

    def validation_step(self, batch: Window, batch_idx: int) -> None:
        self._loss(batch, "val")

    def configure_optimizers(self):
        optimizer = self._optimizer(self.net.parameters())
        if self._scheduler is None:
            return optimizer
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self._scheduler(optimizer), "interval": "step"},
        }
