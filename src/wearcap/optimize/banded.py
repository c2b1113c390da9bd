"""Our solver of HPS: second order, over time at once.

Only the head, the root and the feet's patches enter the energy, so the arms stay as the suit says and some fifteen
joints are left; neighbouring frames alone share terms, so the normal equations are block tridiagonal and solved in
time linear in the recording's length. Norms are met by iterative reweighting, their tips rounded ever less.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.optimize.banded_assembly import Body, Frames, Kinematics, Weights, assemble, update_kinematics
from wearcap.optimize.banded_kernels import factor_and_solve
from wearcap.optimize.costs import LOSSES
from wearcap.optimize.feet import FootPatches
from wearcap.optimize.hps import TERMS, HpsData, HpsEnergy, HpsState, find_ground
from wearcap.optimize.solution import Solution

_PAIRS = {"slide", "translation_smooth", "root_smooth", "head_smooth", "translation_step", "root_step", "head_step"}


@dataclass(frozen=True)
class BandedSettings:
    """How long and how finely to iterate."""

    iterations: int = 12
    smooth_start: float = 3e-2
    """Rounding of norms (m, rad) in the first iteration …"""
    smooth_end: float = 3e-4
    """… falling geometrically to this in the last."""
    tolerance: float = 1e-4
    """Stop when the energy falls by less than this share, the rounding having reached its end."""
    damping: float = 1e-6


@dataclass(frozen=True, eq=False)
class ActiveBody:
    """The joints that the energy sees, and their arrays for the kernels."""

    joints: tuple[int, ...]
    """Numbers in the skeleton, parents first, the root left out."""
    arrays: Body

    @classmethod
    def of(cls, patches: FootPatches) -> "ActiveBody":
        """Raises WearcapError when a patch is held by other joints than its foot's last two."""
        skeleton = patches.body.skeleton
        head = _chain(skeleton, skeleton.index("head"))
        legs = [_chain(skeleton, skeleton.index(f"{side}_toe")) for side in ("left", "right")]
        joints = tuple(sorted({*head, *legs[0], *legs[1]}))
        number = {joint: k + 1 for k, joint in enumerate(joints)} | {0: 0}
        parents = np.array([number[skeleton.parents[joint]] for joint in joints])
        offsets = skeleton.t_parent_joint[list(joints)].double().numpy()
        head_chain = np.array([number[joint] for joint in head])
        leg_chains = np.array([[number[joint] for joint in leg] for leg in legs])
        columns = 3 + np.arange(3)
        head_columns = np.concatenate([columns, *(columns + 3 * joint for joint in head_chain)])
        foot_columns = np.stack([np.concatenate([columns - 3, columns, *(columns + 3 * joint for joint in leg)]) for leg in leg_chains])
        holders, arms, shares = _holders(patches, legs)
        holders = np.vectorize(number.__getitem__)(holders)
        arrays = Body(parents, offsets, head_chain, head_columns, leg_chains, foot_columns, holders, arms, shares, patches.patch.numpy())
        return cls(joints, arrays)


def _chain(skeleton: Skeleton, joint: int) -> list[int]:
    """Joints from just below the root to `joint`."""
    chain = []
    while joint > 0:
        chain.append(joint)
        joint = skeleton.parents[joint]
    return chain[::-1]


def _holders(patches: FootPatches, legs: list[list[int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joints that hold each patch vertex (vertex, 2), the vertex in their axes (m), and their shares."""
    body, rows = patches.body, patches.vertex
    if body.pose_blend is not None:
        raise WearcapError("this body's feet change shape with the pose", fix="Take the solver adam_windows for it.")
    rest, joints = body.rest_vertices[rows].double(), body.skeleton.rest_joints.double()
    weights = torch.zeros(len(rows), len(body.skeleton), dtype=torch.float64)
    weights.scatter_add_(1, body.skin_joints[rows], body.skin_weights[rows].double())
    holders = torch.tensor([legs[int(patch) // 2][-2:] for patch in patches.patch])
    shares = weights.gather(1, holders)
    if (shares.sum(1) < 0.99).any():
        raise WearcapError("vertices of the feet's patches are held by joints other than ankle and toe",
                           expected="a body whose soles follow the feet")  # fmt: skip
    arms = rest[:, None] - joints[holders]
    return holders.numpy(), arms.numpy(), (shares / shares.sum(1, keepdim=True)).numpy()


def solve_banded(energy: HpsEnergy, data: HpsData, settings: BandedSettings = BandedSettings(), start: HpsState | None = None, fixed_start: bool = False) -> Solution:
    """Minimise an energy over all frames of `data` at once.

    `start` is where to begin (the initialisation when None); `fixed_start` holds its first frame. Returns the best
    state met, and the energy by term of each.
    """
    active = ActiveBody.of(data.patches)
    state = data.start if start is None else start
    frames = _frames(data, active)
    theta = np.ascontiguousarray(state.theta[:, [joint - 1 for joint in active.joints]].numpy())
    R_root, t = state.R_world_root.numpy().copy(), state.t_world_root.numpy().copy()
    kin = _empty_kinematics(len(data), active.arrays)
    size = 6 + 3 * len(active.joints)
    diagonal, below = np.empty((len(data), size, size)), np.empty((max(len(data) - 1, 0), size, size))
    gradient, by_term = np.empty((len(data), size)), np.empty(len(TERMS))
    best, history, reason = None, [], "all iterations done"
    for iteration in range(settings.iterations + 1):
        share = min(1.0, iteration / max(settings.iterations - 2, 1))
        smooth = settings.smooth_start ** (1 - share) * settings.smooth_end**share
        update_kinematics(theta, R_root, t, active.arrays, kin)
        _look_up_ground(data, kin.points, frames)
        assemble(theta, t, active.arrays, frames, _weights(energy, len(data), smooth), kin, diagonal, below, gradient, by_term)
        total = float(by_term.sum())
        history.append({name: float(value) for name, value in zip(TERMS, by_term) if name in energy.weights} | {"total": total})
        if best is None or total < best[0]:
            enough = best is not None and best[0] - total < settings.tolerance * best[0] and share == 1.0
            best = total, theta.copy(), R_root.copy(), t.copy()
            if enough:
                reason = "converged"
                break
        if iteration == settings.iterations:
            break
        if fixed_start:
            diagonal[0] += np.eye(size) * 1e12
        if not factor_and_solve(diagonal, below, gradient, settings.damping):
            reason = "the normal equations are singular"
            break
        t -= gradient[:, :3]
        R_root = R_root @ rotation.exp(torch.from_numpy(-gradient[:, 3:6])).numpy()
        theta -= gradient[:, 6:].reshape(theta.shape)
    return Solution(_state(state, active, *best[1:]), history, reason)


def _look_up_ground(data: HpsData, points: np.ndarray, frames: Frames) -> None:
    """Write the scene beneath the patches into `frames`."""
    ground = find_ground(data, torch.from_numpy(points))
    if ground is None:
        frames.found[:] = 0.0
        return
    for name in ("origin", "normal", "found"):
        getattr(frames, name)[:] = getattr(ground, name).numpy()
    frames.ground[:] = ground.point.numpy()


def _frames(data: HpsData, active: ActiveBody) -> Frames:
    size = torch.bincount(data.patches.patch, minlength=data.contact.shape[1])
    vertices = (len(data), len(data.patches.vertex))
    columns = [joint - 1 for joint in active.joints]
    arrays = (
        data.start.theta[:, columns], data.R_world_cam @ data.R_head_cam.T, data.cam_confidence, data.start.t_world_root,
        data.hold_confidence, data.contact / size / 4, data.contact[1:] * data.contact[:-1] / size / 4,
        data.t_step, data.R_root_step, data.R_head_step, torch.zeros(*vertices, 3), torch.zeros(*vertices, 3),
        torch.zeros(*vertices, 3), torch.zeros(vertices),
    )  # fmt: skip
    return Frames(*(np.ascontiguousarray(array.double().numpy()) for array in arrays))


def _weights(energy: HpsEnergy, length: int, smooth: float) -> Weights:
    counts = np.array([max(length - 1, 1) if name in _PAIRS else length for name in TERMS])
    losses = [energy.loss(name) for name in TERMS]
    return Weights(
        np.array([energy.weight(name) for name in TERMS]) / counts,
        np.array([LOSSES.index(loss.kind) for loss in losses]), np.array([loss.delta for loss in losses]),
        np.full(len(TERMS), smooth),
    )  # fmt: skip


def _empty_kinematics(length: int, body: Body) -> Kinematics:
    joints = len(body.parents) + 1
    return Kinematics(
        np.empty((length, joints, 3, 3)), np.empty((length, joints, 3)), np.empty((length, joints, 3, 3)),
        np.empty((length, len(body.patch), 3)), np.empty((length, 3, len(body.head_columns))),
        np.empty((length, 2, 12, body.foot_columns.shape[1])),
    )  # fmt: skip


def _state(start: HpsState, active: ActiveBody, theta: np.ndarray, R_root: np.ndarray, t: np.ndarray) -> HpsState:
    whole = start.theta.clone()
    whole[:, [joint - 1 for joint in active.joints]] = torch.from_numpy(theta)
    return HpsState(whole, torch.from_numpy(R_root), torch.from_numpy(t))
