"""Bending ten minutes of path at 30 Hz to camera positions: our second-order solver against Adam, same energy.

The energy is the document's (thesis eq. 5.2, conf/bending/adam.yaml): camera positions, 7 cm off, at every frame; a
path whose heading drifts by 0.6°/√s. Adam takes the best of three learning rates (by its energy after 200
iterations) and stops where its energy is within 0.1 % of ours, which costs it less than to reach ours; where it has
not got there after 2000 iterations, the time until then counts. The benchmark fails when Adam finds less than ours.
value and baseline: ms. ratio = baseline / value, to be at least `goal`. A second figure (no goal) is the document's
run of 1000 iterations, whatever energy it ends with.
"""

import time

import numpy as np
import torch
from hydra.utils import instantiate

from wearcap.cli.conf import compose
from wearcap.optimize.trajectory import BendingProblem, BentPath, bend_adam, bending_problem
from wearcap.optimize.trajectory_banded import bend_banded

RATES, TRIED, LONGEST, WITHIN = (1e-3, 3e-3, 1e-2), 200, 2000, 1.001
FPS = 30


def measure(duration_s: float = 600.0, longest: int = LONGEST, repeats: int = 5) -> list[dict]:
    problem = walk(duration_s)
    bend_banded(problem)  # compiled
    begin = time.perf_counter()
    for _ in range(repeats):
        solved = bend_banded(problem)
    value = 1000 * (time.perf_counter() - begin) / repeats
    ours = least(solved)
    rate = min(RATES, key=lambda rate: least(bend_adam(problem, TRIED, rate)))
    begin = time.perf_counter()
    adam = bend_adam(problem, longest, rate)
    each = 1000 * (time.perf_counter() - begin) / len(adam.history)
    if least(adam) < ours:
        raise SystemExit(f"error: Adam's energy {least(adam):.4f} is below ours {ours:.4f}")
    there = [k for k, entry in enumerate(adam.history) if entry["total"] <= WITHIN * ours]
    took, fixed = there[0] if there else longest, min(1000, longest)
    reached = adam.history[took]["total"]
    ended = min(entry["total"] for entry in adam.history[: fixed + 1])
    return [
        figure("", value, f"energy {ours:.2f} against {reached:.2f} after {took}, rate {rate:g}", each * took, 20.0),
        figure("_document", value, f"energy {ours:.2f} against {ended:.2f} after {fixed}", each * fixed, None),
    ]  # fmt: skip


def figure(which: str, value: float, what: str, baseline: float, goal: float | None) -> dict:
    return {"name": f"trajectory_bending_vs_adam{which}", "value": value, "unit": f"ms ({what} iterations)",
            "baseline": baseline, "ratio": baseline / value, "goal": goal}  # fmt: skip


def least(solved: BentPath) -> float:
    return min(entry["total"] for entry in solved.history)


def walk(duration_s: float, drift: float = 0.01, noise_m: float = 0.07, seed: int = 0) -> BendingProblem:
    """A walk in random curves, at 0 to 1.8 m/s, with its heading drifting, and noisy positions at every frame."""
    rng, count = np.random.default_rng(seed), int(duration_s * FPS)
    settings = instantiate(compose("capture", ["recording=none", "+bending=adam"]).bending).keywords[
        "settings"
    ]

    def slow(seconds: float) -> np.ndarray:
        window = np.hanning(int(seconds * FPS))
        return np.convolve(rng.standard_normal(count - 1), window / np.linalg.norm(window), "same")

    length = np.clip(1.0 + 0.6 * slow(4.0), 0.0, 1.8) / FPS
    heading = (0.4 * slow(2.0)).cumsum() / FPS
    drifted = heading + 0.3 + rng.normal(0, drift / FPS**0.5, count - 1).cumsum()

    def path(angle: np.ndarray) -> np.ndarray:
        step = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        return np.concatenate([np.zeros((1, 2)), step.cumsum(0)])

    timestamps = torch.arange(count, dtype=torch.float64) / FPS
    positions = path(heading) + rng.normal(0, noise_m, (count, 2))
    suit, points = torch.from_numpy(path(drifted)), torch.from_numpy(positions)
    return bending_problem(suit, timestamps, timestamps, points, None, settings)
