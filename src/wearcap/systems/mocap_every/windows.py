"""Sliding-window inference of MocapEvery's estimator: sensor frames in, poses and floor height out.

Whole recordings and streams share this code and differ only in `stride` and `lookahead`. Predictions of overlapping
windows for the same frame are averaged, with weights that decrease towards the windows' ends.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FOOT_JOINTS, MIRROR, Skeleton
from wearcap.data.features import body_size
from wearcap.data.transforms import mirrored_rotations
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.floor import FloorFollower
from wearcap.systems.mocap_every.features import Sensed

if TYPE_CHECKING:
    from wearcap.systems.mocap_every.pipeline import MocapEvery


class FinalPoses(NamedTuple):
    """Poses of frames that later windows no longer change."""

    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    contact_prob: Float[Tensor, "time foot"]
    floor_height: Float[Tensor, "time"]
    """Floor height (m) that conditioned the estimator."""


class EstimatorWindows:
    """Sliding windows over one uninterrupted stretch of a recording.

    The floor height of new frames is predicted by the floor follower from all earlier windows; the feet of the new
    frames take effect from the next window on. The floor state thus carries over between windows, and the per-frame
    decisions of D.2 are delayed by up to `stride` frames.
    """

    def __init__(self, pipeline: "MocapEvery", skeleton: Skeleton, floor: FloorFollower):
        self._pipeline, self._skeleton, self.floor = pipeline, skeleton, floor
        self._size = body_size(skeleton)[None]
        self._feet = skeleton.indices(*FOOT_JOINTS)
        window = pipeline.model.net.window
        position = torch.arange(1, window + 1, dtype=torch.float32)
        self._weight = torch.minimum(position, window + 1 - position).square()[:, None]
        self._sensed: Sensed | None = None
        self._floors = torch.zeros(0)
        self._sum = torch.zeros(window, 0)
        """Weighted sums of the predictions for the window's frames (root, rotations, contact), and sums of weights."""
        self._returned, self._consumed = 0, 0
        """Numbers of frames that were returned as final, and that were taken in."""

    def advance(self, new: Sensed) -> FinalPoses:
        """Take in up to `stride` new frames and return the frames that are now final."""
        window, count = self._pipeline.model.net.window, len(new.t_world_head)
        if self._sensed is None:
            # The window before the capture is padded with its first frame.
            self._sensed = Sensed(*(part[:1].expand(window, *part.shape[1:]) for part in new))
            self._floors = self.floor.ahead(new.t_world_head[:1]).expand(window)
            self._sum = torch.zeros(window, 3 + 6 * len(self._skeleton) + 3)
        self._sensed = Sensed(*(torch.cat([a[count:], b]) for a, b in zip(self._sensed, new)))
        self._floors = torch.cat([self._floors[count:], self.floor.ahead(new.t_world_head)])
        self._sum = torch.cat([self._sum[count:], self._sum.new_zeros(count, self._sum.shape[1])])
        self._consumed += count
        pipeline, features = self._pipeline, self._pipeline.model.features
        sensed, floor, size = Sensed(*(part[None] for part in self._sensed)), self._floors[None], self._size
        if pipeline.mirror_average:  # the mirrored window's prediction is mirrored back: no left-right bias
            sensed = Sensed(*(torch.cat(both) for both in zip(sensed, sensed.mirrored())))
            floor, size = floor.expand(2, -1), size.expand(2, -1)
        canonical = features.canonical(sensed, floor)
        estimated = pipeline.estimate(features.encode(sensed, floor, size, canonical))
        R, t = features.decode_motion(estimated.motion.float(), sensed, canonical)
        contact = estimated.contact_logit.float().sigmoid()
        if pipeline.mirror_average:
            R = torch.stack([R[0], mirrored_rotations(R[1], self._skeleton)])
            t = torch.stack([t[0], t[1] * t.new_tensor(MIRROR)])
            contact = torch.stack([contact[0], contact[1].flip(-1)])
        # Root, 6D rotations and contact of the window's last frames, in the world
        output = torch.cat([t, rotation.rot6d_from_matrix(R).flatten(-2), contact], -1).mean(0)
        last = len(output)
        self._sum[-last:] += self._weight[-last:] * torch.cat([output, torch.ones(last, 1)], -1)
        R, t, contact = _parts(output[-count:])
        self.floor.follow(contact, forward_kinematics(self._skeleton, R, t).t[:, self._feet])
        return self.finish(self._pipeline.lookahead)

    def correct(self, T_world_head: Rigid) -> None:
        """Replace the latest head poses, which repeated an earlier pose while tracking was lost."""
        assert self._sensed is not None
        count = len(T_world_head.t)
        R, t = self._sensed.R_world_head[:-count], self._sensed.t_world_head[:-count]
        self._sensed = self._sensed._replace(
            R_world_head=torch.cat([R, T_world_head.R]), t_world_head=torch.cat([t, T_world_head.t])
        )

    @property
    def floor_m(self) -> float:
        """Height of the floor (m) at the latest frame."""
        return self._floors[-1].item()

    def finish(self, lookahead: int = 0) -> FinalPoses:
        """Frames that were not returned yet, except for the last `lookahead` ones."""
        window, count = len(self._sum), self._consumed - lookahead - self._returned
        stop = window - lookahead
        rows = self._sum[stop - max(count, 0) : stop]
        self._returned += max(count, 0)
        return FinalPoses(*_parts(rows[:, :-1] / rows[:, -1:]), self._floors[stop - len(rows) : stop])


def _parts(
    output: Float[Tensor, "time value"],
) -> tuple[Float[Tensor, "time joint 3 3"], Float[Tensor, "time 3"], Float[Tensor, "time foot"]]:
    """Split a prediction into rotations, root and contact."""
    return rotation.matrix_from_rot6d(output[:, 3:-2].unflatten(-1, (-1, 6))), output[:, :3], output[:, -2:]
