"""Calibration steps in which a sensor is held still: finding them in a log, measuring stillness, quality checks."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, find_gaps, resample

Stretch = tuple[float, float]
"""Start and stop time (s, on the log's clock)."""
_LOOK_S = 0.5
"""Interval over which rotation is measured: it averages out gyroscope noise, but not a hand's tremor."""

_GAP_S = 2.0


@dataclass(frozen=True)
class StepCheck:
    """Quality check of a calibration step: one measured number with its limit."""

    step: str
    what: str
    measured: float
    limit: float
    unit: str
    fix: str
    at_least: bool = False
    """Whether the limit is a minimum instead of a maximum."""

    @property
    def ok(self) -> bool:
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    @property
    def expected(self) -> str:
        return f"at {'least' if self.at_least else 'most'} {self.limit:g} {self.unit}".rstrip()


def require(checks: Sequence[StepCheck]) -> None:
    """Raise WearcapError for the first check that is not ok: the step, what was measured, what is expected."""
    for check in checks:
        if not check.ok:
            what = f"{check.what}: {check.measured:.3g} {check.unit}".rstrip()
            raise WearcapError(what, where=check.step, expected=check.expected, fix=check.fix)


def during(
    timestamps: Float64[Tensor, "time"], stretch: Stretch, step: str, min_s: float = 2.0
) -> Bool[Tensor, "time"]:
    """Samples of a stretch. Raises WearcapError, naming the step, when it is too short or not in the log."""
    start, stop = stretch
    if stop - start < min_s:
        what = f"the stretch from {start:.2f} s to {stop:.2f} s is {stop - start:.2f} s long"
        fix = "Hold still for longer and do this step again."
        raise WearcapError(what, where=step, expected=f"at least {min_s:g} s", fix=fix)
    inside = (timestamps >= start) & (timestamps <= stop)
    first, last = (timestamps[inside][[0, -1]] if inside.any() else timestamps.new_zeros(2)).tolist()
    if not inside.any() or first - start > 0.25 or stop - last > 0.25:
        what = f"the log has {int(inside.sum())} samples from {start:.2f} s to {stop:.2f} s"
        expected = f"a stretch within the log, {timestamps[0].item():.2f} s to {timestamps[-1].item():.2f} s"
        raise WearcapError(what, where=step, expected=expected, fix="Give other times for this step.")
    return inside


def unstillness_deg(R: Float[Tensor, "time 3 3"]) -> float:
    """Root mean square angle of rotations to their mean."""
    mean = rotation.mean_rotation(R)
    return rotation.geodesic(mean.expand_as(R), R).square().mean().sqrt().rad2deg().item()


def still_intervals(
    timestamps: Float64[Tensor, "time"], R: Float[Tensor, "time 3 3"], min_s: float = 2.0, still_deg: float = 4.0
) -> list[Stretch]:
    """Stretches during which a sensor turns by less than `still_deg` in any half second, their ends trimmed; none spans a
    gap of `_GAP_S`, so that no grid is longer than the samples make it."""
    if len(gaps := find_gaps(timestamps, _GAP_S)):
        edges = [0, *(gaps + 1).tolist(), len(timestamps)]
        parts = [slice(first, last) for first, last in pairwise(edges)]
        return [one for part in parts for one in still_intervals(timestamps[part], R[part], min_s, still_deg)]
    if len(timestamps) < 2 or timestamps[-1] - timestamps[0] < max(min_s, _LOOK_S):
        return []
    at = torch.arange(timestamps[0].item(), timestamps[-1].item() - _LOOK_S, 0.05, dtype=torch.float64)
    path = Trajectory(timestamps, R, torch.zeros(len(R), 3).to(R))
    before, after = (resample(path, at + shift).R_world_body for shift in (0.0, _LOOK_S))
    calm = (rotation.geodesic(before, after).rad2deg() < still_deg).numpy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], calm.astype(np.int8), [0]])))
    found = []
    for first, last in edges.reshape(-1, 2):
        # The half second after the last calm time is calm, too; 0.1 s is trimmed at each end.
        start, stop = at[first].item() + 0.1, at[last - 1].item() + _LOOK_S - 0.1
        if stop - start >= min_s:
            found.append((start, stop))
    return found
