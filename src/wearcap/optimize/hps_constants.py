"""Constants of a recording that HPS estimates with the motion (ours): the bones' scale, and the camera's position on
the head.

A suit's body has the wearer's proportions only roughly, and a mount is seldom measured. Both are seen in how the
localised camera, the suit's pose and the floor disagree. Of each constant, the energy's least value over all motions is
minimised. At such a minimum the derivative of the least energy in a constant is the energy's own, with the motion held
(envelope theorem), so quasi-Newton steps need no derivative of the solver.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.optimize.hps import HpsData, HpsEnergy, Solution, data_values, energy_of, find_ground, state_values

JOBS = 2
"""Stretches that are solved at a time."""
STRETCHES, STRETCH_S = 6, 10.0
"""Number and length of the stretches, evenly over the recording, from which constants are estimated."""
INDEPENDENT_S = 1.0
"""Time between frames whose errors are independent: it weighs the energy against the priors."""
EVALUATIONS, LEAST_STEP = 8, 0.03
"""Largest number of times that the stretches are solved, and the step (in prior deviations) below which it ends."""


@dataclass(frozen=True)
class ConstantsPrior:
    """Prior deviations of the constants from their nominal values; 0: a constant is nominal (thesis)."""

    scale: float
    """Deviation of the bones' scale from 1."""
    mount_m: float
    """Deviation (m) of the camera's position on the head along each axis."""


@dataclass(frozen=True, eq=False)
class Constants:
    """Values of the constants."""

    scale: float
    """Scale of the bones."""
    t_mount: Float[Tensor, "3"]
    """Displacement (m, head axes) of the camera from its nominal position on the head."""

    @classmethod
    def of(cls, values: Float[Tensor, "4"]) -> "Constants":
        """Constants of the scale and the displacement's components."""
        return cls(float(values[0]), values[1:])


def with_constants(data: HpsData, constants: Constants) -> HpsData:
    """The same data for bones of another length and a camera that sits elsewhere on the head.

    The root's initial translation follows from the camera's localised position, so it moves with both.
    """
    start = replace(data.start, t_world_root=_start(data, torch.tensor(constants.scale), constants.t_mount))
    return replace(data, patches=data.patches.scaled(constants.scale), start=start)


def _start(data: HpsData, scale: Float[Tensor, ""], t_mount: Float[Tensor, "3"]) -> Float[Tensor, "time 3"]:
    """Translations of the root at which the worn camera is where it was before."""
    start, skeleton = data.start, data.patches.body.skeleton
    head = forward_kinematics(skeleton, start.R_parent_joint, start.t_world_root)[:, skeleton.index("head")]
    reach = head.t - start.t_world_root
    return start.t_world_root - (scale.to(reach) - 1) * reach - head.R @ t_mount.to(reach)


def estimate_constants(
    energy: HpsEnergy,
    data: HpsData,
    solver: Callable[[HpsEnergy, HpsData], Solution],
    fps: float,
    prior: ConstantsPrior,
) -> Constants:
    """Constants at the least sum of energy and priors over a sample of the frames.

    The energy counts once per `INDEPENDENT_S`, and ½ (κ/σ)² is added for each constant κ, in units of its deviation σ.
    Constants stay nominal where too little is localised.
    """
    deviations = torch.tensor([prior.scale, *[prior.mount_m] * 3], dtype=torch.float64)
    nominal = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    parts = _sample(data, fps)
    if not deviations.any() or not parts:
        return Constants.of(nominal)
    free = deviations > 0

    def constants(unknown: np.ndarray) -> Float[Tensor, "4"]:
        values = nominal.clone()
        values[free] += deviations[free] * torch.from_numpy(unknown)
        return values

    def objective(unknown: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = 0.5 * float(unknown @ unknown), unknown.copy()
        with ThreadPoolExecutor(JOBS) as pool:
            found = list(pool.map(lambda part: _energy_and_slope(energy, part, solver, constants(unknown)), parts))
        for part, (energy_of_part, gradient) in zip(parts, found):
            share = len(part) / fps / INDEPENDENT_S
            value += share * energy_of_part
            slope += share * (deviations * gradient)[free].numpy()
        return value, slope

    return Constants.of(constants(_least(objective, int(free.sum()))))


def _least(objective: Callable[[np.ndarray], tuple[float, np.ndarray]], count: int) -> np.ndarray:
    """Where a function with a prior of deviation 1 in each unknown is least: quasi-Newton steps (BFGS), from 0.

    There is no line search, which would need many evaluations where the value is known to a few digits only. Steps are
    at most one deviation long, and half as long after one that led upwards.
    """
    place, inverse, reach = np.zeros(count), np.eye(count) / 10, 1.0
    value, slope = objective(place)
    best = value, place
    for _ in range(EVALUATIONS - 1):
        step = -inverse @ slope
        step *= min(1.0, reach / max(float(np.linalg.norm(step)), 1e-12))
        if np.linalg.norm(step) < LEAST_STEP:
            break
        place = np.clip(place + step, -3.0, 3.0)
        before, (value, new) = value, objective(place)
        change, slope = new - slope, new
        curvature = float(step @ change)
        if curvature > 1e-9:
            left = np.eye(count) - np.outer(step, change) / curvature
            inverse = left @ inverse @ left.T + np.outer(step, step) / curvature
        reach = reach if value <= before else reach / 2
        best = min(best, (value, place), key=lambda found: found[0])
    return best[1]


def _sample(data: HpsData, fps: float) -> list[HpsData]:
    """Stretches of frames, evenly over the recording, of which most are localised."""
    length = round(STRETCH_S * fps)
    first = np.unique(np.linspace(0, max(len(data) - length, 0), STRETCHES).astype(int)).tolist()
    parts = [data[at : at + length] for at in first]
    return [part for part in parts if (part.hold_confidence > 0).double().mean() > 0.5]


def _energy_and_slope(
    energy: HpsEnergy, data: HpsData, solver: Callable[[HpsEnergy, HpsData], Solution], values: Float[Tensor, "4"]
) -> tuple[float, Float[Tensor, "4"]]:
    """Least energy over the motions at given constants, and its derivative in them."""
    values = values.requires_grad_()
    constants = Constants.of(values.detach())
    nearer = with_constants(data, constants)
    solution = solver(energy, nearer)
    of_state, root = state_values(nearer, solution.state), solution.state.t_world_root[:, None]
    of_data = data_values(nearer, find_ground(nearer, of_state["soles"], energy))
    soles = root + (of_state["soles"] - root) * (values[0] / constants.scale)
    now = of_state | of_data | {"soles": soles, "t_start": _start(data, values[0], values[1:])}
    touched = {name for value in ("soles", "t_start") for name in energy.reading(value)}
    terms = replace(energy, weights={name: weight for name, weight in energy.weights.items() if name in touched})
    total = torch.stack(list(energy_of(terms, now).values())).sum()
    (slope,) = torch.autograd.grad(total, values)
    return min(entry["total"] for entry in solution.history), slope
