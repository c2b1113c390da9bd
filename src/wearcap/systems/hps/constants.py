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
from wearcap.optimize.hps import HpsData, HpsEnergy, HpsState, Solution, data_values, find_ground, energy_of, state_values


@dataclass(frozen=True)
class ConstantsSettings:
    """Which constants are unknown, their priors, and the sample of frames from which they are estimated."""

    scale: float = 0.02
    """Prior deviation of the bones' scale from 1; 0: the suit's body is taken as it is (thesis)."""
    mount_m: float = 0.015
    """Prior deviation (m) of the camera's position on the head along each axis; 0: it is taken as given (thesis)."""
    stretches: int = 6
    """Number of stretches of frames, evenly over the recording."""
    stretch_s: float = 10.0
    independent_s: float = 1.0
    """Time between frames whose errors are independent: weighs the energy against the priors."""
    evaluations: int = 10
    """Largest number of times that the stretches are solved."""


@dataclass(frozen=True, eq=False)
class Constants:
    """Estimated constants; the defaults change nothing."""

    scale: float = 1.0
    """Scale of the bones."""
    t_mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement (m, head axes) of the camera from its nominal position on the head."""


def with_constants(data: HpsData, constants: Constants) -> HpsData:
    """The same data for bones of another length and a camera that sits elsewhere on the head.

    The root's initial translation follows from the camera's localised position, so it moves with both.
    """
    return replace(
        data,
        patches=data.patches.scaled(constants.scale),
        start=replace(
            data.start,
            t_world_root=_start(data, torch.tensor(constants.scale), torch.tensor(constants.t_mount)),
        ),
    )


def _start(data: HpsData, scale: Tensor, t_mount: Float[Tensor, "3"]) -> Float[Tensor, "time 3"]:
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
    settings: ConstantsSettings,
) -> Constants:
    """Constants at the least sum of energy and priors over a sample of the frames.

    E counts as that of one frame per `independent_s`: its sum is compared with ½ (κ/σ)² of each constant κ. Where no
    frame is localised the priors decide.
    """
    deviations = np.array([settings.scale, *[settings.mount_m] * 3])
    free = deviations > 0
    parts = _sample(data, fps, settings)
    if not free.any() or not parts:
        return Constants()
    count = sum(len(part) for part in parts) / fps / settings.independent_s

    def constants(unknown: np.ndarray) -> Constants:
        value = np.zeros(4)
        value[free] = unknown * deviations[free]
        return Constants(1 + float(value[0]), (float(value[1]), float(value[2]), float(value[3])))

    def least_energy(unknown: np.ndarray) -> tuple[float, np.ndarray]:
        now, total, slope = constants(unknown), 0.0, np.zeros(4)
        for part in parts:
            state = solver(energy, with_constants(part, now)).state
            value, gradient = _energy_and_slope(energy, part, state, now)
            total += value * len(part)
            slope += gradient * len(part)
        share = count / sum(len(part) for part in parts)
        slope = (share * slope * deviations)[free]
        return share * total + 0.5 * float(unknown @ unknown), slope + unknown

    found = scipy.optimize.minimize(
        least_energy,
        np.zeros(int(free.sum())),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-3.0, 3.0)] * int(free.sum()),
        options={"maxfun": settings.evaluations, "ftol": 1e-4},
    )
    return constants(found.x)


def _sample(data: HpsData, fps: float, settings: ConstantsSettings) -> list[HpsData]:
    """Stretches of frames, evenly over the recording, of which most are localised."""
    length = round(settings.stretch_s * fps)
    first = np.linspace(0, max(len(data) - length, 0), settings.stretches).astype(int)
    parts = [data[int(at) : int(at) + length] for at in np.unique(first)]
    return [part for part in parts if (part.hold_confidence > 0).double().mean() > 0.5]


def _energy_and_slope(
    energy: HpsEnergy, data: HpsData, state: HpsState, constants: Constants
) -> tuple[float, np.ndarray]:
    """Energy of a state, and its derivative in the scale and the three components of the mount."""
    now = torch.tensor([constants.scale, *constants.t_mount], dtype=torch.float64, requires_grad=True)
    at = with_constants(data, constants)
    of_state, root = state_values(at, state), state.t_world_root[:, None]
    of_data = data_values(at, find_ground(at, of_state["soles"], energy))
    soles = root + (of_state["soles"] - root) * (now[0] / constants.scale)
    values = of_state | of_data | {"soles": soles, "t_start": _start(data, now[0], now[1:])}
    total = torch.stack(list(energy_of(energy, values).values())).sum()
    (slope,) = torch.autograd.grad(total, now)
    return float(total.detach()), slope.numpy()
