"""Second-order solver of the bending energy (ours), in time linear in the path's length.

The initial path is the unique minimum of a convex relaxation in which steps may also stretch, so no initial guess is
needed. Gauss-Newton steps follow, each one backward and one forward pass (`trajectory_kernels`). The forward pass
feeds the current position back into the turns, so errors do not accumulate over paths of kilometres.
"""

import numpy as np
import torch

from wearcap.optimize.costs import LOSSES
from wearcap.optimize.trajectory import NORMS, BendingProblem, BentPath, bent_path
from wearcap.optimize.trajectory_kernels import control_weights, energy, stretch_freely, value_pass, walk

RELAXED_PASSES = 3
RELAXED_M, RELAXED_TURN = 0.3, 0.02
"""Smoothing of distances (m) and of turns from step to step (rad) in the relaxation."""


def bend_banded(
    problem: BendingProblem,
    iterations: int = 60,
    smooth_start: float = 0.1,
    smooth_end: float = 1e-5,
    tolerance: float = 1e-6,
) -> BentPath:
    """Minimise eq. 5.2 by iteratively reweighted least squares with a decreasing smoothing of norms (m, rad).

    Stops when the relative decrease of the energy is below `tolerance` and the smoothing has reached its end.
    """
    path = _Path(problem)
    path.begin()
    smooth = smooth_start
    history, reason = [path.terms(0.0)], "all iterations done"
    best, least = path.state(), history[0]["total"]
    damping = 0.0
    for _ in range(iterations):
        before = path.terms(smooth)["total"]
        fell, damping = path.improve(smooth, damping, before)
        history.append(path.terms(0.0))
        if history[-1]["total"] < least:
            best, least = path.state(), history[-1]["total"]
        if fell <= (tolerance if smooth == smooth_end else 1e-2) * before:
            if smooth == smooth_end:
                reason = "converged"
                break
            smooth = max(smooth / 10, smooth_end)
    return bent_path(problem, *best, history, reason)


class _Path:
    """Arrays of a path during the optimisation, relative to its first point."""

    def __init__(self, problem: BendingProblem):
        settings, steps = problem.settings, len(problem.leader)
        self.free = settings.free_start
        self.step = np.ascontiguousarray(problem.step.numpy())
        seconds = problem.link_s.numpy() if settings.norm == "square" else np.ones(steps + 1)
        ends = settings.rigidity * settings.clamped_ends / seconds[[0, -1]]
        leads = problem.leader.numpy() == np.arange(steps)
        self.link = np.where(leads, settings.rigidity / seconds[:-1], np.inf)
        self.link[1 : problem.leader[0].item() + 1] = np.inf
        self.link[0], self.last_link = ends
        self.controls = (
            np.searchsorted(problem.control_step.numpy(), np.arange(steps + 1)),
            problem.control_share.numpy(),
            np.ascontiguousarray((problem.control_points - problem.path[0]).numpy()),
            problem.control_weights.numpy(),
        )
        loss = settings.loss
        self.kinds = (NORMS.index(settings.norm), LOSSES.index(loss.kind), float(loss.delta))
        self.turn, self.place = np.zeros(steps), (problem.path - problem.path[0]).numpy().copy()
        self.new_turn, self.new_place = np.empty_like(self.turn), np.empty_like(self.place)
        self.gains = np.empty((steps, 4))

    def state(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The turns φ (rad) and the shift of the first point (m)."""
        return torch.from_numpy(self.turn.copy()), torch.from_numpy(self.place[0].copy())

    def terms(self, smooth: float, turn: np.ndarray | None = None, place: np.ndarray | None = None) -> dict:
        """Energy by term of a path (default: the current one), with norms smoothed by `smooth`."""
        turn, place = self.turn if turn is None else turn, self.place if place is None else place
        control, bending = energy(turn, place, self.link, self.last_link, *self.controls, self.kinds, smooth)
        return {"control": control, "bending": bending, "total": control + bending}

    def begin(self) -> None:
        """Start from the reweighted relaxation, unless the original path has less energy."""
        first, share, target, weight = self.controls
        complex_target = target[:, 0] + 1j * target[:, 1]
        step = self.step[:, 0] + 1j * self.step[:, 1]
        soft = 1.0 if self.kinds[0] == NORMS.index("square") else 0.5 / RELAXED_TURN
        place, z = np.zeros(len(step) + 1, dtype=complex), np.empty(len(step), dtype=complex)
        at = np.repeat(np.arange(len(step)), np.diff(first))
        distance = np.zeros(len(weight))
        for _ in range(RELAXED_PASSES):
            half = 0.5 * weight * control_weights(distance, *self.kinds[1:], RELAXED_M)
            stretch_freely(
                step, soft * self.link, soft * self.last_link, first, share, complex_target, half, self.free, place, z
            )
            distance = abs(place[at] + share * (place[at + 1] - place[at]) - complex_target)
        self.gains[:] = 0.0
        turn = np.angle(z * np.conj(np.concatenate([z[:1], z[:-1]]))).cumsum() + np.angle(z[0])
        shift = np.array([place[0].real, place[0].imag])
        walk(turn, self.place, self.step, self.gains, 0.0, shift, self.new_turn, self.new_place)
        if self.terms(0.0, self.new_turn, self.new_place)["total"] < self.terms(0.0)["total"]:
            self._take()

    def improve(self, smooth: float, damping: float, before: float) -> tuple[float, float]:
        """One Gauss-Newton step; returns the decrease of the smoothed energy, and the damping for the next step."""
        for _ in range(8):
            xx, xy, yy, x, y = value_pass(
                self.turn,
                self.place,
                self.link,
                self.last_link,
                *self.controls,
                self.kinds,
                smooth,
                damping,
                self.gains,
            )
            shift = np.zeros(2)
            if self.free:
                ridge = 1e-9 * (xx + yy) + 1e-12
                shift = -np.linalg.solve([[xx + ridge, xy], [xy, yy + ridge]], [x, y])
            for share in (1.0, 0.5, 0.25):
                there = self.new_turn, self.new_place
                walk(self.turn, self.place, self.step, self.gains, share, share * shift, *there)
                after = self.terms(smooth, *there)["total"]
                if after < before:
                    self._take()
                    return before - after, damping / 10 if damping > 1e-6 else 0.0
            damping = max(10 * damping, 1e-4)
        return 0.0, 0.0

    def _take(self) -> None:
        self.turn, self.new_turn = self.new_turn, self.turn
        self.place, self.new_place = self.new_place, self.place
