"""MocapEvery's windows: frames of what is worn go in, frames of motion come out, the floor is followed in between.

The same for whole recordings and for streams; they differ in `stride` and `lookahead` alone. What overlapping windows
say of a frame is averaged with weights that fade towards the windows' ends.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.features import body_size
from wearcap.data.windows import mirrored_rotations
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.scene.floor_update import FloorFollower
from wearcap.systems.mocap_every.features import Sensed, mirrored, to_world

if TYPE_CHECKING:
    from wearcap.systems.mocap_every.pipeline import MocapEvery

FEET = ("left_toe", "right_toe")
"""Joints whose contact is said, and that the floor is followed by."""


class FinalPoses(NamedTuple):
    """Frames that are final."""

    R_parent_joint: Float[Tensor, "time joint 3 3"]
    t_world_root: Float[Tensor, "time 3"]
    contact_prob: Float[Tensor, "time foot"]
    floor_height: Float[Tensor, "time"]
    """As it was told to the estimator (m)."""


class EstimatorWindows:
    """Windows over one stretch of one recording.

    The floor of new frames is what the follower expects when they come in, with all frames of earlier windows seen: what
    their own feet say counts from the next window on. So the floor's state is carried from window to window, and what
    D.2 decides by frame comes up to `stride` frames later.
    """

    def __init__(self, pipeline: "MocapEvery", skeleton: Skeleton, floor: FloorFollower):
        self._pipeline, self._skeleton, self.floor = pipeline, skeleton, floor
        self._size = body_size(skeleton)[None]
        self._feet = skeleton.indices(*FEET)
        window = pipeline.net.window
        place = torch.arange(1, window + 1, dtype=torch.float32)
        self._weight = torch.minimum(place, window + 1 - place).square()[:, None]
        self._sensed: Sensed | None = None
        self._floors = torch.zeros(0)
        self._sum = torch.zeros(window, 0)
        """Weighted sums of what was said of the window's frames: root, rotations, contact, and of the weights."""
        self._given, self._taken = 0, 0

    def advance(self, new: Sensed) -> FinalPoses:
        """Take in up to `stride` new frames; the frames that are final now."""
        window, count = self._pipeline.net.window, len(new.t_world_head)
        if self._sensed is None:
            # Before a capture begins its first frame stands still.
            self._sensed = Sensed(*(part[:1].expand(window, *part.shape[1:]) for part in new))
            self._floors = self.floor.ahead(new.t_world_head[:1]).expand(window)
            self._sum = torch.zeros(window, 3 + 6 * len(self._skeleton) + 3)
        self._sensed = Sensed(*(torch.cat([a[count:], b]) for a, b in zip(self._sensed, new)))
        self._floors = torch.cat([self._floors[count:], self.floor.ahead(new.t_world_head)])
        self._sum = torch.cat([self._sum[count:], self._sum.new_zeros(count, self._sum.shape[1])])
        self._taken += count
        output = self._estimate()
        last = len(output)
        self._sum[-last:] += self._weight[-last:] * torch.cat([output, torch.ones(last, 1)], -1)
        R, t, contact = _parts(output[-count:])
        self.floor.follow(contact, forward_kinematics(self._skeleton, R, t).t[:, self._feet])
        return self._give(self._pipeline.lookahead)

    def correct(self, T_world_head: Rigid) -> None:
        """Put the latest head poses right, which had been held."""
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

    def finish(self) -> FinalPoses:
        """The frames that are left."""
        return self._give(0)

    def _give(self, waiting: int) -> FinalPoses:
        """Frames that have not been given yet, but for the last ones."""
        window, count = len(self._sum), self._taken - waiting - self._given
        stop = window - waiting
        rows = self._sum[stop - max(count, 0) : stop]
        self._given += max(count, 0)
        return FinalPoses(*_parts(rows[:, :-1] / rows[:, -1:]), self._floors[stop - len(rows) : stop])

    def _estimate(self) -> Float[Tensor, "predicted value"]:
        """Root, 6D rotations and contact in the world of the window's last frames.

        With `mirror_average` the window seen in a mirror is asked, too, and the mean of both taken: none of what a network
        believes of left hands and right ones stays.
        """
        pipeline, skeleton = self._pipeline, self._skeleton
        assert self._sensed is not None
        sensed, floor, size = Sensed(*(part[None] for part in self._sensed)), self._floors[None], self._size
        if pipeline.mirror_average:
            sensed = Sensed(*(torch.cat(both) for both in zip(sensed, mirrored(sensed))))
            floor, size = floor.expand(2, -1), size.expand(2, -1)
        canonical = pipeline.features.canonical(sensed, floor)
        estimated = pipeline.estimate(pipeline.features.encode(sensed, floor, size, canonical))
        R, t = to_world(
            *pipeline.features.decode_motion(estimated.motion.float(), sensed, canonical), canonical
        )
        contact = estimated.contact_logit.float().sigmoid()
        if pipeline.mirror_average:
            R = torch.stack([R[0], mirrored_rotations(R[1], skeleton)])
            t = torch.stack([t[0], t[1] * t.new_tensor(MIRROR)])
            contact = torch.stack([contact[0], contact[1].flip(-1)])
        return torch.cat([t, rotation.rot6d_from_matrix(R).flatten(-2), contact], -1).mean(0)


def _parts(
    output: Float[Tensor, "time value"],
) -> tuple[Float[Tensor, "time joint 3 3"], Float[Tensor, "time 3"], Float[Tensor, "time foot"]]:
    """Rotations, root and contact."""
    return rotation.matrix_from_rot6d(output[:, 3:-2].unflatten(-1, (-1, 6))), output[:, :3], output[:, -2:]
