"""Editing a minute of motion by wrists in the head camera's picture: our solver against Adam at its best, equal energy.

Same manifold, windows and energy (MocapEvery eq. 5): a swinging walk at 30 Hz whose right arm is 15° off, and its right
wrist as a detector would find it. All windows of the recording are one batch on both sides, and both evaluate the same
function. Adam has the best of 15 schedules (rates 1e-3 to 1e-1, constant or with a cosine decay to zero over 60 or 150
steps; swept on six seconds) within 300 steps, and stops when its energy is within 0.1 % of the target. Both are in single precision, the
network's.

`latent_optimisation_vs_best_adam`: the target is the energy of our configured solver. `…_lowest`: the target is the
lowest energy of all of Adam's runs, and ours has as many steps as it needs, up to Adam's. value and baseline: seconds,
medians of runs in turns. ratio = baseline / value, to be at least `goal`. Where one side never reaches the target, the
unit says so, and its time is that of its whole budget: a lower bound of the time for it.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.speed.adam import WITHIN, Run, Schedule, compared, least, reach
from benchmarks.speed.planted import swinging
from wearcap.cli.conf import compose
from wearcap.geometry import rotation
from wearcap.models.checkpoint import load_trained
from wearcap.recording import Motion, Recording
from wearcap.systems.mocap_every import energy
from wearcap.systems.mocap_every.energy import LatentSolver
from wearcap.systems.mocap_every.visual_cues import VisualCues
from wearsim.sensors.keypoints import action_camera, camera_path, seen_joints

NAME = "motion_manifold"
OFF_DEG = 15.0
RATES, DECAYS = (1e-3, 1e-2, 3e-2, 5e-2, 1e-1), (None, 60, 150)
"""Learning rates, and steps over which they decay; None: a constant rate."""
BUDGET, SWEPT_S = 300, 6.0


class Problem(NamedTuple):
    """What the editor asks of a solver: where the latents of all windows start, and their energy by term."""

    start: Tensor
    terms: Callable[[Tensor], dict[str, Tensor]]


def measure(duration_s: float = 60.0, rates=RATES, decays=DECAYS, budget: int = BUDGET, repeats: int = 3) -> list[dict]:
    solver = instantiate(compose("capture", ["pipeline=mocap_every_cues", "recording=none"]).pipeline.cues.solver)
    problem, short = posed(duration_s), posed(SWEPT_S)
    swept = ours(short, solver).energy
    runs = {s: adam(short, s, budget) for s in (Schedule(rate, decay) for rate in rates for decay in decays)}
    best = min(runs, key=lambda schedule: reach(runs[schedule], swept))
    lowest = min(runs, key=lambda schedule: least(runs[schedule]))
    target, depth = ours(problem, solver).energy, least(adam(problem, lowest, budget))
    figures = []
    for name, goal_energy, our_solver, schedule, goal in (
        ("", target, solver, best, 3.0),
        ("_lowest", depth, replace(solver, steps=budget), lowest, None),
    ):
        pairs = [
            (ours(problem, our_solver, goal_energy), adam(problem, schedule, budget, goal_energy)[-1])
            for _ in range(repeats)
        ]
        figures.append(compared(f"latent_optimisation_vs_best_adam{name}", pairs, goal_energy, schedule, goal))
    return figures


def posed(duration_s: float) -> Problem:
    """The editor's problem, with all windows of the recording in one batch."""
    motion, recording = _seen(duration_s)
    problems = []

    def keep(start: Tensor, terms: Callable[[Tensor], dict[str, Tensor]], _: LatentSolver) -> energy.LatentSolution:
        problems.append(Problem(start, terms))
        return energy.LatentSolution(start)

    with patch.object(energy, "solve_latent", keep):
        VisualCues(load_trained(NAME)[0].net, batch=10**6).edit(motion, recording, motion.joint("head"))
    (problem,) = problems
    return problem


def ours(problem: Problem, solver: LatentSolver, target: float = 0.0) -> Run:
    """Our solver, cut at the evaluation in which it reaches a target."""
    steps = solver.steps
    if target:
        totals = [entry["total"] for entry in energy.solve_latent(*problem, solver).history]
        steps = next((k + 1 for k, total in enumerate(totals) if total <= target * WITHIN), steps)
    begin = time.perf_counter()
    history = energy.solve_latent(*problem, replace(solver, steps=steps)).history
    return Run(time.perf_counter() - begin, history[-1]["total"], len(history))


def adam(problem: Problem, schedule: Schedule, budget: int, target: float = 0.0) -> list[Run]:
    """Adam until its energy is near `target` or the budget is spent: the state at each evaluation."""
    latent = problem.start.clone().requires_grad_()
    optimizer, found = torch.optim.Adam([latent], lr=schedule.rate), []
    begin = time.perf_counter()
    for step in range((schedule.decay or budget) + 1):
        total = torch.stack(list(problem.terms(latent).values())).sum()
        found.append(Run(time.perf_counter() - begin, total.item(), step + 1))
        if found[-1].energy <= target * WITHIN:
            break
        optimizer.param_groups[0]["lr"] = schedule.at(step)
        (latent.grad,) = torch.autograd.grad(total, latent)
        optimizer.step()
    return found


def _seen(duration_s: float) -> tuple[Motion, Recording]:
    """A motion with a wrong right arm, and the recording that saw where its wrist was."""
    recording = swinging("walk", duration_s, 0, fps=30.0)
    truth, head = recording.motion, recording.head
    assert truth is not None
    assert head is not None
    camera = action_camera(head.timestamps)
    cues = seen_joints(
        truth, camera_path(truth, camera), camera.camera, ["right_wrist"], 4.0, 0.1, np.random.default_rng(0)
    )
    R = truth.R_parent_joint.clone()
    elbow, shoulder = truth.skeleton.indices("right_elbow", "right_shoulder")
    for joint in (elbow, shoulder):
        R[:, joint] = R[:, joint] @ rotation.about_axis("z", torch.tensor(math.radians(OFF_DEG)))
    wrong = replace(truth, R_parent_joint=R, contact_prob=torch.zeros(len(truth), 4))
    return wrong, replace(recording, camera=camera, cues=cues)
