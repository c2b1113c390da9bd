"""Training of MocapEvery's estimator with the losses of §3.3 (eq. 2–4)."""

from collections.abc import Callable

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.data.features import deviations
from wearcap.data.windows import Windows, drawn_batches, standardize
from wearcap.geometry.rigid import Rigid
from wearcap.systems.mocap_every.features import ENDS, WatchFeatures
from wearcap.systems.mocap_every.model import Estimate, TrainedEstimator
from wearcap.systems.mocap_every.pipeline import MocapEvery, WatchModel
from wearcap.systems.mocap_every.training_windows import WatchWindow
from wearcap.training import losses
from wearcap.training.base import Optimization, Training


class WatchRegression(Training):
    """Regression of body motion from the head and two wrists.

    Loss terms, weighted by `loss_weights`, are means over frames and joints: "root" and "rotation" (eq. 2), "position"
    with `joint_weights` for hands and feet (eq. 3), "mid" and "consistency" of the first stage (eq. 4), "contact"
    (cross entropy), "foot_velocity"; "velocity" of all joints, "skate" of feet in contact and "spread" of the joints'
    deviations, whose errors teach nothing else, are ours.
    """

    _joint_weights: Tensor
    _ends: Tensor
    _feet: Tensor

    system = MocapEvery

    def __init__(
        self,
        net: Callable[..., TrainedEstimator],
        features: WatchFeatures,
        skeleton: Skeleton,
        fps: float,
        loss_weights: dict[str, float],
        optimization: Optimization,
        end_weight: float = 1.0,
        contact_share: float | None = None,
    ):
        """`end_weight`: weight of hands and feet relative to the other joints in "position". `contact_share`: share of
        the labels with contact, by which both classes weigh alike in "contact"; None: plain cross entropy."""
        super().__init__(optimization, loss_weights, spread=features.spread)
        self.net = net(feature_size=features.size, motion_size=features.motion_size)
        self.features, self.skeleton, self.fps = features, skeleton, fps
        self.contact_share = contact_share
        feet = skeleton.indices("left_ankle", "left_toe", "right_ankle", "right_toe")
        self.register_buffer("_ends", torch.tensor(skeleton.indices(*ENDS)), persistent=False)
        self.register_buffer("_feet", torch.tensor(feet), persistent=False)
        weights = torch.ones(len(skeleton))
        weights[self._ends] = end_weight
        self.register_buffer("_joint_weights", weights / weights.mean(), persistent=False)

    def pipeline_parts(self) -> dict[str, WatchModel]:
        return {"model": WatchModel(self.net, self.features, self.skeleton, self.fps, self.fitted_dof)}

    def set_statistics(self, dataset: Windows, limit: int = 1500) -> None:
        (batch,) = drawn_batches(dataset, limit)
        features, motion, canonical = self._inputs(batch)
        ends = self.ends_from_world(self._joints(motion, batch, canonical)[:, :, self._ends], batch, canonical)
        standardize(self.net.feature_normalizer, features)
        standardize(self.net.motion_normalizer, motion)
        self.net.motion_normalizer.scale[self.features.pose_size :] = 1.0
        standardize(self.net.ends_normalizer, rearrange(ends, "batch time end xyz -> batch time (end xyz)"))

    def _inputs(
        self, batch: WatchWindow
    ) -> tuple[Float[Tensor, "batch time feature"], Float[Tensor, "batch time motion"], Rigid]:
        """Input features, ground-truth motion features, and the windows' canonical frames."""
        canonical = self.features.canonical(batch.sensed, batch.floor_height)
        features = self.features.encode(batch.sensed, batch.floor_height, batch.size, canonical)
        true = self.features.encode_motion(batch.R_parent_joint, batch.t_world_root, batch.sensed, canonical)
        return features, true, canonical

    def _joints(
        self, motion: Float[Tensor, "batch predicted motion"], batch: WatchWindow, canonical: Rigid
    ) -> Float[Tensor, "batch predicted joint 3"]:
        """Joint positions (m) in the world, from motion features."""
        R, t = self.features.decode_motion(motion, batch.sensed, canonical)
        return forward_kinematics(self.skeleton, R, t, batch.t_parent_joint[:, None]).t

    def ends_from_world(
        self, ends: Float[Tensor, "batch time end 3"], batch: WatchWindow, canonical: Rigid
    ) -> Float[Tensor, "batch time end 3"]:
        """End-effectors (m, world) as the first stage predicts them: in the canonical frame, from its origin."""
        origin = self.features.origin(batch.sensed, canonical)
        return (canonical.R.mT[:, :, None] @ (ends - canonical.t[:, :, None])[..., None])[..., 0] - origin[:, :, None]

    def terms(self, batch: WatchWindow) -> dict[str, Tensor]:
        with losses.exact(batch.t_world_root):
            features, true, canonical = self._inputs(batch)
        output = self.net(features)
        with losses.exact(batch.t_world_root):
            return self._errors(output, true, canonical, batch)

    @property
    def _fitted(self) -> Tensor:
        """What `FitSpread` added to the deviations' logarithms."""
        return self.net.motion_normalizer.mean[self.features.pose_size :]

    def _from_head(
        self, joints: Float[Tensor, "batch time joint 3"], true: Float[Tensor, "batch time joint 3"]
    ) -> Float[Tensor, "batch time joint 3"]:
        """Errors (m) of joints relative to the head, where captures are anchored."""
        head, error = self.skeleton.index("head"), joints - true
        return error - error[:, :, head, None]

    def away(self, batch: WatchWindow) -> Tensor | None:
        if not self.features.spread:
            return None
        features, true, canonical = self._inputs(batch)
        motion = self.net(features).motion.float()
        std = deviations(motion[..., self.features.pose_size :] - self._fitted)
        joints, joints_true = (self._joints(each, batch, canonical) for each in (motion, true[:, -motion.shape[1] :]))
        return (self._from_head(joints, joints_true).abs() / std[..., None]).flatten(0, 1)

    def _errors(self, output: Estimate, true: Tensor, canonical: Rigid, batch: WatchWindow) -> dict[str, Tensor]:
        last = output.motion.shape[1]
        motion, true, contact = output.motion.float(), true[:, -last:], batch.foot_contact[:, -last:]
        every = torch.ones_like(contact[..., 0])
        joints, joints_true = (self._joints(each, batch, canonical) for each in (motion, true))
        pose = slice(self.features.pose_size)
        error = motion[..., pose] - true[..., pose]
        rotation_error = _norm(rearrange(error[..., 3:], "batch time (joint entry) -> batch time joint entry", entry=6))
        distance = _norm(joints - joints_true)
        terms = {
            "root": (_norm(error[..., :3]) + rotation_error[..., 0]).mean(),
            "rotation": rotation_error[..., 1:].mean(),
            "position": (distance * self._joint_weights).mean(),
            "contact": losses.balanced_cross_entropy(output.contact_logit.float(), contact, self.contact_share, every),
        }
        if self.features.spread:
            std = deviations(motion[..., self.features.pose_size :] - self._fitted)
            terms["spread"] = losses.surprise(self._from_head(joints, joints_true).detach(), std, every)
        if last > 1:
            feet = joints[:, :, self._feet].unflatten(2, (2, 2))
            terms["skate"] = losses.foot_skate(feet, contact, every, self.fps)
            velocity = _norm((joints - joints_true).diff(dim=1) * self.fps)
            terms |= {"foot_velocity": velocity[:, :, self._ends[2:]].mean(), "velocity": velocity.mean()}
        if output.ends is not None:
            # Predicted end-effectors (m), transformed to the world.
            ends = rearrange(output.ends.float(), "batch time (end xyz) -> batch time end xyz", xyz=3)
            ends = ends + self.features.origin(batch.sensed, canonical)[:, :, None]
            ends = canonical.t[:, :, None] + (canonical.R[:, :, None] @ ends[..., None])[..., 0]
            terms["mid"] = _norm(ends - joints_true[:, :, self._ends]).mean()
            terms["consistency"] = _norm(joints[:, :, self._ends] - ends).mean()
        return terms


def _norm(value: Float[Tensor, "*batch axis"]) -> Float[Tensor, "*batch"]:
    """Norm over the last axis, smoothed at zero."""
    return (value.square().sum(-1) + losses.EPSILON_M2).sqrt()
