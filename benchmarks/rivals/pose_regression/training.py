"""Training of the pose regressor: AvatarPoser's losses (Jiang et al. 2022) on HMD²'s training windows."""

from collections.abc import Callable

import torch
from einops import rearrange
from jaxtyping import Float, Int64
from torch import Tensor

from benchmarks.rivals.pose_regression.features import TrackedPoints, pasts
from benchmarks.rivals.pose_regression.net import PoseRegressor
from benchmarks.rivals.pose_regression.pipeline import PoseRegressorCapture
from wearcap.body.skeleton import Skeleton
from wearcap.data.windows import Windows, drawn_batches, standardize
from wearcap.geometry.rigid import Rigid
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.training_windows import HeadWindow
from wearcap.training.base import Optimization, Training
from wearcap.training.losses import joint_velocity, masked_mean


class PoseRegression(Training):
    """Regression of single frames from past frames; `pairs` of neighbouring frames are predicted per window.

    Loss terms, weighted by `loss_weights`, are mean absolute errors: "root" and "rotation" of 6D rotations, "joints" of
    positions with both bodies anchored to the same head (m). "velocity" is that of our HMD²: without it (as in
    AvatarPoser) predictions follow every tremor of the head, with ten times the jitter of real motion.
    """

    system = PoseRegressorCapture
    parts = ("net", "points", "skeleton", "fps")

    def __init__(
        self,
        net: Callable[..., PoseRegressor],
        points: TrackedPoints,
        skeleton: Skeleton,
        fps: float,
        loss_weights: dict[str, float],
        optimization: Optimization,
        pairs: int = 4,
    ):
        super().__init__(optimization, loss_weights)
        self.net = net(feature_size=points.size, motion_size=6 * len(skeleton))
        self.points, self.skeleton, self.fps, self.pairs = points, skeleton, fps, pairs
        self.poses = HeadFeatures(joints=len(skeleton))

    def set_statistics(self, dataset: Windows, limit: int = 500) -> None:
        features, motion = [], []
        for batch in drawn_batches(dataset, limit, 64):
            features.append(self._features(batch)[batch.valid])
            poses = self.poses.encode(batch.R_parent_joint, batch.R_world_head, batch.foot_contact)
            motion.append(poses[batch.valid])
        standardize(self.net.feature_normalizer, torch.cat(features))
        standardize(self.net.motion_normalizer, torch.cat(motion))

    def _features(self, batch: HeadWindow) -> Float[Tensor, "batch time feature"]:
        T_world_head = Rigid(batch.R_world_head, batch.t_world_head)
        poses = self.points.poses(self.skeleton, T_world_head, batch.R_parent_joint, batch.t_parent_joint[:, None])
        return self.points.encode(poses.R, poses.t, batch.floor_from_head, batch.size[:, 0], self.fps)

    def frame_pairs(self, batch: HeadWindow) -> Int64[Tensor, "batch end"]:
        """Indices of pairs of neighbouring frames, spread evenly over each window, in training with a random shift."""
        count, time = batch.valid.shape
        places = torch.arange(self.pairs, device=batch.valid.device)
        shift = torch.rand(count, self.pairs) if self.training else torch.full((count, 1), 0.5)
        last = ((places + shift.to(places.device)) * time / self.pairs).long().clamp(1, time - 1)
        return torch.stack([last - 1, last], -1).flatten(1).expand(count, -1)

    def terms(self, batch: HeadWindow) -> dict[str, Tensor]:
        ends = self.frame_pairs(batch)
        rows = torch.arange(len(ends), device=ends.device)[:, None]
        features, exists = pasts(self._features(batch), ends, self.net.window)
        motion = self.net(features.flatten(0, 1), exists.flatten(0, 1)).unflatten(0, ends.shape).float()
        R_true, R_head = batch.R_parent_joint[rows, ends], batch.R_world_head[rows, ends]
        valid = batch.valid[rows, ends].float()
        error = (motion - self.poses.encode(R_true, R_head, batch.foot_contact[rows, ends])).abs()
        poses = self.poses.decode(motion, R_head)[0], R_true
        predicted, true = (batch.joints_from_head(self.skeleton, R) for R in poses)
        in_pairs = (
            rearrange(x, "batch (pair two) ... -> (batch pair) two ...", two=2) for x in (predicted, true, valid)
        )
        return {
            "root": masked_mean(error[..., :6].mean(-1), valid),
            "rotation": masked_mean(error[..., 6:].mean(-1), valid),
            "joints": masked_mean((predicted - true).abs().mean((-1, -2)), valid),
            "velocity": joint_velocity(*in_pairs, self.fps),
        }
