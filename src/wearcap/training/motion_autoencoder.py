"""Training of the autoencoder whose latent space FID and Diversity are computed in."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from wearcap.data.motion_features import MotionFeatures, Movement
from wearcap.data.motion_windows import MovementDataset
from wearcap.data.statistics import collate
from wearcap.metrics.position import mpjpe_cm
from wearcap.models.motion_autoencoder import MotionAutoencoder
from wearcap.training.base import Measured

MIN_SCALE = 0.02
"""Smallest standard deviation that features are divided by: those that hardly vary would become mostly noise."""


class MotionEncoding(Measured):
    """Reconstruction of windows of true motion; the loss is the smooth L1 of normalised features."""

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
        self.net = net(size=features.size, frames=window // features.every)
        self._optimizer, self._scheduler = optimizer, scheduler

    def set_statistics(self, dataset: MovementDataset, limit: int = 1000) -> None:
        """Compute normalisation from a training split; a resumed run loads it with the weights."""
        random = torch.Generator().manual_seed(0)
        drawn = torch.multinomial(dataset.weights, limit, replacement=True, generator=random).tolist()
        features = self.features.encode(collate([dataset[item] for item in zip(drawn, range(limit))]))
        mean, scale = features.mean((0, 1)), features.std((0, 1)).clamp_min(MIN_SCALE)
        self.net.normalizer.set(mean, scale)

    def measure(self, batch: Movement) -> dict[str, Tensor]:
        """The loss, and the mean error of reconstructed joints (cm)."""
        features = self.features.encode(batch)
        rebuilt = self.net(features)
        loss = F.smooth_l1_loss(rebuilt, self.net.normalizer(features))
        joints = self.features.joints(self.net.normalizer.inverse(rebuilt))
        error = mpjpe_cm(joints, self.features.joints(features))
        return {"loss": loss, "joints_cm": error}
