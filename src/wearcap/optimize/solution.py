"""The result of an HPS solver."""

from dataclasses import dataclass, field

from wearcap.optimize.hps import HpsState


@dataclass(frozen=True, eq=False)
class Solution:
    """Final state, energy history and stopping reason."""

    state: HpsState
    history: list[dict[str, float]] = field(default_factory=list)
    """Energy by term and in "total", one entry per iteration (mean over windows or stretches)."""
    reason: str = ""
    """Why the solver stopped."""
