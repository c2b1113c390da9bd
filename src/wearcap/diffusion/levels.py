"""Training distribution of noise levels per frame and modality (ECHO §3.2, §3.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError

DRAWS = 10
"""Uniform numbers per window that `LevelMix.levels` takes."""


@dataclass(frozen=True)
class LevelMix:
    """Shares of the windows whose levels are drawn by each scheme; the remaining windows have one level per modality.

    independent: a level for every frame and modality (ECHO eq. 6). conveyor: levels grow along the window, as in a
    conveyor that fills, runs or empties. pure: all levels are 1, from which one step leads to the mean of the plausible
    motions (ours). One level per modality for the whole window is TriDi's scheme. In a share `observed` of the windows some
    frames of one modality are at level 0, as sparse observations are.
    """

    independent: float
    conveyor: float
    observed: float
    pure: float = 0.0
    fully_observed: float = 0.0
    """Share of the windows with observations in which all frames of that modality are observed."""
    ramp: tuple[int, int] | list[int] = (10, 60)
    """Smallest and largest number of frames over which a conveyor's level grows from 0 to 1."""
    together: bool = False
    """Whether all modalities share a window's single level, as in BoDiffusion."""
    lead: tuple[float, ...] | list[float] = ()
    """Largest share of a conveyor's ramp by which each modality's own ramp may be shorter, so that it is denoised before
    the others (ours); none: all have the same."""
    chances: tuple[float, ...] | list[float] = ()
    """Relative frequency with which each modality is the observed one; none: all alike."""

    def __post_init__(self):
        low, high = self.ramp
        if (
            not 1 <= low <= high
            or min(self.independent, self.conveyor, self.pure) < 0
            or self.independent + self.conveyor + self.pure > 1 + 1e-9
            or not 0 <= self.fully_observed < 1
            or not all(0 <= lead < 1 for lead in self.lead)
            or min(self.chances, default=1.0) < 0
        ):
            raise WearcapError(
                f"shares {self.independent}, {self.conveyor} and {self.pure}, {self.fully_observed} of windows fully observed, ramps of {low} to {high} frames",
                expected="shares that add up to no more than 1, less than 1 fully observed and in the lead, and a rising pair of 1 or more frames",
            )

    def levels(
        self, frames: Float[Tensor, "batch time draw"], draws: Float[Tensor, "batch 10"]
    ) -> Float[Tensor, "batch time modality"]:
        """Levels from uniform random numbers: one per frame and modality, one more per frame, and `DRAWS` per window."""
        frames, chance = frames[..., :-1], frames[..., -1:]
        time, count = frames.shape[1:]
        kind, ramp_at, tail_at, observed_parts, which, share, ahead, *_ = draws[..., None, None].unbind(1)
        low, high = self.ramp
        ramp = (low + (high - low) * ramp_at).round()
        # The conveyor's newest frame, at level 1, may be after the window's end: then the recording has ended.
        tail = tail_at * (time - 1 + ramp)
        place = torch.arange(time, device=frames.device)[None, :, None]
        ramps = ramp * (1 - ahead * frames.new_tensor(list(self.lead) or [0.0] * count))
        grows = (1 - (tail - place) / ramps).clamp(0, 1)
        single = draws[:, None, -1:] if self.together else draws[:, None, -count:]
        single = torch.where(kind >= 1 - self.pure, 1.0, single.expand(-1, time, count))
        levels = torch.where(
            kind < self.independent, frames, torch.where(kind < self.independent + self.conveyor, grows, single)
        )
        chances = frames.new_tensor(list(self.chances) or [1.0] * count).cumsum(0)
        modality = torch.arange(count, device=frames.device) == (which >= chances[:-1] / chances[-1]).sum(-1, True)
        # The share of observed frames is the cube of a uniform number, so that few are as frequent as many.
        seen = chance < (share / (1 - self.fully_observed)) ** 3
        return torch.where((observed_parts < self.observed) & modality & seen, 0.0, levels)
