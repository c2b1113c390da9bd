"""Outages of localisation planted in a recording of HPS' tables, and the errors that they cause."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.metrics.position import joint_error_cm
from wearcap.recording import Motion
from wearcap.recording.recording import Intervals, Localization
from wearsim.recordings.localization_noise import without

MARGIN_S = 5.0
"""Least time (s) between a visit to the depth-camera rig and a planted outage."""


@dataclass(frozen=True)
class Outage:
    """A time span without localisation (s, on the suit's clock)."""

    start_s: float
    length_s: float

    def frames(self, timestamps: Float64[Tensor, "time"]) -> Bool[Tensor, "time"]:
        """Mask of the frames within the outage."""
        return (timestamps >= self.start_s) & (timestamps < self.start_s + self.length_s)


def planted_outages(intervals: Intervals, end_s: float, lengths_s: Sequence[float]) -> list[Outage]:
    """Outages centred in the walks between visits: at most one per walk, the longest in the longest walk.

    An outage that does not leave `MARGIN_S` before and after it is shortened. Raises WearcapError when there are more
    outages than walks.
    """
    away = torch.cat([intervals.stop_s, torch.zeros(1, dtype=torch.float64)])
    back = torch.cat([intervals.start_s, torch.tensor([end_s], dtype=torch.float64)])
    walks = sorted(zip(away[:-1].tolist(), back[1:].tolist()), key=lambda walk: walk[0] - walk[1])
    if len(lengths_s) > len(walks):
        raise WearcapError(f"{len(lengths_s)} outages", expected=f"no more than {len(walks)}, one per walk")
    outages = []
    for length, (start, stop) in zip(sorted(lengths_s, reverse=True), walks):
        length = min(length, stop - start - 2 * MARGIN_S)
        if length <= 0:
            raise WearcapError(
                f"no room for an outage in a walk of {stop - start:.1f} s", expected=f"more than {2 * MARGIN_S:.0f} s"
            )
        outages.append(Outage((start + stop - length) / 2, length))
    return sorted(outages, key=lambda outage: outage.length_s)


@dataclass(frozen=True)
class _Disturbance:
    """Mean errors (cm) with and without localisation outages, over the same frames."""

    root_cm: float
    joint_cm: float
    undisturbed_root_cm: float
    undisturbed_joint_cm: float

    @property
    def root_ratio(self) -> float:
        """Error with outages divided by the error without."""
        return self.root_cm / self.undisturbed_root_cm

    @property
    def joint_ratio(self) -> float:
        """Error with outages divided by the error without."""
        return self.joint_cm / self.undisturbed_joint_cm


def disturbance(disturbed: Motion, undisturbed: Motion, truth: Motion, frames: Bool[Tensor, "time"]) -> _Disturbance:
    """Compare captures with and without outages over the given frames."""
    with_, without = (
        joint_error_cm(motion.T_world_joint.t, truth.T_world_joint.t)[frames] for motion in (disturbed, undisturbed)
    )
    return _Disturbance(*(float(e) for e in (with_[:, 0].mean(), with_.mean(), without[:, 0].mean(), without.mean())))


def with_outage(localization: Localization, start_s: float, length_s: float) -> Localization:
    """The same localisation without any found frames for a while from `start_s` (on its own clock).

    Raises WearcapError when no frame falls into it.
    """
    times = localization.timestamps
    lost = (times >= start_s) & (times < start_s + length_s)
    if not lost.any():
        expected = f"within {times[0]:.1f} to {times[-1]:.1f} s"
        raise WearcapError(f"an outage of {length_s} s at {start_s} s", expected=expected)
    return without(localization, lost)
