"""Banded Gauss-Newton solver of HPS (ours): all frames at once, in time linear in the recording's length.

The energy depends on the root, the head and the foot patches only, so the arms keep the suit's pose and about fifteen
joints are optimised. Terms couple neighbouring frames only, so the normal equations are block tridiagonal. Norms are
minimised by iteratively reweighted least squares with a smoothing of their tips that decreases over the iterations.
`systems/hps/README.md` derives the system.
"""

from dataclasses import dataclass

import numpy as np
import torch

from wearcap.errors import WearcapError
from wearcap.optimize.banded_assembly import LEGS, Body, Forms, Frames, Kinematics, Weights, gather, update_kinematics
from wearcap.optimize.banded_kernels import factor_and_solve
from wearcap.optimize.banded_mapping import apply_step, fill_system
from wearcap.optimize.costs import LOSSES
from wearcap.optimize.feet import FootPatches, chain_to
from wearcap.optimize.hps import TERMS, HpsData, HpsEnergy, HpsState, find_ground
from wearcap.optimize.solution import Solution

_PAIRS = {
    "slide",
    "translation_smooth",
    "root_smooth",
    "head_smooth",
    "translation_step",
    "root_step",
    "head_step",
    "pose_step",
}


@dataclass(frozen=True)
class BandedSettings:
    """Iterations and tolerances of the solver."""

    iterations: int = 20
    smooth_start: float = 1e-2
    """Smoothing of norms (m, rad) in the first iteration."""
    smooth_end: float = 3e-4
    """Smoothing of norms (m, rad) in the last iteration; between both it decreases geometrically."""
    tolerance: float = 1e-4
    """Relative decrease of the energy below which the solver stops, once the smoothing has reached its end."""
    damping: float = 1e-6
    """Relative increase of the system's diagonal (Levenberg-Marquardt)."""
    relaxation: float = 1.5
    """Step length after the first two iterations; above 1, the reweighting of norms converges sooner."""


DEFAULTS = BandedSettings()


@dataclass(frozen=True, eq=False)
class ActiveBody:
    """The optimised joints, and their arrays for the kernels."""

    joints: tuple[int, ...]
    """Indices in the skeleton, parents first, without the root."""
    arrays: Body

    @classmethod
    def of(cls, patches: FootPatches) -> "ActiveBody":
        """Select the chains to the head and the feet. Raises WearcapError when a patch is skinned to joints other than
        the last two of its leg."""
        skeleton = patches.body.skeleton
        head, legs = chain_to(skeleton, skeleton.index("head")), patches.legs
        joints = tuple(sorted({*head, *legs[0], *legs[1]}))
        number = {joint: k + 1 for k, joint in enumerate(joints)} | {0: 0}
        parents = np.array([number[skeleton.parents[joint]] for joint in joints])
        offsets = skeleton.t_parent_joint[list(joints)].double().numpy()
        head_chain = np.array([number[joint] for joint in head])
        leg_chains = np.array([[number[joint] for joint in leg] for leg in legs])
        arrays = Body(parents, offsets, head_chain, leg_chains, *_patch_skinning(patches, legs), patches.patch.numpy())
        return cls(joints, arrays)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a frame."""
        return LEGS + 3 * self.arrays.leg_chains.size


def _patch_skinning(patches: FootPatches, legs: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Patch vertices in the axes of their leg's last two joints (vertex, 2, 3; m), and their weights (vertex, 2)."""
    body, rows = patches.body, patches.vertex
    if body.pose_blend is not None:
        raise WearcapError("this body's feet change shape with the pose", fix="Use the solver adam_windows for it.")
    rest, joints = body.rest_vertices[rows].double(), body.skeleton.rest_joints.double()
    weights = torch.zeros(len(rows), len(body.skeleton), dtype=torch.float64)
    weights.scatter_add_(1, body.skin_joints[rows], body.skin_weights[rows].double())
    last_two = torch.tensor([legs[int(patch) // 2][-2:] for patch in patches.patch])
    shares = weights.gather(1, last_two)
    if (shares.sum(1) < 0.99).any():
        raise WearcapError(
            "vertices of the foot patches are skinned to joints other than ankle and toe",
            expected="a body whose soles follow the feet",
        )
    arms = rest[:, None] - joints[last_two]
    return arms.numpy(), (shares / shares.sum(1, keepdim=True)).numpy()


def solve_banded(
    energy: HpsEnergy, data: HpsData, settings: BandedSettings = DEFAULTS, start: HpsState | None = None
) -> Solution:
    """Minimise an energy over all frames of `data` at once.

    `start` is the initial state (None: `data.start`). Returns the best state, and the energy by term after each
    iteration. Raises WearcapError when the energy does not determine all unknowns (a zero weight of `pose` or `hold`).
    """
    problem = Stretch(energy, data, data.start if start is None else start)
    best, history, reason = problem.state(), [], "all iterations done"
    for iteration in range(settings.iterations + 1):
        share = min(1.0, iteration / max(settings.iterations - 3, 1))
        smooth = settings.smooth_start ** (1 - share) * settings.smooth_end**share
        history.append(problem.evaluate(smooth, look_up=iteration < 3 or iteration % 3 == 0))
        totals = [entry["total"] for entry in history]
        if totals[-1] <= min(totals):
            best = problem.state()
            if share == 1.0 and totals[-2] - totals[-1] < settings.tolerance * totals[-1]:
                reason = "converged"
                break
        if iteration < settings.iterations:
            problem.advance(settings.damping, settings.relaxation if iteration > 1 else 1.0)
    return Solution(best, history, reason)


class Stretch:
    """Arrays of one stretch of frames: data, current state, and the linear system at it."""

    def __init__(self, energy: HpsEnergy, data: HpsData, start: HpsState):
        self.energy, self.data, self.start = energy, data, start
        self.active = ActiveBody.of(data.patches)
        self.columns = [joint - 1 for joint in self.active.joints]
        self.theta = np.ascontiguousarray(start.theta[:, self.columns].numpy())
        self.R_root, self.t = start.R_world_root.numpy().copy(), start.t_world_root.numpy().copy()
        body, length, n = self.active.arrays, len(data), self.active.unknowns
        self.frames, pairs = _frames(data, self.columns), max(length - 1, 0)
        joints, leg = len(body.parents) + 1, 6 + 3 * body.leg_chains.shape[1]
        shapes = ((joints, 3, 3), (joints, 3), (joints, 3, 3), (len(body.patch), 3), (2, 12, leg))
        self.kin = Kinematics(*(np.empty((length, *shape)) for shape in shapes))
        self.forms = Forms(
            np.empty((length, 3)),
            np.empty((pairs, 3, 3, 3)),
            np.empty((length, 3, 3)),
            np.empty((length, 2, 12, 12)),
            np.empty((pairs, 2, 12, 12)),
            np.empty((length, 2, 12)),
            np.empty(length),
            np.empty(pairs),
        )
        self.system = np.empty((length, n, n)), np.empty((pairs, n, n)), np.empty((length, n))

    def evaluate(self, smooth: float, look_up: bool) -> dict[str, float]:
        """Energy by term at the current state; with `look_up` the scene below the feet is queried again."""
        update_kinematics(self.theta, self.R_root, self.t, self.active.arrays, self.kin)
        if look_up:
            self._look_up_ground()
        for form in self.forms:
            form.fill(0.0)
        by_term, weights = np.zeros(len(TERMS)), _weights(self.energy, len(self.data), smooth)
        gather(self.theta, self.t, self.active.arrays, self.frames, weights, self.kin, self.forms, by_term)
        named = {name: float(value) for name, value in zip(TERMS, by_term) if self.energy.weight(name) > 0}
        return named | {"total": float(by_term.sum())}

    def advance(self, damping: float, relaxation: float) -> None:
        """One Gauss-Newton step."""
        body = self.active.arrays
        fill_system(self.theta, body, self.frames, self.kin, self.forms, *self.system)
        if not (np.einsum("tii->ti", self.system[0]) > 0).all():
            raise WearcapError(
                "the energy does not determine the motion", expected="weights of pose, hold and steps above zero"
            )
        factor_and_solve(*self.system, damping)
        apply_step(self.system[2], relaxation, self.theta, self.R_root, self.t, body, self.frames, self.kin)

    def state(self) -> HpsState:
        """The current state, with the suit's angles of all joints that are not optimised."""
        whole = self.start.theta.clone()
        whole[:, self.columns] = torch.from_numpy(self.theta)
        return HpsState(whole, torch.from_numpy(self.R_root.copy()), torch.from_numpy(self.t.copy()))

    def _look_up_ground(self) -> None:
        ground = find_ground(self.data, torch.from_numpy(self.kin.points), self.energy)
        for name, found in (
            ("ground", ground.point),
            ("origin", ground.origin),
            ("normal", ground.normal),
            ("found", ground.found),
        ):
            getattr(self.frames, name)[:] = found.numpy()


def _frames(data: HpsData, columns: list[int]) -> Frames:
    size = torch.bincount(data.patches.patch, minlength=data.contact.shape[1])
    vertices = (len(data), len(data.patches.vertex))
    arrays = (
        data.start.theta[:, columns],
        data.R_world_cam @ data.R_head_cam.T,
        data.cam_confidence,
        data.start.t_world_root,
        data.hold_confidence,
        data.contact / size / 4,
        data.contact[1:] * data.contact[:-1] / size / 4,
        data.t_step,
        data.R_root_step,
        data.R_head_step,
        torch.zeros(*vertices, 3),
        torch.zeros(*vertices, 3),
        torch.zeros(*vertices, 3),
        torch.zeros(vertices),
    )
    return Frames(*(np.ascontiguousarray(array.double().numpy()) for array in arrays))


def _weights(energy: HpsEnergy, length: int, smooth: float) -> Weights:
    counts = np.array([max(length - 1, 1) if name in _PAIRS else length for name in TERMS])
    losses = [energy.loss(name) for name in TERMS]
    return Weights(
        np.array([energy.weight(name) for name in TERMS]) / counts,
        np.array([LOSSES.index(loss.kind) for loss in losses]),
        np.array([loss.delta for loss in losses]),
        smooth,
    )
