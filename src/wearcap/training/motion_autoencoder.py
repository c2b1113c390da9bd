"""Training of the autoencoder in whose latent space FID and Diversity are taken."""

from collections.abc import Callable

import lightning
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.hang import hang
from wearcap.data.motion_features import MotionFeatures
from wearcap.data.statistics import collate
from wearcap.data.windows import Window, WindowDataset
from wearcap.geometry.rigid import Rigid
from wearcap.models.motion_autoencoder import MotionAutoencoder
from wearcap.training.losses import masked_mean

MIN_SCALE = 0.02
"""No feature is stretched more than this: what hardly varies would otherwise be mostly noise."""


class MotionEncoding(lightning.LightningModule):
    """Windows of true motion are compressed and rebuilt; the loss is the smooth L1 of normalised features."""

    def __init__(
        self,
        net: Callable[..., MotionAutoencoder],
        features: MotionFeatures,
        window: int,
        optimizer: Callable[..., torch.optim.Optimizer],
        scheduler: Callable[..., torch.optim.lr_scheduler.LRScheduler] | None = None,
    ):
        super().__init__()
        self.features, self.window = features, window
        self.net = net(size=features.size, frames=features.frames(window))
        self._optimizer, self._scheduler = optimizer, scheduler

    def set_statistics(self, dataset: WindowDataset, limit: int = 1000) -> None:
        """Take normalisation from a training split; a resumed run brings its own with the weights."""
        random = torch.Generator().manual_seed(0)
        drawn = torch.multinomial(dataset.weights, limit, replacement=True, generator=random).tolist()
        parts = []
        for start in range(0, limit, 50):
            batch = collate([dataset[item] for item in zip(drawn[start : start + 50], range(start, limit))])
            parts.append(self.encode(batch)[batch.valid[:, :: self.features.every]])
        rows = torch.cat(parts)
        self.net.normalizer.set(rows.mean(0), rows.std(0).clamp_min(MIN_SCALE))

    def encode(self, batch: Window) -> Float[Tensor, "window frame feature"]:
        """Features of the true bodies, hung from their heads."""
        head = Rigid(batch.R_world_head, batch.t_world_head)
        offsets = batch.t_parent_joint[:, None]
        R, T_world_joint = hang(self.features.skeleton, batch.R_parent_joint, head, offsets)
        return self.features.encode(T_world_joint.t, R[:, :, 0], batch.floor_height)

    def _loss(self, batch: Window, stage: str) -> Tensor:
        features = self.encode(batch)
        valid = batch.valid[:, :: self.features.every]
        rebuilt = self.net(features)
        error = F.smooth_l1_loss(rebuilt, self.net.normalizer(features), reduction="none")
        loss = masked_mean(error.mean(-1), valid)
        joints = self.features.joints(self.net.normalizer.inverse(rebuilt))
        distance = (joints - self.features.joints(features)).norm(dim=-1).mean(-1)
        self.log_dict(
            {f"{stage}/loss": loss, f"{stage}/joints_cm": 100 * distance[valid].mean()},
            batch_size=len(valid), prog_bar=stage == "train", sync_dist=stage == "val",
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
