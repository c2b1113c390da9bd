"""AvatarPoser-style estimator on MocapEvery's inputs (Jiang et al. 2022): the pose of a window's last frame alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.rivals.pose_regression.net import PoseRegressor
from wearcap.body.skeleton import FEET
from wearcap.models.layers import Normalizer
from wearcap.systems.mocap_every.model import ENDS_SIZE, Estimate, WatchEstimator


class LastPoseEstimator(WatchEstimator):
    """Baseline after AvatarPoser (Jiang et al. 2022): one encoder predicts the pose of the window's last frame."""

    def __init__(
        self,
        feature_size: int,
        motion_size: int,
        window: int,
        width: int,
        layers: int,
        heads: int,
        feedforward: int,
        dropout: float,
        frames_per_token: int = 1,
    ):
        super().__init__()
        self.window = window
        self.regressor = PoseRegressor(
            feature_size, motion_size + FEET, window, width, layers, heads, feedforward, dropout, frames_per_token
        )
        self.motion_normalizer, self.ends_normalizer = Normalizer(motion_size), Normalizer(ENDS_SIZE)

    @property
    def feature_normalizer(self) -> Normalizer:
        return self.regressor.feature_normalizer

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        """Predict the window's last frame from raw features."""
        valid = torch.ones(features.shape[:2], dtype=torch.bool, device=features.device)
        output = self.regressor(features, valid)[:, None]
        return Estimate(self.motion_normalizer.inverse(output[..., :-FEET]), output[..., -FEET:], None)
