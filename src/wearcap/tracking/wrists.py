"""Tracked wrists at the frames of a capture: cameras see hands now and then, controllers wake up late and fall silent."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory

UNSEEN_S = 0.15
"""Longest interval (s) between poses of a wrist that is interpolated, and time for which a wrist that was lost counts as seen
where it was; Aria's hand tracking has 10 Hz."""


def seen_wrist(track: Trajectory | None, at: Float64[Tensor, "time"]) -> tuple[Rigid, Bool[Tensor, "time"]]:
    """Poses of a wrist at some times, and where it was seen; elsewhere the pose is any. None: it never was.

    Whether a wrist is seen depends on the past alone, so that a stream knows it, too.
    """
    if track is None or not len(track):
        return Rigid(torch.eye(3).expand(len(at), 3, 3), torch.zeros(len(at), 3)), torch.zeros(
            len(at), dtype=torch.bool
        )
    times, at = track.timestamps, at.contiguous()
    last = torch.searchsorted(times, at + 1e-4, right=True) - 1
    before, after = last.clamp_min(0), (last + 1).clamp_max(len(times) - 1)
    step, since = times[after] - times[before], at - times[before]
    share = torch.where((step > 0) & (step <= UNSEEN_S), (since / step.clamp_min(1e-9)).clamp(0, 1), 0.0).float()
    t = torch.lerp(track.t_world_body[before], track.t_world_body[after], share[:, None])
    R = rotation.between(track.R_world_body[before], track.R_world_body[after], share)
    return Rigid(R.float(), t.float()), (last >= 0) & (since <= UNSEEN_S)
