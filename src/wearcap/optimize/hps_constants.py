"""Constants of a recording that HPS estimates with the motion (ours): the bones' scale, and the camera's position on
the head.

A suit's body has the wearer's proportions only roughly, and a mount is seldom measured. Both are seen in how the
localised camera, the suit's pose and the floor disagree. Of each constant, the energy's least value over all motions is
minimised. At such a minimum the derivative of the least energy in a constant is the energy's own, with the motion held
(envelope theorem), so quasi-Newton steps need no derivative of the solver.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.optimize.hps import HpsData, HpsEnergy, Solution, data_values, energy_of, find_ground, state_values

STRETCHES, STRETCH_S = 6, 10.0
"""Number and length of the stretches, evenly over the recording, from which constants are estimated."""
INDEPENDENT_S = 1.0
"""Time between frames whose errors are independent: it weighs the energy against the priors."""
EVALUATIONS = 10
"""Largest number of times that the stretches are solved."""


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
        for part in parts:
            energy_of_part, gradient = _energy_and_slope(energy, part, solver, constants(unknown))
            share = len(part) / fps / INDEPENDENT_S
            value += share * energy_of_part
            slope += share * (deviations * gradient)[free].numpy()
        return value, slope

    count = int(free.sum())
    options = {"maxfun": EVALUATIONS, "ftol": 1e-4}
    found = scipy.optimize.minimize(
        objective, np.zeros(count), jac=True, method="L-BFGS-B", bounds=[(-3.0, 3.0)] * count, options=options
    )
    return Constants.of(constants(found.x))


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
    state = solver(energy, nearer).state
    of_state, root = state_values(nearer, state), state.t_world_root[:, None]
    of_data = data_values(nearer, find_ground(nearer, of_state["soles"], energy))
    soles = root + (of_state["soles"] - root) * (values[0] / constants.scale)
    now = of_state | of_data | {"soles": soles, "t_start": _start(data, values[0], values[1:])}
    total = torch.stack(list(energy_of(energy, now).values())).sum()
    (slope,) = torch.autograd.grad(total, values)
    return float(total.detach()), slope
