"""The suit's path and the localised camera's, fused (ours).

A suit's heading drifts while its displacements are good; localised positions are noisy, wrong in bursts, and missing for
up to minutes. One sparse least-squares problem over nodes in time weighs both: the localised path before and after a gap
tells the heading at its ends, and within it the heading goes from one to the other as its random walk allows.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Float64
from scipy.sparse.linalg import spsolve
from torch import Tensor

from wearcap.geometry import rotation

POSITION_SCALES = (np.inf, 1.0, 0.5, 0.3, 0.2, 0.15, 0.15, 0.15)
"""Scale (m) of the Cauchy loss of positions, by iteration: wide at first, since the path may start metres off."""
ANGLE_SCALE = 0.1
"""Scale (rad) of the Cauchy loss of headings."""
STEP_SCALE = 5.0
"""Scale of the Cauchy loss of displacements, in their deviations: a camera that jumps does not bend the path."""
STATE = 5
"""Values of a node: the camera's offset from the suit's path (3), heading, scale of displacements."""


@dataclass(frozen=True)
class DriftPrior:
    """Deviations of a suit's drift and of a localised camera's errors."""

    node_s: float = 0.5
    """Time between nodes, for about which the camera's errors last."""
    heading_walk_deg_per_sqrt_min: float = 3.0
    scale: float = 0.005
    """Of the scale of all displacements, which changes by as much within ten minutes."""
    step_scale: float = 0.008
    """Of the scale of a displacement between nodes."""
    step_m: float = 0.003
    """Of a displacement between nodes of a wearer who stands."""
    position_m: float = 0.05
    """Of the positions that are localised about a node, along each axis."""
    angle_deg: float = 3.0
    """Of the headings that are localised about a node: the suit's head is some degrees off for seconds."""
    mount_deg: float = 10.0
    """Of the nominal mount's yaw."""


@dataclass(frozen=True)
class CameraSamples:
    """Localised frames within the suit's time."""

    timestamps: Float64[Tensor, "sample"]
    position: Float64[Tensor, "sample 3"]
    yaw: Float64[Tensor, "sample"]
    """Angle (rad) about gravity from the suit's head to the localised one."""
    confidence: Float64[Tensor, "sample"]
    yaw_confidence: Float64[Tensor, "sample"]
    """Confidence times how well the angle is determined, 0…1."""


def fuse_paths(
    timestamps: Float64[Tensor, "time"], body: Float64[Tensor, "time 3"], camera: CameraSamples, prior: DriftPrior
) -> tuple[Float64[Tensor, "time"], Float64[Tensor, "time 3"]]:
    """Angle (rad) about gravity that corrects the suit's heading, and the worn camera's path (m, world), per frame.

    `body` is the camera's path by the suit alone. Let d_k be the displacement from node k to the next, turned by the
    heading y⁰ of the last iteration, o_k the camera's offset from the path of these, s_k the scale's error. Then
    o_{k+1} − o_k = (y_k − y⁰_k) e_z × d_k + s_k d_k up to the deviations of `prior`, where y and s walk randomly. Offsets
    are measured by positions, headings by orientations up to the yaw of the mount, which is one unknown more.
    """
    count = max(round((timestamps[-1] - timestamps[0]).item() / prior.node_s), 1) + 1
    first = timestamps[0].item()
    nodes = np.linspace(first, max(timestamps[-1].item(), first + prior.node_s), count)
    at, times, path = timestamps.numpy(), camera.timestamps.numpy(), body.numpy()
    picks = _interpolation(times, nodes)
    measured = _measurements(picks)
    share = 1 / max(np.bincount(np.searchsorted(nodes, times)).max(), 1)
    position_share = share * camera.confidence.numpy() / prior.position_m**2
    yaw_share = share * camera.yaw_confidence.numpy() / np.deg2rad(prior.angle_deg) ** 2
    walks = _walks(count, nodes[1] - nodes[0], prior)
    state, mount_yaw, residual = np.zeros((count, STATE)), 0.0, np.zeros((count - 1, 3))
    for scale_m in POSITION_SCALES:
        heading = state[:, 3]
        turned = _turned(path, np.interp(at, nodes, heading))
        apart = camera.position.numpy() - columns_at(times, at, turned)
        steps = np.diff(columns_at(nodes, at, turned), axis=0)
        deviation = np.hypot(prior.step_m, prior.step_scale * np.linalg.norm(steps, axis=1))
        lead = np.interp(times, nodes, heading)
        off = np.remainder(camera.yaw.numpy() - lead - mount_yaw + np.pi, 2 * np.pi) - np.pi
        rows, values = _displacements(steps, heading)
        weight = [
            np.repeat(_cauchy(np.linalg.norm(residual, axis=1) / deviation / STEP_SCALE) / deviation**2, 3),
            np.repeat(_cauchy(np.linalg.norm(apart - picks @ state[:, :3], axis=1) / scale_m) * position_share, 3),
            _cauchy(off / ANGLE_SCALE) * yaw_share,
        ]
        J = scipy.sparse.vstack([rows, measured]).tocsr()
        weighted = J.T @ scipy.sparse.diags_array(np.concatenate(weight))
        values = np.concatenate([values, apart.reshape(-1), lead + mount_yaw + off])
        solution = spsolve((weighted @ J + walks).tocsc(), weighted @ values)
        state, mount_yaw = solution[:-1].reshape(count, STATE), solution[-1]
        residual = (rows @ solution).reshape(-1, 3) - values[: 3 * (count - 1)].reshape(-1, 3)
    yaw = np.interp(at, nodes, state[:, 3])
    return torch.from_numpy(yaw), torch.from_numpy(_turned(path, yaw) + columns_at(at, nodes, state[:, :3]))


def _cauchy(residual: Float[np.ndarray, "row"]) -> Float[np.ndarray, "row"]:
    """Weights that fall with the residual in units of the scale."""
    return 1 / (1 + residual**2) ** 2


def columns_at(
    at: Float[np.ndarray, "sample"], times: Float[np.ndarray, "time"], value: Float[np.ndarray, "time axis"]
) -> Float[np.ndarray, "sample axis"]:
    """Linear interpolation of each axis; the ends are repeated outside."""
    return np.stack([np.interp(at, times, column) for column in value.T], 1)


def _turned(path: Float[np.ndarray, "time 3"], yaw: Float[np.ndarray, "time"]) -> Float[np.ndarray, "time 3"]:
    """The path from its first place, turned step by step."""
    turn = rotation.about_axis("z", torch.from_numpy((yaw[1:] + yaw[:-1]) / 2)).numpy()
    steps = (turn @ np.diff(path, axis=0)[..., None])[..., 0]
    return path[:1] + np.concatenate([np.zeros((1, 3)), steps.cumsum(0)])


def _interpolation(times: Float[np.ndarray, "sample"], nodes: Float[np.ndarray, "node"]) -> scipy.sparse.csr_array:
    """Samples × nodes: linear interpolation at the times."""
    after = np.searchsorted(nodes, times).clip(1, len(nodes) - 1)
    share = ((times - nodes[after - 1]) / (nodes[after] - nodes[after - 1])).clip(0, 1)
    rows = np.tile(np.arange(len(times)), 2)
    values, columns = np.concatenate([1 - share, share]), np.concatenate([after - 1, after])
    return scipy.sparse.csr_array((values, (rows, columns)), (len(times), len(nodes)))


def _measurements(picks: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Rows of all positions, then of all headings, over the nodes' values and the mount's yaw."""
    offset = scipy.sparse.kron(picks, np.eye(3, STATE))
    heading = scipy.sparse.kron(picks, np.eye(1, STATE, 3))
    samples = len(picks.indptr) - 1
    mount = np.concatenate([np.zeros(3 * samples), np.ones(samples)])[:, None]
    return scipy.sparse.csr_array(scipy.sparse.hstack([scipy.sparse.vstack([offset, heading]), mount]))


def _displacements(
    steps: Float[np.ndarray, "pair 3"], heading: Float[np.ndarray, "node"]
) -> tuple[scipy.sparse.csr_array, Float[np.ndarray, "row"]]:
    """Rows o_{k+1} − o_k − y_k e_z × d_k − s_k d_k and their values − y⁰_k e_z × d_k, y and s as means of both nodes."""
    pairs = len(steps)
    side = np.stack([-steps[:, 1], steps[:, 0], np.zeros(pairs)], 1)
    block = np.zeros((pairs, 3, 2, STATE))
    block[:, :, 0, :3], block[:, :, 1, :3] = -np.eye(3), np.eye(3)
    block[..., 3] = -side[:, :, None] / 2
    block[..., 4] = -steps[:, :, None] / 2
    columns = np.arange(pairs)[:, None, None] * STATE + np.arange(2 * STATE)
    index = np.broadcast_to(columns, (pairs, 3, 2 * STATE)).reshape(-1)
    starts = np.arange(3 * pairs + 1) * 2 * STATE
    rows = scipy.sparse.csr_array((block.reshape(-1), index, starts), (3 * pairs, (pairs + 1) * STATE + 1))
    return rows, -((heading[1:] + heading[:-1])[:, None] / 2 * side).reshape(-1)


def _walks(count: int, step_s: float, prior: DriftPrior) -> scipy.sparse.csr_array:
    """Information of the random walks of heading and scale, of the scale's first value, and of the mount's yaw."""
    step = scipy.sparse.diags_array([-np.ones(count - 1), np.ones(count - 1)], offsets=[0, 1], shape=(count - 1, count))
    start = scipy.sparse.csr_array(([1.0], ([0], [0])), (count, count))
    heading = step.T @ step / (np.deg2rad(prior.heading_walk_deg_per_sqrt_min) ** 2 * step_s / 60)
    scale = (step.T @ step / (step_s / 600) + start) / prior.scale**2
    unit = np.eye(STATE)
    walks = scipy.sparse.kron(heading, np.diag(unit[3])) + scipy.sparse.kron(scale, np.diag(unit[4]))
    mount = np.array([[1 / np.deg2rad(prior.mount_deg) ** 2]])
    return scipy.sparse.csr_array(scipy.sparse.block_diag([walks, mount]))
