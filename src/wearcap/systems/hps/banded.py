"""Banded Gauss-Newton solver of HPS (ours): all frames at once, in time linear in the recording's length.

The energy depends on the root, the head and the foot patches only, so the arms keep the suit's pose and about fifteen
joints are optimised. A term reaches over one or two frames (`hps.Term.reach`), so the normal equations are block
tridiagonal. Norms are minimised by iteratively reweighted least squares with a smoothing of their tips that decreases
over the iterations. `systems/hps/README.md` derives the system.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.optimize.losses import LOSSES
from wearcap.systems.hps import banded_kernels as kernels
from wearcap.systems.hps.banded_kernels import HEAD, LEGS, Body, Forms, Kinematics, Rows
from wearcap.systems.hps.block_tridiagonal import factor_and_solve
from wearcap.systems.hps.energy import (
    TERMS,
    FootPatches,
    HpsData,
    HpsEnergy,
    HpsState,
    Solution,
    data_values,
    find_ground,
)

_VALUES = {
    "t_root": kernels.TRANSLATION,
    "R_root": kernels.ROOT,
    "R_head": kernels.HEAD_ROTATION,
    "soles": kernels.SOLES,
}
"""What the compiled kernels know the derivative of, by its name in `hps.state_values`; poses in addition where they
are compared with the suit's: all joints' frame by frame, the legs' from frame to frame."""


_FORWARD_MODE = Lock()
"""PyTorch's forward mode has one level for all threads: stretches that are solved at the same time take turns."""


@dataclass(frozen=True)
class BandedSettings:
    """Iterations and tolerances of the solver."""

    iterations: int = 8
    smooth_start: float = 1e-2
    """Smoothing of norms (m, rad) in the first iteration."""
    smooth_end: float = 3e-4
    """Smoothing of norms (m, rad) in the last iteration; between both it decreases geometrically."""
    tolerance: float = 1e-4
    """Relative decrease of the energy below which the solver stops, once the smoothing has reached its end."""
    damping: float = 1e-6
    """Relative increase of the system's diagonal (Levenberg-Marquardt)."""
    relaxation: float = 1.0
    """Step length after the first two iterations; above 1, the reweighting of norms converges sooner."""


def solve_in_stretches(
    energy: HpsEnergy,
    data: HpsData,
    settings: BandedSettings = BandedSettings(),
    stretch: int = 1800,
    overlap: int = 150,
    jobs: int = 2,
) -> Solution:
    """Run `solve_banded` on stretches of about `stretch` frames, `jobs` at a time: bounded memory, one per core.

    Where the camera is localised, the influence of a frame decays within seconds. A stretch is therefore solved
    together with `overlap` localised frames beyond each of its ends, whose solution is discarded. Borders are never
    within a localisation outage. The history is the mean over stretches, weighted by their numbers of frames.
    """
    localized = (data.hold_confidence > 0).long()
    localized_before = torch.cat([localized.new_zeros(1), localized.cumsum(0)])
    borders = [0]
    while len(data) - borders[-1] > 1.5 * stretch:
        border = borders[-1] + stretch
        while border < len(data) and not localized[border]:
            border += 1
        borders.append(border)
    spans = []  # frames (first, keep from, keep to, last) of each stretch
    for keep, stop in pairwise([b for b in borders if b < len(data)] + [len(data)]):
        first = int(torch.searchsorted(localized_before, localized_before[keep] - overlap, right=True)) - 1
        last = int(torch.searchsorted(localized_before, localized_before[stop] + overlap))
        spans.append((max(min(first, keep), 0), keep, stop, min(max(last, stop), len(data))))
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as pool:
        solved = list(pool.map(lambda span: solve_banded(energy, data[span[0] : span[3]], settings), spans))
    kept = [s.state[keep - first : stop - first] for s, (first, keep, stop, _) in zip(solved, spans)]
    parts = zip(*(vars(state).values() for state in kept))
    length = max(len(s.history) for s in solved)
    history = []
    for step in range(length):
        entries = [(s.history[min(step, len(s.history) - 1)], b - a) for s, (_, a, b, _) in zip(solved, spans)]
        history.append({name: sum(e[name] * n for e, n in entries) / len(data) for name in entries[0][0]})
    return Solution(
        HpsState(*(torch.cat(part) for part in parts)), history, "; ".join(sorted({s.reason for s in solved}))
    )


def solve_banded(
    energy: HpsEnergy, data: HpsData, settings: BandedSettings = BandedSettings(), start: HpsState | None = None
) -> Solution:
    """Minimise an energy over all frames of `data` at once.

    `start` is the initial state (None: `data.start`). Returns the best state, and the energy by term after each
    iteration. Raises WearcapError when the energy does not determine all unknowns (a zero weight of `pose` or `hold`),
    and for a term that is neither known to the kernels nor a function of what the solver's unknowns are.
    """
    problem = Stretch(energy, data, data.start if start is None else start)
    best, history, reason = problem.state(), [], "all iterations done"
    for iteration in range(settings.iterations + 1):
        share = min(1.0, iteration / max(settings.iterations - 3, 1))
        smooth = settings.smooth_start ** (1 - share) * settings.smooth_end**share
        history.append(problem.evaluate(smooth))
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
        joints, self.body = _active_body(data.patches)
        self.columns = [joint - 1 for joint in joints]
        """Columns of θ that are optimised."""
        self.theta = np.ascontiguousarray(start.theta[:, self.columns].numpy())
        self.R_root, self.t = start.R_world_root.numpy().copy(), start.t_world_root.numpy().copy()
        self.theta_imu = np.ascontiguousarray(data.start.theta[:, self.columns].double().numpy())
        length, n = len(data), LEGS + 3 * self.body.leg_chains.size
        pairs, leg = max(length - 1, 0), 6 + 3 * self.body.leg_chains.shape[1]
        every = len(joints) + 1
        shapes = ((every, 3, 3), (every, 3), (every, 3, 3), (len(self.body.patch), 3))
        shapes += (len(self.body.patch), 2, 3), (2, 12, leg)
        self.kin = Kinematics(*(np.empty((length, *shape)) for shape in shapes))
        small, feet = ((length, 3), (pairs, 3, 3, 3), (length, 3, 3)), ((length, 2, 12, 12), (length, 2, 12))
        feet += (length, 2, 64), (pairs, 2, 64)
        self.forms = Forms(*(np.empty(shape) for shape in (*small, *feet, length, pairs)))
        self.system = np.empty((length, n, n)), np.empty((pairs, n, n)), np.empty((length, n))
        self.terms = sorted((name for name in TERMS if energy.weight(name) > 0), key=lambda name: TERMS[name].reach)
        """The weighted terms in the order of `rows`."""
        self.linearized: list[tuple[Tensor, Tensor, Tensor]] = []

    def evaluate(self, smooth: float) -> dict[str, float]:
        """Energy by term at the current state, on the scene that is below the feet there."""
        kernels.update_kinematics(self.theta, self.R_root, self.t, self.body, self.kin)
        ground = find_ground(self.data, torch.from_numpy(self.kin.points), self.energy)
        self.values = data_values(self.data, ground)
        self.rows = self._rows()
        for form in self.forms:
            form.fill(0.0)
        by_term = np.zeros(len(TERMS))
        kernels.gather(self.theta, self.t, self.body, self.rows, smooth, self.kin, self.forms, by_term)
        automatic = np.flatnonzero(self.rows.value == kernels.DIFFERENTIATED).tolist()
        self.linearized = [self._linearize(row, smooth, by_term) for row in automatic]
        named = {name: float(value) for name, value in zip(TERMS, by_term) if self.energy.weight(name) > 0}
        return named | {"total": float(by_term.sum())}

    def advance(self, damping: float, relaxation: float) -> None:
        """One Gauss-Newton step."""
        self.fill_system()
        diagonal, below, gradient = self.system
        if not (np.einsum("tii->ti", diagonal) > 0).all():
            expected = "weights of pose, hold and steps above zero"
            raise WearcapError("the energy does not determine the motion", expected=expected)
        factor_and_solve(diagonal, below, gradient, damping)
        kernels.apply_step(gradient, relaxation, self.theta, self.R_root, self.t, self.theta_imu, self.body, self.kin)

    def fill_system(self) -> None:
        """Fill the normal equations: diagonal blocks, couplings with the next frame, gradient."""
        kernels.fill_system(self.theta, self.theta_imu, self.body, self.kin, self.forms, *self.system)
        diagonal, below, gradient = (torch.from_numpy(part) for part in self.system)
        for residual, weight, jacobian in self.linearized:
            for frame, J in enumerate(jacobian):
                touched = slice(frame, frame + len(residual))
                diagonal[touched] += torch.einsum("fnec,fe,fmec->fnm", J, weight, J)
                gradient[touched] += torch.einsum("fnec,fe,fec->fn", J, weight, residual)
            if len(jacobian) == 2:
                below += torch.einsum("fnec,fe,fmec->fnm", jacobian[1], weight, jacobian[0])

    def state(self) -> HpsState:
        """The current state, with the suit's angles of all joints that are not optimised."""
        whole = self.start.theta.clone()
        whole[:, self.columns] = torch.from_numpy(self.theta)
        return HpsState(whole, torch.from_numpy(self.R_root.copy()), torch.from_numpy(self.t.copy()))

    def _rows(self) -> Rows:
        """The weighted terms as arrays for the kernels, derived from their rows in the table."""
        length, vertices = len(self.data), len(self.body.patch)
        stacks: dict[str, list[np.ndarray]] = {
            kind: [] for kind in ("positions", "rotations", "points", "share", "sole_share")
        }

        def slot(kind: str, name: str) -> int:
            value = self.values[name].double().numpy()
            if kind == "sole_share":
                value = np.broadcast_to(value.reshape(len(value), -1), (len(value), vertices))
            stacks[kind].append(np.zeros((length, *value.shape[1:])))
            stacks[kind][-1][: len(value)] = value
            return len(stacks[kind]) - 1

        values, slots = [_value_of(name) for name in self.terms], []
        kinds = {kernels.TRANSLATION: "positions", kernels.SOLES: "points"}
        for name, value in zip(self.terms, values):
            term, (expected, normal) = TERMS[name], (0, -1)
            if value in _VALUES.values():
                kind = kinds.get(value, "rotations")
                expected, normal = (*(slot(kind, given) for given in term.expected), -1)[:2]
            share = 0
            if value != kernels.DIFFERENTIATED:
                share = slot("sole_share" if value == kernels.SOLES else "share", term.share)
            slots.append((expected, normal, share))
        losses = [self.energy.loss(name) for name in self.terms]
        counts = [max(length - TERMS[name].reach + 1, 1) for name in self.terms]
        shapes = {"positions": (3,), "rotations": (3, 3), "points": (vertices, 3), "sole_share": (vertices,)}
        arrays = {kind: np.array(stack).reshape(-1, length, *shapes.get(kind, ())) for kind, stack in stacks.items()}
        return Rows(
            number=np.array([list(TERMS).index(name) for name in self.terms], dtype=np.int64),
            value=np.array(values, dtype=np.int64),
            reach=np.array([TERMS[name].reach for name in self.terms], dtype=np.int64),
            weight=np.array([self.energy.weight(name) for name in self.terms]) / counts,
            kind=np.array([LOSSES.index(loss.kind) for loss in losses], dtype=np.int64),
            delta=np.array([loss.delta for loss in losses], dtype=np.float64),
            slot=np.array(slots, dtype=np.int64).reshape(-1, 3),
            theta_imu=self.theta_imu,
            **arrays,
        )

    def _linearize(self, row: int, smooth: float, by_term: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals (frame, element, component) of a term, their weights (frame, element), and their derivatives
        (reach, frame, unknown, element, component) in the unknowns of each frame that they touch.

        Frames whose residuals have none in common are perturbed at the same time: n · reach forward passes.
        """
        term, (length, n) = TERMS[self.terms[row]], self.system[2].shape

        def residuals(unknowns: Tensor) -> Tensor:
            """Residuals as a function of the frames' unknowns, exact to first order at zero."""
            move, turn, head, legs = unknowns.split([3, 3, LEGS - HEAD, unknowns.shape[1] - LEGS], 1)
            R_root, R_head = (torch.from_numpy(self.kin.R[:, joint]) for joint in (0, self.body.head_chain[-1]))
            theta = torch.from_numpy(self.theta[:, self.body.leg_chains.ravel() - 1])
            points = torch.from_numpy(self.kin.points)
            perturbed = {
                "t_root": lambda: torch.from_numpy(self.t) + move,
                "R_root": lambda: R_root @ rotation.exp(turn),
                "R_head": lambda: rotation.exp(head + (R_root @ turn[..., None])[..., 0]) @ R_head,
                "theta_legs": lambda: theta + legs.unflatten(1, (-1, 3)),
                "soles": lambda: points + torch.einsum("tvin,tn->tvi", self._sole_jacobian(), unknowns),
            }
            inputs = (perturbed[name]() if name in perturbed else self.values[name] for name in term.inputs)
            found = term.cost(*inputs)
            return found.reshape(len(found), -1, found.shape[-1])

        still = torch.zeros(length, n, dtype=torch.float64)
        residual = residuals(still)
        unknown, frame = torch.arange(n), torch.arange(len(residual))
        tangents = torch.zeros(term.reach, n, length, n, dtype=torch.float64)
        for group in range(term.reach):
            tangents[group, unknown, group :: term.reach, unknown] = 1.0
        forward = torch.func.vmap(lambda tangent: torch.func.jvp(residuals, (still,), (tangent,))[1])
        with _FORWARD_MODE:
            all_groups = forward(tangents.flatten(0, 1)).unflatten(0, (term.reach, n))
        jacobian = torch.stack([all_groups[(frame + k) % term.reach, :, frame] for k in range(term.reach)])
        share = self.values[term.share][: len(residual)].reshape(len(residual), -1).expand(residual.shape[:2])
        weight = torch.empty(residual.shape[:2], dtype=torch.float64)
        kernels.weigh(
            row,
            residual.square().sum(-1).flatten().numpy(),
            share.flatten().numpy(),
            self.rows,
            smooth,
            by_term,
            weight.numpy().reshape(-1),
        )
        return residual, weight, jacobian

    def _sole_jacobian(self) -> Float64[Tensor, "time vertex 3 unknown"]:
        """Derivative of the patch vertices in their frame's unknowns."""
        body, kin = self.body, self.kin
        jacobian = np.zeros((*kin.points.shape, self.system[2].shape[1]))
        for n, patch in enumerate(body.patch):
            chain, maps = body.leg_chains[patch // 2], kin.foot_maps[:, patch // 2]
            first = LEGS + 3 * len(chain) * (patch // 2)
            at = [*range(HEAD), *range(first, first + 3 * len(chain))]
            for h, joint in enumerate(chain[-2:]):
                lever = kin.R[:, joint] @ body.arms[n, h]
                v, turn = maps[:, 6 * h : 6 * h + 3], maps[:, 6 * h + 3 : 6 * h + 6]
                jacobian[:, n, :, at] += body.shares[n, h] * np.moveaxis(
                    v + np.cross(turn, lever[..., None], axis=1), 2, 0
                )
        return torch.from_numpy(jacobian)


def _value_of(name: str) -> int:
    """What a term acts on, by its row; raises WearcapError for one that has no derivative in the unknowns."""
    term = TERMS[name]
    compared = (term.inputs[0], *term.expected, term.reach)
    if compared == ("theta", "theta_imu", 1):
        return kernels.POSE
    if compared == ("theta_legs", "theta_legs_imu", 2):
        return kernels.LEG_POSE
    if term.reach not in (1, 2) or "theta" in term.inputs:
        expected = "a term of one or two frames, of root, head, legs or soles: the spine is eliminated, the arms stay"
        fix = "Use theta_legs for theta, or the solver adam_windows."
        raise WearcapError(f"the banded solver cannot minimise the term {name!r}", expected=expected, fix=fix)
    along_normal = len(term.expected) == 2 and (term.inputs[0], term.reach) != ("soles", 1)
    known = term.expected and not along_normal
    return _VALUES.get(term.inputs[0], kernels.DIFFERENTIATED) if known else kernels.DIFFERENTIATED


def _active_body(patches: FootPatches) -> tuple[tuple[int, ...], Body]:
    """The optimised joints (without the root, parents first): the chains to the head and the feet, and their arrays.

    Raises WearcapError when a patch is skinned to joints other than the last two of its leg, or the body's feet change
    shape with the pose.
    """
    body, skeleton, legs = patches.body, patches.body.skeleton, patches.legs
    if body.pose_blend is not None:
        raise WearcapError("this body's feet change shape with the pose", fix="Use the solver adam_windows for it.")
    head = skeleton.ancestors(skeleton.index("head"))[-2::-1]
    joints = tuple(sorted({*head, *legs[0], *legs[1]}))
    number = {joint: k + 1 for k, joint in enumerate(joints)} | {0: 0}
    weights = torch.zeros(len(patches.vertex), len(skeleton), dtype=torch.float64)
    weights.scatter_add_(1, body.skin_joints[patches.vertex], body.skin_weights[patches.vertex].double())
    last_two = torch.tensor([legs[int(patch) // 2][-2:] for patch in patches.patch])
    shares = weights.gather(1, last_two)
    if (shares.sum(1) < 0.99).any():
        what = "vertices of the foot patches are skinned to joints other than ankle and toe"
        raise WearcapError(what, expected="a body whose soles follow the feet")
    arms = body.rest_vertices[patches.vertex].double()[:, None] - skeleton.rest_joints.double()[last_two]
    arms, shares = arms.numpy(), (shares / shares.sum(1, keepdim=True)).numpy()
    powers = np.concatenate([np.ones((len(arms), 2, 1)), arms], 2)
    products = np.einsum("vai,vbk->vabik", powers, powers) * (shares[:, :, None] * shares[:, None])[..., None, None]
    flat = [
        products[..., 0, 0, None],
        products[..., 1:, 0],
        products[..., 0, 1:],
        products[..., 1:, 1:].reshape(-1, 2, 2, 9),
    ]
    return joints, Body(
        parents=np.array([number[skeleton.parents[joint]] for joint in joints]),
        offsets=skeleton.t_parent_joint[list(joints)].double().numpy(),
        head_chain=np.array([number[joint] for joint in head]),
        leg_chains=np.array([[number[joint] for joint in leg] for leg in legs]),
        arms=arms,
        shares=shares,
        moments=np.concatenate(flat, -1).reshape(-1, 64),
        patch=patches.patch.numpy(),
    )
