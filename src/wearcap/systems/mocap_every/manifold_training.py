"""Training of MocapEvery's motion manifold: the reconstruction losses of eq. 9."""

from collections.abc import Callable

from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FEET, Skeleton
from wearcap.data.windows import Windows, drawn_batches, standardize
from wearcap.metrics.position import mpjpe_cm
from wearcap.systems.mocap_every.manifold import MotionManifold, Posed
from wearcap.systems.mocap_every.training_windows import WatchWindow
from wearcap.training.base import Optimization, Training


class ManifoldTraining(Training):
    """Trains the autoencoder to reconstruct windows of ground-truth motion.

    L1 loss terms (eq. 9), weighted by `loss_weights`: "contact", "root" (translation and rotation), "rotation" of the
    joints, "position" (m); "velocity" (m/s) is ours.
    """

    def __init__(
        self,
        net: Callable[..., MotionManifold],
        skeleton: Skeleton,
        fps: float,
        loss_weights: dict[str, float],
        optimization: Optimization,
    ):
        super().__init__(optimization, loss_weights)
        self.net = net(size=FEET + 3 + 6 * len(skeleton))
        self.skeleton, self.fps = skeleton, fps

    def set_statistics(self, dataset: Windows, limit: int = 1000) -> None:
        (batch,) = drawn_batches(dataset, limit)
        window = Posed(batch.R_parent_joint, batch.t_world_root, batch.foot_contact)
        standardize(self.net.normalizer, window.encode(window.origin()))

    def terms(self, batch: WatchWindow) -> dict[str, Tensor]:
        """Unweighted loss terms of a batch, and the mean joint error (cm)."""
        window = Posed(batch.R_parent_joint, batch.t_world_root, batch.foot_contact)
        origin = window.origin()
        X = window.encode(origin)
        reconstructed = self.net(X)
        error = (reconstructed - X).abs()
        joints, joints_true = (self._joints(Posed.decode(x, origin), batch) for x in (reconstructed, X))
        error_m = joints - joints_true
        return {
            "contact": error[..., :FEET].mean(),
            "root": error[..., FEET : FEET + 9].mean(),
            "rotation": error[..., FEET + 9 :].mean(),
            "position": error_m.abs().mean(),
            "velocity": (error_m.diff(dim=1) * self.fps).abs().mean(),
            "joints_cm": mpjpe_cm(joints.detach(), joints_true),
        }

    def _joints(self, window: Posed, batch: WatchWindow) -> Tensor:
        offsets = batch.t_parent_joint[:, None]
        return forward_kinematics(self.skeleton, window.R_parent_joint, window.t_world_root, offsets).t
