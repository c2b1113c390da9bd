"""Quantiles of latencies in bounded memory: a histogram of half milliseconds."""

import math

import numpy as np
from jaxtyping import Float

from wearcap.apps.live.status import Latency

_BIN_MS, _LONGEST_MS = 0.5, 20_000.0


class Latencies:
    """Latencies of poses, as many as there are."""

    def __init__(self) -> None:
        self.count = 0
        self._bins = np.zeros(int(_LONGEST_MS / _BIN_MS) + 1, dtype=np.int64)

    def add(self, seconds: Float[np.ndarray, "pose"]) -> None:
        """Count some latencies (s); negative ones count as 0, those beyond 20 s as 20 s."""
        bins = np.clip(1000.0 * seconds / _BIN_MS, 0, len(self._bins) - 1).astype(np.int64)
        np.add.at(self._bins, bins, 1)
        self.count += len(bins)

    def quantile_ms(self, share: float) -> float:
        """Smallest latency (ms) that a share of the poses does not exceed, rounded up to half a millisecond."""
        if not self.count:
            return math.nan
        reached = np.searchsorted(self._bins.cumsum(), share * self.count)
        return float(_BIN_MS * (reached + 1))

    @property
    def quantiles(self) -> Latency:
        return Latency(*(self.quantile_ms(share) for share in (0.5, 0.95, 0.99)))
