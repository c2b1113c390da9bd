"""Constants of a recording that HPS estimates with the motion (ours): the bones' scale, the legs' length, the camera's
position on the head, and constant errors of the suit's segments.

A suit's body has the wearer's proportions only roughly, its sensors turn on the segments, and a mount is seldom measured.
All are seen in how the localised camera, the suit's pose and the floor disagree. Of each constant, the energy's least
value over all motions is minimised. At such a minimum the derivative of the least energy in a constant is the energy's
own, with the motion held (envelope theorem), so quasi-Newton steps need no derivative of the solver.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.geometry import rotation
from wearcap.systems.hps.energy import (
    HpsData,
    HpsEnergy,
    HpsState,
    Solution,
    data_values,
    energy_of,
    find_ground,
    state_values,
)

JOBS = 2
"""Stretches that are solved at a time."""
STRETCHES, STRETCH_S = 6, 10.0
"""Number and length of the stretches, evenly over the recording, from which constants are estimated."""
INDEPENDENT_S = 1.0
"""Time between frames whose errors are independent: it weighs the energy against the priors."""
EVALUATIONS, LEAST_STEP = 8, 0.03
"""Largest number of times that the stretches are solved, and the step (in prior deviations) below which it ends."""
_TOUCHED = ("soles", "t_start", "theta_imu", "theta_legs_imu", "R_root_start")
"""Values of the energy that depend on the constants while the motion is held."""


@dataclass(frozen=True)
class ConstantsPrior:
    """Prior deviations of the constants from their nominal values; 0: a constant is nominal (thesis)."""

    scale: float
    """Deviation of the bones' scale from 1."""
    mount_m: float
    """Deviation (m) of the camera's position on the head along each axis."""
    height_m: float
    """Deviation (m) of the legs' length, so of the hips' height above the soles, apart from `scale`. The height of the
    suit's root needs no constant: the localised camera alone says how high the root is."""
    segments_deg: float
    """Deviation (°), about each axis, of the orientations that the suit measures of `segments`."""


@dataclass(frozen=True, eq=False)
class Constants:
    """Values of the constants."""

    scale: float
    """Scale of the bones."""
    t_mount: Float[Tensor, "3"]
    """Displacement (m, head axes) of the camera from its nominal position on the head."""
    height_m: float
    """Length (m, at scale 1) by which the legs are longer than the suit's from hip to ankle."""
    turns: Float[Tensor, "segment 3"]
    """Rotation vectors w (rad, segment axes) that correct the orientations of `segments`: R_world_joint exp(w)."""

    @classmethod
    def of(cls, values: Float[Tensor, "constant"]) -> "Constants":
        """Constants of a vector: the scale, the displacement, the height, and the rotation vectors."""
        return cls(float(values[0]), values[1:4], float(values[4]), values[5:].unflatten(0, (-1, 3)))

    def skeleton(self, suit: Skeleton) -> Skeleton:
        """The suit's skeleton with bones of these lengths."""
        return replace(suit, t_parent_joint=self._offsets(suit)).scaled(self.scale)

    def body(self, suit: BodyModel) -> BodyModel:
        """The suit's body with bones of these lengths."""
        return suit.with_offsets(self._offsets(suit.skeleton)).scaled(self.scale)

    def _offsets(self, suit: Skeleton) -> Float[Tensor, "joint 3"]:
        offsets = suit.t_parent_joint.clone()
        for _, *bones in _legs(suit):
            offsets[bones] *= 1 + self.height_m / _length(suit, bones)
        return offsets


def segments(skeleton: Skeleton) -> list[int]:
    """Joints of the segments that connect head and soles: pelvis, spine and neck, thighs, shanks and feet."""
    trunk = skeleton.ancestors(skeleton.index("head"))[:0:-1]
    return [*trunk, *_legs(skeleton)[0], *_legs(skeleton)[1]]


def _legs(skeleton: Skeleton) -> list[list[int]]:
    """Joints of the left and the right leg, from hip to ankle."""
    return [skeleton.ancestors(skeleton.index(f"{side}_ankle"))[-2::-1] for side in ("left", "right")]


def _length(skeleton: Skeleton, bones: list[int]) -> float:
    return float(skeleton.t_parent_joint[bones].norm(dim=1).sum())


def with_constants(data: HpsData, constants: Constants) -> HpsData:
    """The same data for bones of another length, a suit that measures other orientations, and a camera that sits elsewhere
    on the head.

    The root's initial translation follows from the camera's localised position, so it moves with all of them.
    """
    start = _start(data, torch.tensor(constants.scale), constants.t_mount, constants.turns)
    return replace(data, patches=replace(data.patches, body=constants.body(data.patches.body)), start=start)


def _start(
    data: HpsData, scale: Float[Tensor, ""], t_mount: Float[Tensor, "3"], turns: Float[Tensor, "segment 3"]
) -> HpsState:
    """The suit's pose with its segments turned, and translations at which the worn camera is where it was before.

    A segment's sensor says nothing of others, so all others keep their orientations in the world.
    """
    start, skeleton = data.start, data.patches.body.skeleton
    T_world_joint = forward_kinematics(skeleton, start.R_parent_joint, start.t_world_root)
    turn = torch.eye(3).to(start.theta).repeat(len(skeleton), 1, 1)
    turn = turn.index_copy(0, torch.tensor(segments(skeleton)), rotation.exp(turns.to(turn)))
    before, after = (
        rotation.log(local_rotations(skeleton, R)[:, 1:]) for R in (T_world_joint.R, T_world_joint.R @ turn)
    )
    # The angles' change, not the angles: without a turn the pose is the suit's to the bit.
    turned = replace(start, theta=start.theta + (after - before), R_world_root=start.R_world_root @ turn[0])
    head = forward_kinematics(skeleton, turned.R_parent_joint, start.t_world_root)[:, skeleton.index("head")]
    moved, reach = head.t - T_world_joint.t[:, skeleton.index("head")], head.t - start.t_world_root
    worn = start.t_world_root - (scale.to(reach) - 1) * reach - head.R @ t_mount.to(reach)
    return replace(turned, t_world_root=worn - moved)


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
    turns = [np.deg2rad(prior.segments_deg)] * (3 * len(segments(data.patches.body.skeleton)))
    deviations = torch.tensor([prior.scale, *[prior.mount_m] * 3, prior.height_m, *turns], dtype=torch.float64)
    nominal = torch.zeros_like(deviations)
    nominal[0] = 1.0
    parts = _sample(data, fps)
    if not deviations.any() or not parts:
        return Constants.of(nominal)
    free = deviations > 0

    def constants(unknown: np.ndarray) -> Float[Tensor, "constant"]:
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
    energy: HpsEnergy,
    data: HpsData,
    solver: Callable[[HpsEnergy, HpsData], Solution],
    values: Float[Tensor, "constant"],
) -> tuple[float, Float[Tensor, "constant"]]:
    """Least energy over the motions at given constants, and its derivative in them."""
    values = values.requires_grad_()
    constants = Constants.of(values.detach())
    nearer = with_constants(data, constants)
    solution = solver(energy, nearer)
    of_state, root = state_values(nearer, solution.state), solution.state.t_world_root[:, None]
    start = _start(data, values[0], values[1:4], values[5:].unflatten(0, (-1, 3)))
    of_data = data_values(replace(nearer, start=start), find_ground(nearer, of_state["soles"], energy))
    longer = (values[4] - constants.height_m) * constants.scale * _growth(nearer, solution.state)
    soles = root + (of_state["soles"] - root) * (values[0] / constants.scale) + longer[:, data.patches.patch // 2]
    now = of_state | of_data | {"soles": soles}
    touched = {name for value in _TOUCHED for name in energy.reading(value)}
    terms = replace(energy, weights={name: weight for name, weight in energy.weights.items() if name in touched})
    total = torch.stack(list(energy_of(terms, now).values())).sum()
    (slope,) = torch.autograd.grad(total, values)
    return min(entry["total"] for entry in solution.history), slope


def _growth(data: HpsData, state: HpsState) -> Float[Tensor, "time side 3"]:
    """Displacement of each foot (world axes) per metre by which its leg grows, with hips and pose held."""
    skeleton = data.patches.body.skeleton
    joints = forward_kinematics(skeleton, state.R_parent_joint, state.t_world_root).t
    sides = [(joints[:, bones[-1]] - joints[:, hip]) / _length(skeleton, bones) for hip, *bones in _legs(skeleton)]
    return torch.stack(sides, 1)
