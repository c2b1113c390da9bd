"""Bending exactly through a few points: the limit of zero rigidity, in closed form for small turns.

For small turns, points of the path are linear in them, and the least bending that meets the control points is a linear
problem: one tridiagonal system with a right-hand side per coordinate of the control points.
"""

import numpy as np
import torch
from scipy.linalg import solveh_banded

from wearcap.errors import WearcapError
from wearcap.optimize.trajectory import BendingProblem, BentPath, bent, bent_path, control_offset, energy_terms


def bend_closed(problem: BendingProblem, tolerance_m: float = 1e-6, rounds: int = 20) -> BentPath:
    """Minimise ∫ (dα̂/dτ − dα/dτ)² dτ among all paths through the control points; weights and rigidity have no effect.

    The first round is the closed form for small turns; further rounds linearise again until the points are met and the
    path no longer changes, both within `tolerance_m`. Raises WearcapError for settings other than `clamped_ends`, a
    fixed start and the norm "square", and where the turns would not be small.
    """
    settings = problem.settings
    if not settings.clamped_ends or settings.free_start or settings.norm != "square":
        raise WearcapError(
            "bending in closed form needs fixed ends", expected="clamped_ends=True, free_start=False, norm=square"
        )
    leaders = torch.unique(problem.leader)
    stiffness = _stiffness(problem, leaders)
    turn, shift = torch.zeros(len(problem.leader), dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    history, reason = [_entry(problem, turn)], ""
    path = problem.path
    for _ in range(rounds):
        forms = _point_forms(problem, path)[:, leaders]
        soft = solveh_banded(stiffness, forms.T)
        wanted = forms @ turn[leaders].numpy() - control_offset(path, problem).flatten().numpy()
        pulls = np.linalg.lstsq(forms @ soft, wanted, rcond=1e-10)[0]
        turn[leaders] = torch.from_numpy(soft @ pulls)
        turn, before = turn[problem.leader], path
        path = bent(problem, turn, shift)
        history.append(_entry(problem, turn))
        if max((path - before).abs().max(), control_offset(path, problem).abs().max()) < tolerance_m:
            reason = "points met"
            break
    if not reason:
        raise WearcapError(
            "the control points need large turns, or are out of reach of steps of these lengths",
            expected="points near the path, beside it",
            fix="Use the solver bend_banded.",
        )
    return bent_path(problem, turn, shift, history, reason)


def _entry(problem: BendingProblem, turn: torch.Tensor) -> dict[str, float]:
    terms = energy_terms(problem, turn, torch.zeros(2, dtype=torch.float64))
    named = {name: value.item() for name, value in terms.items()}
    return named | {"total": sum(named.values())}


def _stiffness(problem: BendingProblem, leaders: torch.Tensor) -> np.ndarray:
    """Hessian of E_tr in the turns of moving steps: upper band, for solveh_banded."""
    seconds = problem.link_s.numpy()
    inner = 1.0 / seconds[leaders.numpy()[1:]]
    before, after = np.r_[1.0 / seconds[0], inner], np.r_[inner, 1.0 / seconds[-1]]
    return 2 * np.stack([np.r_[0.0, -inner], before + after])


def _point_forms(problem: BendingProblem, path: torch.Tensor) -> np.ndarray:
    """Jacobian (2 control, step) of the path's points at the control times in the turn of each leading step."""
    step = path.diff(dim=0)
    sideways = torch.stack([-step[:, 1], step[:, 0]])
    number, at = torch.arange(len(step)), problem.control_step[:, None]
    gone = (number < at).double() + (number == at) * problem.control_share[:, None]
    forms = (gone[:, None] * sideways).flatten(0, 1)
    return torch.zeros_like(forms).index_add_(1, problem.leader, forms).numpy()
