"""Sliding-window inference of MocapEvery's estimator: sensor frames in, poses and floor height out.

Predictions of overlapping windows for the same frame are averaged, with weights that decrease towards the windows' ends.
"""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import FEET, FOOT_JOINTS, MIRROR, Skeleton
from wearcap.data.features import body_size, deviations
from wearcap.data.transforms import joint_twins, mirrored_rotations
from wearcap.geometry import rotation
from wearcap.runtime.windows import StretchWindows, moved_on
from wearcap.scene.floor import FloorFixed, FloorFollower
from wearcap.systems.mocap_every.features import Sensed


class Frames(NamedTuple):
    """Frames of a window, as a batch of one."""

    timestamps: Float64[Tensor, "1 time"]
    R_world_head: Float[Tensor, "1 time 3 3"]
    t_world_head: Float[Tensor, "1 time 3"]
    R_world_wrist: Float[Tensor, "1 time wrist 3 3"]
    acc_world_wrist: Float[Tensor, "1 time wrist 3"]
    t_world_wrist: Float[Tensor, "1 time wrist 3"]
    floor_height: Float[Tensor, "1 time"]
    """World z (m), as the estimator is conditioned on it."""


class EstimatorWindows(StretchWindows[Frames]):
    """Sliding windows over one uninterrupted stretch of a recording.

    The floor height of new frames is predicted by the floor follower from all earlier windows; the feet of the new
    frames take effect from the next window on. The floor state thus carries over between windows, and the per-frame
    decisions of D.2 are delayed by up to `stride` frames.
    """

    def __init__(self, pipeline: Any, skeleton: Skeleton, floor: FloorFollower):
        """`pipeline`: a `MocapEvery`."""
        length = pipeline.model.net.window
        super().__init__(length)
        self._pipeline, self._skeleton, self._floor = pipeline, skeleton, floor
        self._size = body_size(skeleton)[None]
        self._feet = skeleton.indices(*FOOT_JOINTS)
        position = torch.arange(1, length + 1, dtype=torch.float32)
        self._weight = torch.minimum(position, length + 1 - position).square()[:, None]
        joints, spread = len(skeleton), pipeline.model.features.spread
        self._sum = torch.zeros(1, length, 3 + 6 * joints + FEET + (joints if spread else 0) + 1)
        """Weighted sums of the predictions for the window's frames (`_parts`), and sums of weights."""
        self.points: list[tuple[Tensor, Tensor]] = []
        """Points (m) that the floor follower does not have yet, and the times (s) they were first seen."""

    def see(self, points_world: Float[Tensor, "point 3"], first_seen: Float64[Tensor, "point"] | None) -> None:
        """Take in points of the surroundings (m) and the times (s) they were first seen; None: always."""
        always = torch.full((len(points_world),), -math.inf, dtype=torch.float64)
        self.points.append((points_world, always if first_seen is None else first_seen))

    @torch.inference_mode()
    def push(
        self, timestamps: Float64[Tensor, "time"], sensed: Sensed, floor_height: Float[Tensor, "time"] | None = None
    ) -> None:
        """Take in any number of frames; `floor_height` (m): where it is not followed but known."""
        for first in range(0, len(timestamps), self._pipeline.overlap.stride):
            part = slice(first, first + self._pipeline.overlap.stride)
            if floor_height is not None:
                self._floor = FloorFixed(floor_height[first].item())
            self._advance(timestamps[part], Sensed(*(field[part] for field in sensed)))

    def _advance(self, timestamps: Float64[Tensor, "time"], sensed: Sensed) -> None:
        """Estimate the window that ends with up to `stride` new frames."""
        parts, self.points, until_s = self.points, [], timestamps[-1].item()
        for points, first_seen in parts:
            if (fresh := first_seen <= until_s).any():
                self._floor.see(points[fresh])
            if not fresh.all():
                self.points.append((points[~fresh], first_seen[~fresh]))
        new, length = (timestamps, *sensed), self.length
        if self.frames is None:  # the window before the capture is padded with its first frame
            padding = *(field[:1] for field in new), self._floor.ahead(sensed.t_world_head[:1])
            self.append(Frames(*(field.expand(1, length, *field.shape[1:]) for field in padding)))
            self.finalize(0)
        self.append(Frames(*(field[None] for field in (*new, self._floor.ahead(sensed.t_world_head)))))
        output, count = self._estimated(), len(timestamps)
        last = len(output)
        self._sum = moved_on(self._sum, count, length)
        self._sum[0, -last:] += self._weight[-last:] * torch.cat([output, torch.ones(last, 1)], -1)
        R, t, contact, _ = _parts(output[-count:], len(self._skeleton))
        self._floor.follow(contact, forward_kinematics(self._skeleton, R, t).t[:, self._feet])
        self.emit(self._pipeline.overlap.lookahead)

    def _estimated(self) -> Float[Tensor, "last value"]:
        """Root, 6D rotations, contact and deviations of the window's last frames, in the world."""
        frames, mirrors = self.frames, self._pipeline.overlap.mirror_average
        assert frames is not None
        features, floor, size, sensed = (
            self._pipeline.model.features,
            frames.floor_height,
            self._size,
            Sensed(*frames[1:-1]),
        )
        if mirrors:  # the mirrored window's prediction is mirrored back: no left-right bias
            sensed = Sensed(*(torch.cat(both) for both in zip(sensed, sensed.mirrored())))
            floor, size = floor.expand(2, -1), size.expand(2, -1)
        canonical = features.canonical(sensed, floor)
        estimated = self._pipeline.estimate(features.encode(sensed, floor, size, canonical))
        R, t = features.decode_motion(estimated.motion.float(), sensed, canonical)
        contact = estimated.contact_logit.float().sigmoid()
        std = deviations(estimated.motion[..., features.pose_size :].float())
        if mirrors:
            R = torch.stack([R[0], mirrored_rotations(R[1], self._skeleton)])
            t = torch.stack([t[0], t[1] * t.new_tensor(MIRROR)])
            contact = torch.stack([contact[0], contact[1].flip(-1)])
            if features.spread:
                std = torch.stack([std[0], std[1][:, joint_twins(self._skeleton)]])
        return torch.cat([t, rotation.rot6d_from_matrix(R).flatten(-2), contact, std], -1).mean(0)

    @property
    def floor_m(self) -> float:
        """Height of the floor (m) at the latest frame."""
        assert self.frames is not None
        return self.frames.floor_height[0, -1].item()

    def _poses(self, part: slice) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rows = self._sum[0, part]
        return _parts(rows[:, :-1] / rows[:, -1:], len(self._skeleton))


def _parts(
    output: Float[Tensor, "time value"], joints: int
) -> tuple[
    Float[Tensor, "time joint 3 3"],
    Float[Tensor, "time 3"],
    Float[Tensor, "time foot"],
    Float[Tensor, "time deviation"],
]:
    """Rotations, root, contact and deviations, if there are any, of a prediction."""
    root, turned, contact, std = output.split([3, 6 * joints, FEET, output.shape[1] - 3 - 6 * joints - FEET], -1)
    return rotation.matrix_from_rot6d(turned.unflatten(-1, (-1, 6))), root, contact, std
