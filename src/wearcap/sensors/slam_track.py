"""Outlier removal of a monocular SLAM trajectory by implausible accelerations (MocapEvery §3.2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory, filled, require_rising

MAX_ACCELERATION = 40.0
"""m/s² at the usual 30 Hz: a jump of 4.5 cm between two frames. A running head stays below 30 (ours: the paper gives
no number)."""
MAX_BURST_S = 1.0
"""Longest burst of outliers; longer deviating segments are jumps of the SLAM system to another place."""


@dataclass(frozen=True)
class CleanTrack:
    """A trajectory without outliers, with the replaced frames and remaining jumps."""

    trajectory: Trajectory
    """On the same timestamps; outliers are interpolated."""
    valid: Bool[Tensor, "time"]
    """False where a pose was replaced."""
    jumps_s: Float64[Tensor, "jump"]
    """Times before jumps that are not short bursts; the path before and after is inconsistent."""


def clean_track(
    trajectory: Trajectory, max_acceleration: float = MAX_ACCELERATION, max_burst_s: float = MAX_BURST_S
) -> CleanTrack:
    """Drop outliers (`acceleration_outliers`), fill them by linear interpolation and slerp; positions in m.

    Raises WearcapError for timestamps that do not rise, and when no pose is finite.
    """
    valid, jumps_s = acceleration_outliers(trajectory, max_acceleration, max_burst_s)
    if not valid.any():
        raise WearcapError("no pose of the trajectory is finite", expected="camera positions in metres")
    return CleanTrack(filled(trajectory, valid), valid, jumps_s)


def acceleration_outliers(
    trajectory: Trajectory, max_acceleration: float = MAX_ACCELERATION, max_burst_s: float = MAX_BURST_S
) -> tuple[Bool[Tensor, "time"], Float64[Tensor, "jump"]]:
    """Valid frames, and the times of jumps that remain.

    A jump between two frames accelerates both of them, there and back; a hard step or a turn only one. Where both
    exceed `max_acceleration` (m/s²) the track is cut, a piece not longer than those beside it nor than `max_burst_s` is
    dropped, its neighbours are joined, and so on. A burst of any shape is thus dropped as a whole, and
    longer good pieces beside it stay. Frames that are not finite are never valid.
    """
    require_rising(trajectory.timestamps)
    position, time = trajectory.t_world_body.double(), trajectory.timestamps
    finite = position.isfinite().all(-1) & trajectory.R_world_body.isfinite().all(-1).all(-1)
    kept = finite.nonzero()[:, 0]
    while True:
        cut = _jump_acceleration(position[kept], time[kept]) > max_acceleration
        dropped = _short_pieces(cut, time[kept], max_burst_s)
        if not dropped.any():
            break
        kept = kept[~dropped]
    valid = torch.zeros_like(finite)
    valid[kept] = True
    return valid, time[kept][:-1][cut]


def _jump_acceleration(position: Float64[Tensor, "time 3"], time: Float64[Tensor, "time"]) -> Float64[Tensor, "step"]:
    """For each step from frame to frame, the smaller of the accelerations (m/s²) at its two ends.

    Second differences on uneven times; the first and the last frame have none of their own.
    """
    if len(time) < 3:
        return time.new_zeros(max(len(time) - 1, 0))
    step = time.diff()
    velocity = position.diff(dim=0) / step[:, None]
    acceleration = 2 * velocity.diff(dim=0).norm(dim=-1) / (step[1:] + step[:-1])
    return torch.minimum(_padded(acceleration, first=True), _padded(acceleration, first=False))


def _padded(value: Float[Tensor, "inner"], *, first: bool) -> Float[Tensor, "step"]:
    beyond = value.new_full((1,), torch.inf)
    return torch.cat([beyond, value] if first else [value, beyond])


def _short_pieces(cut: Bool[Tensor, "step"], time: Float64[Tensor, "time"], max_burst_s: float) -> Bool[Tensor, "time"]:
    """Frames of pieces between cuts that are not longer than the pieces beside them nor than `max_burst_s`."""
    if not cut.any():
        return torch.zeros_like(time, dtype=torch.bool)
    piece: Int64[Tensor, "time"] = torch.cat([cut.new_zeros(1), cut]).cumsum(0)
    length = torch.bincount(piece)
    end = length.cumsum(0)
    span = time[end - 1] - time[end - length]
    wall = length.new_full((1,), len(time) + 1)
    left, right = torch.cat([wall, length[:-1]]), torch.cat([length[1:], wall])
    short = (length <= left) & (length <= right) & (span <= max_burst_s)
    return short.index_fill(0, length.argmax(), False)[piece]
