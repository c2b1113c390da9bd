"""The usual way to make a window model endless: each window denoised from scratch, a part of it kept (ECHO Fig. 3, left)."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.diffusion.process import posterior_step
from wearcap.diffusion.sampler import step_levels
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import EchoQueue, Model, Said, Told


class Rewindow(EchoQueue):
    """Windows that advance by `stride` frames: what they share with the last one before its kept frames is known to
    them (at most the context), the next `stride` frames are kept, and what is behind them is thrown away.

    With the conveyor's context and steps its frames see as much of what was and will be.
    """

    def __init__(self, pipeline: Model, skeletons: Sequence, seeds: Sequence[int], stride: int = 10):
        super().__init__(pipeline, skeletons, seeds)
        self.stride = stride

    @torch.no_grad()
    def window(self, told: Told, before: Float[Tensor, "lane known feature"]) -> Float[Tensor, "lane frame feature"]:  # fmt: skip
        """x̂0 of a window, of whose frames the first ones are known, in normalised space."""
        frame = self.pipeline.features.canonical(told.points)
        count = told.valid.shape[1]
        known_frames = before.shape[1]
        held = self._held(told, frame)
        denoise, amend = self.pipeline.denoiser(self, told, frame)
        levels = step_levels(self.belt.steps, self.belt.spacing)
        # As much for a window that is not full: what is drawn for a lane does not depend on how long others are.
        x = self._noise(self.belt.window)[:, :count]
        known = held.known.clone()
        known[:, :known_frames] = before
        is_known = held.is_known.clone()
        is_known[:, :known_frames] = ~held.is_absent[:, :known_frames]
        wide = self.conveyor.wide
        for now, after in pairwise(levels):
            level, then = (
                torch.where(is_known, 0.0, torch.where(held.is_absent, 1.0, value)) for value in (now, after)
            )
            x = torch.where(wide(is_known), known, x)
            x0_hat = denoise(x, level)
            x0_hat = x0_hat if amend is None else amend(x0_hat)
            noise = self._noise(self.belt.window)[:, :count]
            x = posterior_step(
                x, x0_hat, wide(level), wide(then), noise, self.pipeline.schedule, self.belt.eta
            )
        return x

    @torch.no_grad()
    def run(self, whole: Told) -> Said:
        """All frames of some lanes."""
        context, count = self.belt.context, whole.valid.shape[1]
        given: list[Said] = []
        before, start = torch.zeros(len(whole.valid), 0, sum(self.pipeline.net.sizes)), 0
        while start < count:
            first = max(0, start - context)
            told = whole.frames(slice(first, min(first + self.belt.window, count)))
            before, frame = before[:, before.shape[1] - (start - first) :], self.pipeline.features.canonical(told.points)  # fmt: skip
            if self._frame is not None and self.pipeline.features.moves:
                change, known = frame.inverse() @ self._frame, told.frames(slice(0, start - first))
                before = self._reexpressed(before, change, torch.zeros(1, 1, len(MODALITIES)), known)
            self._frame = frame
            x = self.window(told, before)
            stop = min(start + self.stride, count)
            given.append(self._decoded(x, slice(start - first, stop - first), frame))
            kept = x[:, : stop - first]
            before, start = kept[:, -context:] if context else kept[:, :0], stop
        return Said(*(torch.cat(parts, 1) for parts in zip(*given)))
