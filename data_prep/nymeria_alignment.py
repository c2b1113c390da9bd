"""Align a motion capture suit with the head device worn on it: clocks, mounting of the device, and the suit's drifting world."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.correlation import best_shift, correlate_shifts
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate, resample

_RATE_HZ = 60.0
_STEP_S = 0.5
"""Span (s) of the compared relative motions: long against noise, short against the suit's drift."""
_SEAT_PRIOR_M = 0.05
"""Standard deviation (m) of the device's position on the head about the assumed one (our choice)."""


@dataclass(frozen=True)
class _Alignment:
    """Alignment of suit and device."""

    T_head_device: Rigid
    """Constant pose of the device on the suit's head joint."""
    T_world_suit: Rigid
    """Pose of the suit's world in the device's world, per suit frame: a yaw rotation and a translation."""
    residual_m: float
    residual_rad: float
    """Median distance (m) and angle between the aligned head and the device."""


def clock_offset(suit: Trajectory, device: Trajectory) -> float:
    """Seconds to add to the suit's timestamps to bring them to the device's clock, from angular speed alone.

    Clocks may differ by any amount; the whole recordings are correlated. Raises WearcapError when the head's and
    the device's turns correlate below 0.5 at every shift.
    """
    grids, speeds = [], []
    for track in (suit, device):
        span = (track.timestamps[-1] - track.timestamps[0]).item()
        grid = track.timestamps[0] + torch.arange(int(span * _RATE_HZ) + 1, dtype=torch.float64) / _RATE_HZ
        R = resample(track, grid).R_world_body.double()
        speeds.append(rotation.geodesic(R[:-1], R[1:]) * _RATE_HZ)
        grids.append(grid)
    a, b = (speed.clamp(max=10.0).numpy() for speed in speeds)
    lag, score = best_shift(*correlate_shifts(a, b, 1 / 3))
    if score < 0.5:
        what = f"head and device do not move alike at any shift of their clocks (correlation {score:.2f})"
        raise WearcapError(what, expected="a recording of the same head")
    return grids[1][0].item() - grids[0][0].item() + lag / _RATE_HZ


def align_head(
    suit: Trajectory, device: Trajectory, t_head_device: Float[Tensor, "3"], window_s: float = 8.0
) -> _Alignment:
    """Solve device = T_world_suit(t) · suit head · T_head_device, both streams on one clock, both worlds z up.

    The mounting's rotation comes from relative rotations and from both streams' up direction (Wahba's problem), its
    position from head turns with `t_head_device` (m) as a weak prior; the suit's world then is the median yaw and
    translation in windows of `window_s`, interpolated. Raises WearcapError where the streams share less than 10 s or the head hardly turns.
    """
    shared = (suit.timestamps >= device.timestamps[0]) & (suit.timestamps <= device.timestamps[-1])
    if shared.sum() < 2 or suit.timestamps[shared][-1] - suit.timestamps[shared][0] < 10:
        raise WearcapError("suit and device share less than 10 s", expected="overlapping recordings on one clock")
    start, stop = suit.timestamps[shared][0].item(), suit.timestamps[shared][-1].item()
    grid = start + torch.arange(int((stop - start) * _RATE_HZ), dtype=torch.float64) / _RATE_HZ
    head, seen = (resample(track, grid).T_world_body.to(torch.float64) for track in (suit, device))
    # turn_head = R_head_device · turn_device and up_head = R_head_device · up_device, robustly
    step = int(_STEP_S * _RATE_HZ)
    turn_head = rotation.log(head.R[:-step].mT @ head.R[step:])
    turn_device = rotation.log(seen.R[:-step].mT @ seen.R[step:])
    if turn_head.norm(dim=-1).quantile(0.9) < 0.1:
        raise WearcapError("the head hardly turns", expected="turns of more than 6° in half a second, now and then")
    a = torch.cat([turn_head, head.R[:, 2, :]])
    b = torch.cat([turn_device, seen.R[:, 2, :]])
    weight = torch.ones(len(a), dtype=torch.float64)
    R_head_device = torch.eye(3, dtype=torch.float64)
    for _ in range(8):
        R_head_device = rotation.mean_rotation(torch.einsum("n,ni,nj->ij", weight, a, b)[None])
        residual = (a - b @ R_head_device.mT).norm(dim=-1)
        weight = 1 / (residual / residual.median().clamp(min=1e-6)).clamp(min=1.0)
    R_apart = seen.R @ R_head_device.mT @ head.R.mT
    # Yaw (rad, unwrapped) by window, and the windows' middles
    cos, sin = R_apart[:, 0, 0] + R_apart[:, 1, 1], R_apart[:, 1, 0] - R_apart[:, 0, 1]
    length = torch.hypot(cos, sin).clamp(min=1e-9)
    count = max(2, round((grid[-1] - grid[0]).item() / (window_s / 2)) + 1)
    knots = torch.linspace(grid[0].item(), grid[-1].item(), count, dtype=torch.float64)
    mean = _windowed_median(torch.stack([cos / length, sin / length], 1), grid, knots, window_s)
    yaw = torch.from_numpy(np.unwrap(torch.atan2(mean[:, 1], mean[:, 0]).numpy()))
    R_world_suit = rotation.about_axis("z", _between(knots, yaw, grid))
    t_seat = _mounting_position(
        Rigid(R_world_suit @ head.R, (R_world_suit @ head.t[..., None])[..., 0]), seen, t_head_device.double()
    )
    t_apart = seen.t - (R_world_suit @ (head.t + (head.R @ t_seat))[..., None])[..., 0]
    shift = _windowed_median(t_apart, grid, knots, window_s)
    error = t_apart - _between(knots, shift, grid)
    at = suit.timestamps
    T_world_suit = Rigid(rotation.about_axis("z", _between(knots, yaw, at)), _between(knots, shift, at))
    turn = rotation.geodesic(R_world_suit @ head.R @ R_head_device, seen.R)
    T_head_device = Rigid(R_head_device, t_seat).to(torch.float32)
    return _Alignment(T_head_device, T_world_suit, error.norm(dim=-1).median().item(), turn.median().item())


def _mounting_position(head: Rigid, seen: Rigid, t_prior: Float64[Tensor, "3"]) -> Float64[Tensor, "3"]:
    """t_head_device from the device's displacement against the head joint while the head turns (least squares, Huber)."""
    step = int(_STEP_S * _RATE_HZ)
    A = head.R[step:] - head.R[:-step]
    b = (seen.t[step:] - seen.t[:-step]) - (head.t[step:] - head.t[:-step])
    t = t_prior
    for _ in range(8):
        residual = (b - A @ t).norm(dim=-1)
        scale = residual.median().clamp(min=1e-4)
        # Half-second differences overlap thirtyfold, so the samples' weight is reduced accordingly.
        weight = 1 / (residual / scale).clamp(min=1.0) / (scale**2 * step)
        normal = torch.einsum("n,nki,nkj->ij", weight, A, A) + torch.eye(3, dtype=torch.float64) / _SEAT_PRIOR_M**2
        right = torch.einsum("n,nki,nk->i", weight, A, b) + t_prior / _SEAT_PRIOR_M**2
        t = torch.linalg.solve(normal, right)
    return t


def _windowed_median(value: Tensor, grid: Tensor, knots: Tensor, window_s: float) -> Tensor:
    """Median of the values within half a window of each knot; windows at the ends shrink to stay symmetric."""
    first = torch.searchsorted(grid, knots - window_s / 2)
    last = torch.searchsorted(grid, knots + window_s / 2, right=True)
    middle = torch.searchsorted(grid, knots).clamp(max=len(grid) - 1)
    reach = torch.minimum(middle - first, last - 1 - middle).clamp(min=int(0.5 * _RATE_HZ))
    return torch.stack(
        [value[max(m - r, 0) : m + r + 1].median(0).values for m, r in zip(middle.tolist(), reach.tolist())]
    )


def _between(knots: Tensor, value: Tensor, at: Tensor) -> Tensor:
    """Linear interpolation between knots, constant outside them."""
    return interpolate(knots, value, at.clamp(knots[0].item(), knots[-1].item()))
