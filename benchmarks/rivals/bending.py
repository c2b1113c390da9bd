"""The thesis's solver of iReplica's trajectory correction (§5.4.2): Adam on the energy of eq. 5.2, differentiated by autograd."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.systems.ireplica.trajectory import BendingProblem, BentPath, bent, bent_path, wrapped


def energy_terms(
    problem: BendingProblem, turn: Float64[Tensor, "step"], shift: Float64[Tensor, "2"]
) -> dict[str, Float64[Tensor, ""]]:
    """Terms of eq. 5.2, differentiable in φ (rad) and the first point's shift (m); the path is linear within steps. The
    change dα̂ − dα from step to step (eq. 5.1) is that of φ, with clamped ends also from and to the fixed steps."""
    settings, path = problem.settings, bent(problem, turn, shift)
    at, share = problem.control_step, problem.control_share[:, None]
    offset = torch.lerp(path[at], path[at + 1], share) - problem.control_points
    off = turn[problem.leader]
    change = torch.cat([off[:1], off.diff(), -off[-1:]]) if settings.clamped_ends else off.diff()
    seconds = problem.link_s if settings.clamped_ends else problem.link_s[1:-1]
    return {
        "control": (problem.control_weights * settings.loss(offset)).sum(),
        "bending": settings.rigidity * (wrapped(change) ** 2 / seconds).sum(),
    }


def bend_adam(problem: BendingProblem, iterations: int = 1000, learning_rate: float = 3e-3) -> BentPath:
    """Adam, its learning rate in rad and m. Returns the best state of all iterations."""
    turn = torch.zeros(len(problem.leader), dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(2, dtype=torch.float64, requires_grad=problem.settings.free_start)
    unknowns = [value for value in (turn, shift) if value.requires_grad]
    adam = torch.optim.Adam(unknowns, lr=learning_rate)
    history, least, best = [], math.inf, (turn.detach(), shift.detach())
    for iteration in range(iterations + 1):
        adam.zero_grad()
        terms = energy_terms(problem, turn, shift)
        total = terms["control"] + terms["bending"]
        history.append({name: value.item() for name, value in terms.items()} | {"total": total.item()})
        if history[-1]["total"] < least:
            least, best = history[-1]["total"], (turn.detach().clone(), shift.detach().clone())
        if iteration < iterations:
            total.backward()
            adam.step()
    return bent_path(problem, *best, history, f"{iterations} iterations")
