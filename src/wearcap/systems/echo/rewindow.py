"""The usual way to make a window model endless: each window denoised from scratch, a part of it kept (ECHO Fig. 3, left)."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.diffusion.process import posterior_step
from wearcap.diffusion.sampler import step_levels
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Model, Outputs


class Rewindow(EchoQueue):
    """Windows that advance by `stride` frames: what they share with the last one before its kept frames is known to
    them (at most the context), the next `stride` frames are kept, and what is behind them is thrown away.

    With the conveyor's context and steps its frames see as much of what was and will be.
    """

    def __init__(self, pipeline: Model, skeletons: Sequence, seeds: Sequence[int], stride: int = 10):
        super().__init__(pipeline, skeletons, seeds)
        self.stride = stride

    @torch.no_grad()
    def window(self, conditioning: Conditioning, before: Float[Tensor, "batch known feature"]) -> Float[Tensor, "batch frame feature"]:  # fmt: skip
        """x̂0 of a window, of whose frames the first ones are known, in normalised space."""
        frame = self.pipeline.features.canonical(conditioning.points)
        count = conditioning.valid.shape[1]
        observed_frames = before.shape[1]
        observation = self._observation(conditioning, frame)
        denoise, correct = self.pipeline.denoiser(self, conditioning, frame)
        levels = step_levels(self.rolling.steps, self.rolling.spacing)
        # As much for a window that is not full: what is drawn for a lane does not depend on how long others are.
        x = self._noise(self.rolling.window)[:, :count]
        observed = observation.observed.clone()
        observed[:, :observed_frames] = before
        is_observed = observation.is_observed.clone()
        is_observed[:, :observed_frames] = ~observation.is_absent[:, :observed_frames]
        wide = self.conveyor.wide
        for now, after in pairwise(levels):
            level, then = (
                torch.where(is_observed, 0.0, torch.where(observation.is_absent, 1.0, value))
                for value in (now, after)
            )
            x = torch.where(wide(is_observed), observed, x)
            x0_hat = denoise(x, level)
            x0_hat = x0_hat if correct is None else correct(x0_hat)
            noise = self._noise(self.rolling.window)[:, :count]
            x = posterior_step(
                x, x0_hat, wide(level), wide(then), noise, self.pipeline.schedule, self.rolling.eta
            )
        return x

    @torch.no_grad()
    def run(self, whole: Conditioning) -> Outputs:
        """All frames of some lanes."""
        context, count = self.rolling.context, whole.valid.shape[1]
        given: list[Outputs] = []
        before, start = torch.zeros(len(whole.valid), 0, sum(self.pipeline.net.sizes)), 0
        while start < count:
            first = max(0, start - context)
            conditioning = whole.frames(slice(first, min(first + self.rolling.window, count)))
            before, frame = before[:, before.shape[1] - (start - first) :], self.pipeline.features.canonical(conditioning.points)  # fmt: skip
            if self._frame is not None and self.pipeline.features.moves:
                change, observed = frame.inverse() @ self._frame, conditioning.frames(slice(0, start - first))
                before = self._reexpressed(before, change, torch.zeros(1, 1, len(MODALITIES)), observed)
            self._frame = frame
            x = self.window(conditioning, before)
            stop = min(start + self.stride, count)
            given.append(self._decoded(x, slice(start - first, stop - first), frame))
            kept = x[:, : stop - first]
            before, start = kept[:, -context:] if context else kept[:, :0], stop
        return Outputs(*(torch.cat(parts, 1) for parts in zip(*given)))
