"""The tracked hands of one wearer in a live capture: samples in, finger angles out, at any rate of either."""

import torch

from wearcap.recording import FingerStream
from wearcap.sensors.samples import HandSample
from wearcap.tracking.fingers import SHORT_S, FittedHand, fit_hand

MAX_WAITING = 600
"""Samples of a hand that may wait to be fitted."""


class LiveHands:
    """Keeps what hands sent; they are fitted when poses become final, all new samples at once."""

    def __init__(self) -> None:
        self._waiting: dict[str, list[HandSample]] = {}
        self._fitted: dict[str, FittedHand] = {}

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def take(self, sample: HandSample, time_s: float) -> None:
        """Take in a sample at its time on the leading clock; one that is not later than the last is left out."""
        waiting = self._waiting.setdefault(sample.side, [])
        known = self._fitted.get(sample.side)
        last_s = waiting[-1].timestamp if waiting else known.timestamps[-1].item() if known else -torch.inf
        if time_s > last_s:
            self._waiting[sample.side] = [*waiting[1 - MAX_WAITING :], sample._replace(timestamp=time_s)]

    def fitted(self, since_s: float) -> dict[str, FittedHand]:
        """The hands by side, as far as they matter for poses from a time (s) on."""
        for side, waiting in self._waiting.items():
            if waiting:
                new, known = fit_hand(_stream(waiting), side), self._fitted.get(side)
                self._waiting[side] = []
                kept = slice(0) if known is None else known.timestamps > since_s - SHORT_S
                rows = [torch.cat([a[kept], b]) for a, b in zip((known or new)[:3], new[:3])]
                self._fitted[side] = FittedHand(*rows, new.shape, new.wrong)
        return self._fitted


def _stream(samples: list[HandSample]) -> FingerStream:
    points, rotations = torch.stack([each.points for each in samples]), [each.rotations for each in samples]
    turned = [each for each in rotations if each is not None]
    return FingerStream(
        torch.tensor([each.timestamp for each in samples], dtype=torch.float64),
        points,
        points.isfinite().any(-1).any(-1),
        torch.tensor([each.confidence for each in samples]),
        torch.stack(turned) if len(turned) == len(samples) else None,
    )
