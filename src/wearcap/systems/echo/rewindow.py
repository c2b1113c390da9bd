"""Overlapping windows in place of the conveyor, denoised from scratch with inpainted overlap (ECHO Fig. 3, left)."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.diffusion.process import posterior_step, step_levels
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Model, Outputs


class Rewindow(EchoQueue):
    """Windows that advance by `stride` frames: the last final frames (at most the context) are inpainted, the next
    `stride` frames become final, and the rest is discarded.

    With the conveyor's context and steps, a frame sees as much of the past and future as on the conveyor.
    """

    def __init__(self, pipeline: Model, skeletons: Sequence, seeds: Sequence[int], stride: int = 10):
        super().__init__(pipeline, skeletons, seeds)
        self.stride = stride

    @torch.no_grad()
    def window(
        self, conditioning: Conditioning, before: Float[Tensor, "batch observed feature"]
    ) -> Float[Tensor, "batch frame feature"]:
        """A sampled window in normalised space, whose first frames are inpainted with `before`."""
        frame = self.pipeline.features.canonical(conditioning.points)
        count = conditioning.valid.shape[1]
        observed_frames = before.shape[1]
        observation = self._observation(conditioning, frame)
        denoise, correct = self.pipeline.denoiser(self, conditioning, frame)
        levels = step_levels(self.rolling.steps, self.rolling.spacing)
        # Always a full window's noise: a batch item's noise must not depend on the length of the others.
        x = self._noise(self.rolling.window)[:, :count]
        observed = observation.observed.clone()
        observed[:, :observed_frames] = before
        is_observed = observation.is_observed.clone()
        is_observed[:, :observed_frames] = ~observation.is_absent[:, :observed_frames]
        wide = self.conveyor.wide
        for now, after in pairwise(levels):
            level, then = (
                torch.where(is_observed, 0.0, torch.where(observation.is_absent, 1.0, value)) for value in (now, after)
            )
            x = torch.where(wide(is_observed), observed, x)
            x0_hat = denoise(x, level)
            x0_hat = x0_hat if correct is None else correct(x0_hat)
            noise = self._noise(self.rolling.window)[:, :count]
            x = posterior_step(x, x0_hat, wide(level), wide(then), noise, self.pipeline.schedule, self.rolling.eta)
        return x

    @torch.no_grad()
    def run(self, whole: Conditioning) -> Outputs:
        """Outputs of all frames of a batch."""
        context, count = self.rolling.context, whole.valid.shape[1]
        outputs: list[Outputs] = []
        before, start = torch.zeros(len(whole.valid), 0, sum(self.pipeline.net.sizes)), 0
        while start < count:
            first = max(0, start - context)
            conditioning = whole.frames(slice(first, min(first + self.rolling.window, count)))
            before, frame = (
                before[:, before.shape[1] - (start - first) :],
                self.pipeline.features.canonical(conditioning.points),
            )
            if self._frame is not None and self.pipeline.features.moves:
                change, observed = frame.inverse() @ self._frame, conditioning.frames(slice(0, start - first))
                before = self._reexpressed(before, change, torch.zeros(1, 1, len(MODALITIES)), observed)
            self._frame = frame
            x = self.window(conditioning, before)
            stop = min(start + self.stride, count)
            outputs.append(self._decoded(x, slice(start - first, stop - first), frame))
            final = x[:, : stop - first]
            before, start = final[:, -context:] if context else final[:, :0], stop
        return Outputs(*(torch.cat(parts, 1) for parts in zip(*outputs)))
