"""Training of the autoencoder whose latent space FID and Diversity are computed in."""

from collections.abc import Callable

from torch import Tensor
from torch.nn import functional as F

from wearcap.data.motion_features import MotionFeatures, Movement
from wearcap.data.windows import Windows, drawn_batches, standardize
from wearcap.metrics.position import mpjpe_cm
from wearcap.models.motion_autoencoder import MotionAutoencoder
from wearcap.training.base import Optimization, Training

MIN_SCALE = 0.02
"""Smallest standard deviation that features are divided by: those that hardly vary would become mostly noise."""


class MotionEncoding(Training):
    """Reconstruction of windows of true motion; the loss is the smooth L1 of normalised features."""

    def __init__(
        self, net: Callable[..., MotionAutoencoder], features: MotionFeatures, window: int, optimization: Optimization
    ):
        super().__init__(optimization)
        self.features, self.window = features, window
        self.net = net(size=features.size, frames=window // features.every)

    def set_statistics(self, dataset: Windows, limit: int = 1000) -> None:
        (batch,) = drawn_batches(dataset, limit)
        standardize(self.net.normalizer, self.features.encode(batch), MIN_SCALE)

    def measure(self, batch: Movement) -> dict[str, Tensor]:
        """The loss, and the mean error of reconstructed joints (cm)."""
        features = self.features.encode(batch)
        rebuilt = self.net(features)
        loss = F.smooth_l1_loss(rebuilt, self.net.normalizer(features))
        joints = self.features.joints(self.net.normalizer.inverse(rebuilt))
        error = mpjpe_cm(joints, self.features.joints(features))
        return {"loss": loss, "joints_cm": error}
