"""The tracked hands of one wearer in a live capture: samples in, finger angles out, at any rate of either."""

from dataclasses import replace

import torch

from wearcap.recording import FingerStream
from wearcap.sensors.samples import HandSample
from wearcap.tracking.fingers import SHORT_S, FittedHand, fit_hand

MAX_WAITING = 3600
"""Samples of a hand that may wait to be fitted: a piece of a minute."""


class LiveHands:
    """Keeps what hands sent; they are fitted when poses become final, all new samples at once."""

    def __init__(self) -> None:
        self._waiting: dict[str, list[FingerStream]] = {}
        self._fitted: dict[str, FittedHand] = {}
        self._last_s: dict[str, float] = {}

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def take(self, sample: HandSample, time_s: float) -> None:
        """Take in a sample at its time on the leading clock; one that is not later than the last is left out."""
        waiting = self._waiting.setdefault(sample.side, [])
        if time_s > self._last_s.get(sample.side, -torch.inf):
            self._last_s[sample.side] = time_s
            waiting.append(replace(sample.joints, timestamps=torch.tensor([time_s], dtype=torch.float64)))
            del waiting[:-MAX_WAITING]

    def fitted(self, since_s: float) -> dict[str, FittedHand]:
        """The hands by side, as far as they matter for poses from a time (s) on."""
        for side, waiting in self._waiting.items():
            if waiting:
                columns = zip(*((part.timestamps, part.points, part.valid, part.confidence) for part in waiting))
                turned = [part.rotations for part in waiting if part.rotations is not None]
                rotations = torch.cat(turned) if len(turned) == len(waiting) else None
                new = fit_hand(FingerStream(*map(torch.cat, columns), rotations), side)
                known = self._fitted.get(side, new)
                kept = known.timestamps > since_s - SHORT_S if known is not new else slice(0)
                rows = [torch.cat([a[kept], b]) for a, b in zip(known[:3], new[:3])]
                self._fitted[side] = FittedHand(*rows, new.shape, new.wrong)
                waiting.clear()
        return self._fitted
