"""What a solver returns: where it ended, why, and every step on the way."""

from dataclasses import dataclass, field

from wearcap.optimize.hps import HpsState


@dataclass(frozen=True, eq=False)
class Solution:
    """The state, and the energy by term after every iteration."""

    state: HpsState
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry per iteration (over windows: their mean), with "total"."""
    reason: str = ""
    """Why it stopped."""
