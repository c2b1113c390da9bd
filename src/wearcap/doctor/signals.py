"""Small measurements that several checks share."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.io.devices.head_alignment import best_shift, correlate_shifts
from wearcap.sensors.imu import acceleration

LAG_RATE_HZ = 200.0


def quantile(value: Float[Tensor, "*any"], q: float) -> float:
    """Quantile of all entries (0 if empty); long signals are subsampled to a million entries."""
    flat = value.flatten().double()
    return torch.quantile(flat[:: len(flat) // 1_000_000 + 1], q).item() if len(flat) else 0.0


def spin_of(track: Trajectory) -> Float[Tensor, "time 3"]:
    """Angular velocity (rad/s) in the body's own axes, by central differences over two frames."""
    R, times = track.R_world_body.double(), track.timestamps
    if len(R) < 3:
        return torch.zeros(len(R), 3, dtype=torch.float64)
    turn = rotation.log(R[:-2].mT @ R[2:]) / (times[2:] - times[:-2])[:, None]
    return torch.cat([turn[:1], turn, turn[-1:]])


def acceleration_of(track: Trajectory) -> Float[Tensor, "time 3"]:
    """Acceleration (m/s²) in the world, as synthetic IMUs have it: MocapEvery eq. 8 over the span of 4 frames at 60 Hz."""
    if len(track) < 2:
        return torch.zeros(len(track), 3, dtype=torch.float64)
    fps = 1 / track.timestamps.diff().median().item()
    return acceleration(track.t_world_body.double(), fps, max(1, round(fps / 15)))


def lag_between(
    reference_times: Float64[Tensor, "time"],
    reference: Float[Tensor, "time"],
    other_times: Float64[Tensor, "sample"],
    other: Float[Tensor, "sample"],
    max_lag_s: float = 1.0,
) -> tuple[float, float, float] | None:
    """(lag in s, correlation at that lag, correlation without a shift) between two signals of the same quantity.

    A positive lag means that `other` is late. None if the streams share less than 4 s or a signal is constant.
    """
    start = max(reference_times[0].item(), other_times[0].item())
    stop = min(reference_times[-1].item(), other_times[-1].item())
    if stop - start < 4.0:
        return None
    grid = torch.arange(start, stop, 1 / LAG_RATE_HZ, dtype=torch.float64)[: int(600 * LAG_RATE_HZ)]
    a, b = (interpolate(reference_times, reference.double(), grid), interpolate(other_times, other.double(), grid))
    if a.std() < 1e-6 or b.std() < 1e-6:
        return None
    shifts, score = correlate_shifts(a.numpy(), b.numpy(), 0.7)
    near = abs(shifts) <= max_lag_s * LAG_RATE_HZ
    shifts, score = shifts[near], score[near]
    # Walking is periodic: among peaks as good as the highest, the smallest shift is taken.
    rising = np.diff(score, prepend=-np.inf) > 0
    falling = np.diff(score, append=-np.inf) <= 0
    peaks = (rising & falling & (score >= score.max() - 0.02)).nonzero()[0]
    peak = int(peaks[abs(shifts[peaks]).argmin()])
    beside = slice(max(peak - 1, 0), peak + 2)
    shift, best = best_shift(shifts[beside], score[beside])
    return shift / LAG_RATE_HZ, best, float(score[shifts == 0][0])
