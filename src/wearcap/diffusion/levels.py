"""Noise levels per frame and modality, as training draws them (ECHO §3.2, §3.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError

DRAWS = 9
"""Uniform numbers per window that `LevelMix.levels` takes."""


@dataclass(frozen=True)
class LevelMix:
    """Shares of the windows whose levels are drawn in each way; what is left of 1 has one level per modality.

    independent: for every frame and modality (ECHO eq. 6). conveyor: grows along the window, as in a queue that fills,
    runs or empties. One level per modality for the whole window, independent between them, is TriDi's. Some windows
    have known frames in one modality, at level 0 (`observed`), as sparse observations are.
    """

    independent: float = 0.25
    conveyor: float = 0.6
    observed: float = 0.15
    whole: float = 0.0
    """Share of those windows in which all of that modality's frames are known."""
    ramp: tuple[int, int] | list[int] = (10, 60)
    """Fewest and most frames over which a conveyor's level grows from 0 to 1."""
    together: bool = False
    """Whether the modalities share the windows' one level (BoDiffusion's)."""

    def __post_init__(self):
        low, high = self.ramp
        if (
            not 1 <= low <= high
            or min(self.independent, self.conveyor) < 0
            or self.independent + self.conveyor > 1 + 1e-9
            or not 0 <= self.whole < 1
        ):
            raise WearcapError(f"shares {self.independent} and {self.conveyor}, {self.whole} of windows known whole, ramps of {low} to {high} frames",
                               expected="shares that add up to no more than 1, less than 1 known whole, and a rising pair of 1 or more frames")  # fmt: skip

    def levels(
        self, frames: Float[Tensor, "batch time draw"], draws: Float[Tensor, "batch 9"]
    ) -> Float[Tensor, "batch time modality"]:
        """Levels from uniform random numbers: one per frame and modality, one more per frame, and `DRAWS` per window."""
        frames, chance = frames[..., :-1], frames[..., -1:]
        time, count = frames.shape[1:]
        kind, ramp_at, tail_at, observed_parts, which, share, *_ = draws[..., None, None].unbind(1)
        low, high = self.ramp
        ramp = (low + (high - low) * ramp_at).round()
        # The queue's newest frame, at level 1, may lie behind the window: then the recording has ended.
        tail = tail_at * (time - 1 + ramp)
        place = torch.arange(time, device=frames.device)[None, :, None]
        grows = (1 - (tail - place) / ramp).clamp(0, 1).expand(-1, -1, count)
        single = draws[:, None, -1:] if self.together else draws[:, None, -count:]
        single = single.expand(-1, time, count)
        levels = torch.where(
            kind < self.independent,
            frames,
            torch.where(kind < self.independent + self.conveyor, grows, single),
        )
        modality = torch.arange(count, device=frames.device) == (which * count).long()
        # Few frames are known as often as many: the share of known frames grows with the cube, up to all of them.
        seen = chance < (share / (1 - self.whole)) ** 3
        return torch.where((observed_parts < self.observed) & modality & seen, 0.0, levels)
