"""Contact-based correction of the root's path, as a smooth offset that brings hands onto touched objects (thesis
§5.3.1).

The thesis bends the path again, with the touched point as the only control point (`bend_contacts`). Bending keeps step
lengths, so it cannot move a wearer who walks straight at an object towards it. Ours (`offset_for`) adds an offset that
the contacts prescribe and that is otherwise as smooth and small as possible: one pentadiagonal linear system per
recording.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.linalg import solveh_banded
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import require_rising
from wearcap.systems.ireplica.trajectory import BentPath

SETTLED = 2.0717
"""x with exp(−x) (cos x + sin x) = 0.05: decay of the offset after a contact, as a function of rate · time."""
KEEP = 10.0
"""Weight of a bent window's end relative to the contact's (1): a point out of reach does not move what follows."""


@dataclass(frozen=True)
class OffsetSettings:
    """Parameters of min Σ hold · weight ‖δ − target‖² + ∫ a ‖δ''‖² + b ‖δ‖² dt (b = 1 outside of contacts, else 0)."""

    transition_s: float = 1.5
    """Time (s) before and after a contact at which the offset has decayed to 5 % (it overshoots zero by 4 %); it
    determines a. An offset of D m adds a speed of up to 1.34 D / transition_s to the root, and so to standing feet."""
    hold: float = 1e3
    """Weight of a contact frame's target. A single target frame is met to 0.2 % (for transitions of 1 to 2 s); with
    targets in all frames, changes faster than about 50 ms are smoothed."""

    def __post_init__(self):
        if not (self.transition_s > 0 and self.hold > 0):
            what = f"a transition of {self.transition_s} s, a hold of {self.hold}"
            raise WearcapError(what, expected="positive numbers")

    @property
    def stiffness(self) -> float:
        """Weight a of the second derivative (s⁴)."""
        return (self.transition_s / SETTLED) ** 4 / 4


def offset_for(
    targets: Float[Tensor, "time axis"],
    weights: Float[Tensor, "time"],
    timestamps: Float64[Tensor, "time"],
    settings: OffsetSettings = OffsetSettings(),
) -> Float64[Tensor, "time axis"]:
    """Offset (m) of the whole recording: close to weighted targets, smooth, and decaying to zero elsewhere.

    Weights are 0 outside of contacts and about 1 within: in the first frame alone (the thesis's p_c), or in all frames
    (a hand on a hinge's arc). Solved exactly, in time linear in the recording's length. Raises WearcapError for
    negative weights, targets of positive weight that are not finite, timestamps that do not rise.
    """
    require_rising(timestamps)
    if not (weights >= 0).all():
        raise WearcapError("a target of negative weight", expected="zero or more")
    bad = (weights > 0) & ~targets.isfinite().all(1)
    if bad.any():
        what = f"the target of frame {int(bad.nonzero()[0])} is not a number"
        raise WearcapError(what, expected="finite metres where the weight is above zero")
    pull = settings.hold * weights.double().numpy()
    wanted = torch.where(weights[:, None] > 0, targets, 0.0).double().numpy()
    if len(targets) < 3:
        return torch.from_numpy(wanted)
    times = timestamps.numpy()
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    around = (before + after) / 2
    # second differences of neighbours at uneven times: left · δ₋ + middle · δ + right · δ₊
    left, right = 1 / (before * around), 1 / (after * around)
    middle, weight = -left - right, settings.stiffness * around
    bands = np.zeros((3, len(times)))  # upper bands of the pentadiagonal system
    bands[2] = pull + np.where(pull > 0, 0.0, np.gradient(times))
    for shift, coefficient in enumerate((left, middle, right)):
        bands[2, shift : shift + len(around)] += weight * coefficient**2
    bands[1, 1:-1] += weight * left * middle
    bands[1, 2:] += weight * middle * right
    bands[0, 2:] += weight * left * right
    return torch.from_numpy(solveh_banded(bands, pull[:, None] * wanted))


def bend_contacts(
    targets: Float[Tensor, "time 2"],
    weights: Float[Tensor, "time"],
    timestamps: Float64[Tensor, "time"],
    path: Float[Tensor, "time 2"],
    *,
    bend: Callable[..., BentPath],
    transition_s: float = 3.0,
) -> Float64[Tensor, "time 2"]:
    """The thesis's correction as an offset (m): for each contact the path is bent to its first frame's target.

    `bend` is `trajectory.bend` with its settings (`clamped_ends`) and solver. A contact is a run of frames of positive
    weight. The path is bent from `transition_s` before it to `transition_s` after it, or to the neighbouring contact's
    start. The rest is unchanged, even if the bent piece does not quite end on it because the target is out of reach.
    """
    require_rising(timestamps)
    touches = torch.cat([weights.new_zeros(1), (weights > 0).to(weights), weights.new_zeros(1)]).diff()
    starts, stops = (touches > 0).nonzero()[:, 0].tolist(), (touches < 0).nonzero()[:, 0].tolist()
    new, last = path.double().clone(), len(path) - 1
    limits = [0, *starts, last]
    for (earliest, start), latest, stop in zip(pairwise(limits), limits[2:], stops):
        first = max(int(torch.searchsorted(timestamps, timestamps[start] - transition_s)), earliest)
        final = min(int(torch.searchsorted(timestamps, timestamps[stop - 1] + transition_s)), latest)
        if final <= first:
            continue
        window = slice(first, final + 1)
        points = torch.stack([path[start].double() + targets[start], new[final]])
        times = timestamps[[start, final]]
        piece = bend(new[window], timestamps[window], times, points, torch.tensor([1.0, KEEP])).path
        gone = (timestamps[window] - times[0]).clamp(min=0) / (times[1] - times[0]).clamp(min=1e-9)
        new[window] = piece + gone[:, None] * (new[final] - piece[-1])
    return new - path
