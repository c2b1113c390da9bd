"""Trajectory correction (thesis eq. 5.1, 5.2): bends a path in the ground plane to control points: the problem.

A suit measures distances well and headings badly: step lengths are kept, headings are unknown. A step is the
displacement from one frame to the next. The unknowns are the turns φ = α̂ − α of the steps, so l̂ = l(0) + Σ R(φ) step,
and E_tr penalises changes of φ. A step of zero length has no heading and takes the turn of the last step that has one
(at the path's beginning: that of the first).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import require_rising
from wearcap.optimize.losses import Loss

STILL_M = 1e-6
"""Steps up to this length have no heading."""


@dataclass(frozen=True)
class Bending:
    """Parameters of eq. 5.2. Raises WearcapError for a rigidity that is not positive."""

    rigidity: float
    """λ: metres of the control term per unit of E_tr (rad²/s), the integral of the squared difference of heading rates."""
    loss: Loss = field(default_factory=lambda: Loss("norm"))
    """Loss of a control point's distance: the thesis's norm; "huber", or "cauchy" for bursts of wrong points (ours)."""
    free_start: bool = False
    """Whether the first point is an unknown too, so that the whole path may shift."""
    clamped_ends: bool = False
    """Whether the steps before and after the path are fixed (φ = 0 there): for a window within a longer path."""

    def __post_init__(self):
        if not (self.rigidity > 0 and math.isfinite(self.rigidity)):
            raise WearcapError(f"a rigidity of {self.rigidity}", expected="a positive number")


@dataclass(frozen=True, eq=False)
class BendingProblem:
    """A validated path as steps, and its control points (float64; m, s, rad)."""

    settings: Bending
    path: Float64[Tensor, "time 2"]
    timestamps: Float64[Tensor, "time"]
    leader: Int64[Tensor, "step"]
    """Index of the step whose turn each step takes: its own where it has a heading."""
    control_step: Int64[Tensor, "control"]
    """Index of the step that contains each control point's time, ascending."""
    control_share: Float64[Tensor, "control"]
    """Position of each control point's time within its step (0…1)."""
    control_points: Float64[Tensor, "control 2"]
    control_weights: Float64[Tensor, "control"]

    @property
    def step(self) -> Float64[Tensor, "step 2"]:
        return self.path.diff(dim=0)

    @property
    def link_s(self) -> Float64[Tensor, "link"]:
        """Time (s) from each step's middle to the next one's; the first and last entry are the end steps' durations."""
        steps = self.timestamps.diff()
        return torch.cat([steps[:1], (steps[:-1] + steps[1:]) / 2, steps[-1:]])


@dataclass(frozen=True, eq=False)
class BentPath:
    """Result of a solver: the path in the plane (m), and the energy by term ("control", "bending", "total")."""

    path: Float64[Tensor, "time 2"]
    turn: Float64[Tensor, "step"]
    """φ = α̂ − α (rad, unwrapped)."""
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry per iteration; the state returned is the best of them."""
    reason: str = ""
    """Why the solver stopped."""

    @property
    def frame_turn(self) -> Float64[Tensor, "time"]:
        """Turn of the body at each frame (rad, about the vertical): mean of the turns of the adjacent steps."""
        before, after = torch.cat([self.turn[:1], self.turn]), torch.cat([self.turn, self.turn[-1:]])
        return (before + after) / 2


Solver = Callable[[BendingProblem], BentPath]


def bend(
    path: Float[Tensor, "time 2"],
    timestamps: Float64[Tensor, "time"],
    control_times: Float64[Tensor, "control"],
    control_points: Float[Tensor, "control 2"],
    weights: Float[Tensor, "control"] | None = None,
    *,
    settings: Bending,
    solver: Solver,
) -> BentPath:
    """Bend a path (m, ground plane) towards control points, keeping its step lengths and, softly, its shape.

    `control_times` may lie between frames and must not descend (several points may share a time). `weights` default to
    one. Raises WearcapError for values that are not finite, times out of order or outside the path, negative weights.
    """
    return solver(bending_problem(path, timestamps, control_times, control_points, weights, settings))


def bending_problem(
    path: Float[Tensor, "time 2"],
    timestamps: Float64[Tensor, "time"],
    control_times: Float64[Tensor, "control"],
    control_points: Float[Tensor, "control 2"],
    weights: Float[Tensor, "control"] | None,
    settings: Bending,
) -> BendingProblem:
    """The problem that `bend` solves. Raises WearcapError as `bend`."""
    require_rising(timestamps)
    weights = torch.ones_like(control_times) if weights is None else weights
    if len(path) < 2:
        raise WearcapError(f"a path of {len(path)} frames cannot be bent", expected="at least two")
    for what, value in (
        ("path", path),
        ("control times", control_times[:, None]),
        ("control points", control_points),
        ("weights", weights[:, None]),
    ):
        bad = ~value.isfinite().all(1)
        if bad.any():
            raise WearcapError(
                f"{what}: entry {int(bad.nonzero()[0])} is not a number",
                expected="finite numbers",
                fix="Leave out frames that were not localised.",
            )
    if (weights < 0).any():
        raise WearcapError("a control point of negative weight", expected="zero or more")
    falls = control_times.diff() < 0
    if falls.any():
        number = int(falls.nonzero()[0]) + 1
        raise WearcapError(
            f"control point {number} ({control_times[number].item():.3f} s) lies before its predecessor",
            expected="control times in order",
            fix="Sort the control points by time.",
        )
    outside = (control_times < timestamps[0]) | (control_times > timestamps[-1])
    if outside.any():
        raise WearcapError(
            f"{int(outside.sum())} of {len(control_times)} control points, first at {control_times[outside][0].item():.3f} s, lie outside the path",
            expected=f"times from {timestamps[0].item():.3f} s to {timestamps[-1].item():.3f} s",
        )
    path = path.double()
    moves = path.diff(dim=0).norm(dim=1) > STILL_M
    leader = torch.where(moves, torch.arange(len(moves)), int(moves.long().argmax())).cummax(0).values
    at = (torch.searchsorted(timestamps, control_times.contiguous(), right=True) - 1).clamp(max=len(path) - 2)
    share = (control_times - timestamps[at]) / (timestamps[at + 1] - timestamps[at])
    return BendingProblem(settings, path, timestamps, leader, at, share, control_points.double(), weights.double())


def wrapped(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angle within ±π (rad); its derivative is one."""
    return angle - (2 * math.pi) * (angle.detach() / (2 * math.pi)).round()


def bent(
    problem: BendingProblem, turn: Float64[Tensor, "step"], shift: Float64[Tensor, "2"]
) -> Float64[Tensor, "time 2"]:
    """The bent path l̂: steps rotated by φ and accumulated from the first point, which moves by `shift` (m)."""
    turn, step = turn[problem.leader], problem.step
    cosine, sine = turn.cos(), turn.sin()
    x, y = step.unbind(-1)
    turned = torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
    start = problem.path[:1] + shift
    return torch.cat([start, start + turned.cumsum(0)])


def bent_path(
    problem: BendingProblem,
    turn: Float64[Tensor, "step"],
    shift: Float64[Tensor, "2"],
    history: list[dict[str, float]],
    reason: str,
) -> BentPath:
    """Build a solver's result from its unknowns."""
    turn = turn[problem.leader]
    turn = torch.cat([wrapped(turn[:1]), wrapped(turn.diff())]).cumsum(0)
    return BentPath(bent(problem, turn, shift), turn, history, reason)
