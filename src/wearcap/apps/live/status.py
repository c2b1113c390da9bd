"""State of a running capture, as its page and its report show it, and what a page may ask of the capture."""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from wearcap.geometry.rigid import Rigid

Stage = Literal["waiting", "first minute", "live", "away"]
"""Of a wearer: nothing has come yet; the set-up is being found; poses come; packets have stopped."""
MAX_POINTS = 50_000
"""Most points of the surroundings in a status: the newest."""


class Latency(NamedTuple):
    """Quantiles (ms) of the time from a packet's device time to the pose that leaves; NaN before the first pose."""

    median: float = float("nan")
    p95: float = float("nan")
    p99: float = float("nan")


NO_LATENCY = Latency()
_BIN_MS, _LONGEST_MS = 0.5, 20_000.0


class Latencies:
    """Latencies of poses, as many as there are, in bounded memory: a histogram."""

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


@dataclass(frozen=True, eq=False)
class DeviceStatus:
    """One device of a wearer."""

    name: str
    """Joint, "head", or serial, as packets name it."""
    hz: float
    """Rate of its packets over the last seconds."""
    T_world_device: Rigid | None = None
    """Newest pose in the head's world, R "3 3", t "3" (m); None where there is none. Of a watch, t may be NaN, and until its
    heading is known R is in its own world."""
    last_s_ago: float = float("inf")
    """Time (s) since its newest packet."""
    joint: str | None = None
    """Joint that wears it, once that is known."""

    @property
    def title(self) -> str:
        """How a page names it: by its joint, and by its own name where that is another."""
        title = (self.joint or self.name).replace("_", " ")
        return title if self.joint in (None, self.name) else f"{title} ({self.name})"


@dataclass(frozen=True)
class Counts:
    """What has happened to one wearer's packets and poses so far."""

    frames: int = 0
    """Number of poses."""
    sessions: int = 0
    """How often the capture of this wearer began."""
    dropped: int = 0
    """Number of the head's poses that its session dropped as late, doubled or refused, and of all packets that were left out
    because the capture was behind."""
    late: int = 0
    """Number of packets that came too late to be used."""
    gaps: int = 0
    """Number of gaps in the head's path, those that a capture left while it caught up among them."""
    unknown: int = 0
    """Number of packets of devices that nobody wears."""
    clock_restarts: int = 0
    """How often devices' clocks were set anew."""
    refused: dict[str, int] = field(default_factory=dict)
    """Samples that the sessions refused, by reason."""


@dataclass(frozen=True, eq=False)
class WearerStatus:
    """One wearer."""

    name: str
    """As packets name the wearer; "" where a source serves one person."""
    stage: Stage
    step: str | None = None
    """What to do now, as a sentence, while the first minute is guided."""
    progress: float = 0.0
    """Of the step, 0…1."""
    devices: tuple[DeviceStatus, ...] = ()
    latency: Latency = NO_LATENCY
    counts: Counts = Counts()
    floor_m: float | None = None
    """Floor height (m) in the head's world."""
    points_world: Float[Tensor, "point 3"] | None = None
    """Newest points of the surroundings (m), at most `MAX_POINTS`; the same tensor while nothing new has come."""
    notes: tuple[str, ...] = ()
    """How the set-up was found, and what is wrong with it."""


@dataclass(frozen=True)
class SinkStatus:
    """One sink."""

    name: str
    sent: int = 0
    """Number of frames that have gone where it sends them: of the wearers that it sends, to whoever is connected."""
    dropped: int = 0
    """Number of pieces dropped because it was slow."""
    failed: int = 0
    """Number of pieces that it could not take."""
    last_error: str = ""


@dataclass(frozen=True, eq=False)
class LiveStatus:
    """A running capture at one moment."""

    wearers: tuple[WearerStatus, ...] = ()
    sinks: tuple[SinkStatus, ...] = ()
    recording: str | None = None
    """Where it is being recorded; None: it is not."""
    seconds: float = 0.0
    """Time since it started."""


Ask = Literal["guide", "skip", "redo"]
"""Begin a guided first minute, anew where there was one; go on to its next step, with defaults for this one; begin this step
again."""


@runtime_checkable
class LiveControls(Protocol):
    """What a page asks of the capture; every method returns at once and may be called from any thread."""

    def status(self) -> LiveStatus: ...

    def record(self, on: bool) -> None:
        """Start or stop recording."""

    def ask(self, action: Ask, wearer: str) -> None:
        """Do something about a wearer's first minute."""

    def stop(self) -> None:
        """End the capture."""
