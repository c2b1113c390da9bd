"""The normal equations of HPS over a stretch of frames: gradient, banded Hessian and energy in one compiled pass."""

from typing import NamedTuple

import numpy as np

from wearcap.geometry.compiled import compiled
from wearcap.optimize.banded_kernels import (
    add_block, foot_map, patch_points, pose_all, reweight, turn_between, vertex_twist,
)  # fmt: skip

(
    SELF, CONTACT, CONTACT_PLANE, SLIDE, TRANSLATION_SMOOTH, ROOT_SMOOTH, HEAD_SMOOTH, POSE, HOLD,
    TRANSLATION_STEP, ROOT_STEP, HEAD_STEP,
) = range(12)  # fmt: skip
"""Places of `hps.TERMS`."""


class Body(NamedTuple):
    """The active part of a skeleton: joints above the head and the feet; number 0 is the root."""

    parents: np.ndarray
    offsets: np.ndarray
    head_chain: np.ndarray
    """Active joints from the spine to the head."""
    head_columns: np.ndarray
    """Unknowns of a frame that turn the head: the root's rotation and the chain's."""
    leg_chains: np.ndarray
    """(2, joints) from hip to toe."""
    foot_columns: np.ndarray
    """(2, unknowns) of a frame that move each foot: translation, the root's rotation and the leg's."""
    holders: np.ndarray
    """(vertex, 2) active joints that hold each patch vertex."""
    arms: np.ndarray
    """(vertex, 2, 3) the vertex in each holder's axes (m)."""
    shares: np.ndarray
    patch: np.ndarray


class Frames(NamedTuple):
    """Data of the stretch, as in `hps.HpsData`."""

    theta_imu: np.ndarray
    R_cam: np.ndarray
    """Localised orientation of the head, R^C R_HCᵀ."""
    cam_confidence: np.ndarray
    t_hold: np.ndarray
    hold_confidence: np.ndarray
    contact: np.ndarray
    """(time, patch), divided by the patch's number of vertices and by four."""
    stay: np.ndarray
    """(pair, patch), the same for both frames in contact."""
    t_step: np.ndarray
    R_root_step: np.ndarray
    R_head_step: np.ndarray
    ground: np.ndarray
    """(time, vertex, 3) nearest scene points."""
    origin: np.ndarray
    normal: np.ndarray
    found: np.ndarray


class Weights(NamedTuple):
    """By term: weight over count, kind of loss, its delta; how far the tips of norms are rounded."""

    weight: np.ndarray
    kind: np.ndarray
    delta: np.ndarray
    smooth: np.ndarray


class Kinematics(NamedTuple):
    """Of all frames at the current state: poses of the active joints, perturbation axes, patch vertices, maps."""

    R: np.ndarray
    c: np.ndarray
    axes: np.ndarray
    points: np.ndarray
    head_map: np.ndarray
    """(time, 3, unknown) turn of the head (world axes) by `head_columns`."""
    foot_maps: np.ndarray
    """(time, 2, 12, unknown) twists of each foot's holders by `foot_columns`."""


@compiled
def update_kinematics(theta, R_root, t, body, kin):
    """Poses, patch vertices and derivatives of a state."""
    pose_all(theta, R_root, t, body.parents, body.offsets, kin.R, kin.c, kin.axes)
    patch_points(kin.R, kin.c, body.holders, body.arms, body.shares, kin.points)
    for j in range(len(t)):
        for i in range(3):
            for a in range(3):
                kin.head_map[j, i, a] = kin.axes[j, 0, i, a]
                for k in range(len(body.head_chain)):
                    kin.head_map[j, i, 3 + 3 * k + a] = kin.axes[j, body.head_chain[k], i, a]
        for f in range(2):
            chain = body.leg_chains[f]
            foot_map(kin.c[j], kin.axes[j], chain, chain[-2:], kin.foot_maps[j, f])


@compiled
def assemble(theta, t, body, frames, weights, kin, diagonal, below, gradient, energy):
    """Energy by term, its gradient, and the Hessian's blocks, all of the rounded, reweighted terms here."""
    diagonal[:], below[:], gradient[:], energy[:] = 0.0, 0.0, 0.0, 0.0
    for j in range(len(t)):
        _add_turn_to_camera(j, body, frames, weights, kin, diagonal, gradient, energy)
        _add_contact(j, body, frames, weights, kin, diagonal, gradient, energy)
        _add_priors(j, theta, t, frames, weights, diagonal, gradient, energy)
        if j + 1 < len(t):
            _add_steps(j, t, body, frames, weights, kin, diagonal, below, gradient, energy)
            _add_slide(j, body, frames, weights, kin, diagonal, below, gradient, energy)


@compiled
def _rho(term, square, share, weights, energy):
    """Add an element's energy; returns its weight in the least squares."""
    value, weight = reweight(square, weights.kind[term], weights.delta[term], weights.smooth[term])
    energy[term] += weights.weight[term] * share * value
    return weights.weight[term] * share * weight


@compiled
def _add_map(diagonal, gradient, columns, J, weight, residual):
    """The element ½ w |r + J d|² of one frame."""
    for a in range(len(columns)):
        for i in range(len(residual)):
            gradient[columns[a]] += weight * J[i, a] * residual[i]
    add_block(diagonal, columns, columns, weight * (J.T @ J))


@compiled
def _add_turn_to_camera(j, body, frames, weights, kin, diagonal, gradient, energy):
    """Thesis eq. 4.2."""
    if weights.weight[SELF] == 0 or frames.cam_confidence[j] == 0:
        return
    r = np.empty(3)
    turn_between(frames.R_cam[j], kin.R[j, body.head_chain[-1]], r)
    w = _rho(SELF, r @ r, frames.cam_confidence[j], weights, energy)
    _add_map(diagonal[j], gradient[j], body.head_columns, kin.head_map[j], w, r)


@compiled
def _add_priors(j, theta, t, frames, weights, diagonal, gradient, energy):
    """Thesis eq. 4.12, and the hold on the translation."""
    if weights.weight[HOLD] > 0 and frames.hold_confidence[j] > 0:
        r = t[j] - frames.t_hold[j]
        w = _rho(HOLD, r @ r, frames.hold_confidence[j], weights, energy)
        for i in range(3):
            diagonal[j, i, i] += w
            gradient[j, i] += w * r[i]
    if weights.weight[POSE] > 0:
        d = (theta[j] - frames.theta_imu[j]).ravel()
        w = _rho(POSE, d @ d, 1.0, weights, energy)
        for i in range(len(d)):
            diagonal[j, 6 + i, 6 + i] += w
            gradient[j, 6 + i] += w * d[i]


@compiled
def _add_contact(j, body, frames, weights, kin, diagonal, gradient, energy):
    """Thesis eq. 4.6, to nearest points and to planes."""
    if weights.weight[CONTACT] == 0 and weights.weight[CONTACT_PLANE] == 0:
        return
    A, Q, g = np.empty((3, 12)), np.empty((12, 12)), np.empty(12)
    for f in range(2):
        Q[:], g[:] = 0.0, 0.0
        used = False
        for n in range(len(body.patch)):
            share = frames.contact[j, body.patch[n]] * frames.found[j, n]
            if body.patch[n] // 2 != f or share == 0:
                continue
            used = True
            vertex_twist(kin.R[j], body.holders, body.arms, body.shares, n, A)
            if weights.weight[CONTACT] > 0:
                r = kin.points[j, n] - frames.ground[j, n]
                w = _rho(CONTACT, r @ r, share, weights, energy)
                Q += w * (A.T @ A)
                g += w * (A.T @ r)
            if weights.weight[CONTACT_PLANE] > 0:
                normal = frames.normal[j, n]
                distance = (kin.points[j, n] - frames.origin[j, n]) @ normal
                w = _rho(CONTACT_PLANE, distance * distance, share, weights, energy)
                along = A.T @ normal
                Q += w * np.outer(along, along)
                g += w * distance * along
        if used:
            T, columns = kin.foot_maps[j, f], body.foot_columns[f]
            along = T.T @ g
            for a in range(len(columns)):
                gradient[j, columns[a]] += along[a]
            add_block(diagonal[j], columns, columns, T.T @ Q @ T)


@compiled
def _add_slide(j, body, frames, weights, kin, diagonal, below, gradient, energy):
    """Thesis eq. 4.7."""
    if weights.weight[SLIDE] == 0:
        return
    A, B = np.empty((3, 12)), np.empty((3, 12))
    for f in range(2):
        Q, g = np.zeros((24, 24)), np.zeros(24)
        used = False
        for n in range(len(body.patch)):
            share = frames.stay[j, body.patch[n]]
            if body.patch[n] // 2 != f or share == 0:
                continue
            used = True
            vertex_twist(kin.R[j], body.holders, body.arms, body.shares, n, A)
            vertex_twist(kin.R[j + 1], body.holders, body.arms, body.shares, n, B)
            r = kin.points[j + 1, n] - kin.points[j, n]
            w = _rho(SLIDE, r @ r, share, weights, energy)
            Q[:12, :12] += w * (A.T @ A)
            Q[12:, :12] -= w * (B.T @ A)
            Q[12:, 12:] += w * (B.T @ B)
            g[:12] -= w * (A.T @ r)
            g[12:] += w * (B.T @ r)
        if used:
            _add_pair(j, body.foot_columns[f], kin.foot_maps[j, f], kin.foot_maps[j + 1, f], Q, g, diagonal, below,
                      gradient)  # fmt: skip


@compiled
def _add_pair(j, columns, J, K, Q, g, diagonal, below, gradient):
    """A form Q, g of motions mapped by J at frame j and K at frame j + 1."""
    half = len(g) // 2
    here, next_ = J.T @ g[:half], K.T @ g[half:]
    for a in range(len(columns)):
        gradient[j, columns[a]] += here[a]
        gradient[j + 1, columns[a]] += next_[a]
    first, last = np.ascontiguousarray(Q[:half, :half]), np.ascontiguousarray(Q[half:, half:])
    add_block(diagonal[j], columns, columns, J.T @ first @ J)
    add_block(below[j], columns, columns, K.T @ np.ascontiguousarray(Q[half:, :half]) @ J)
    add_block(diagonal[j + 1], columns, columns, K.T @ last @ K)


@compiled
def _add_steps(j, t, body, frames, weights, kin, diagonal, below, gradient, energy):
    """Thesis eq. 4.9–4.11, and the same against the suit's steps."""
    for term in (TRANSLATION_SMOOTH, TRANSLATION_STEP):
        if weights.weight[term] == 0:
            continue
        r = t[j + 1] - t[j]
        if term == TRANSLATION_STEP:
            r = r - frames.t_step[j]
        w = _rho(term, r @ r, 1.0, weights, energy)
        for i in range(3):
            diagonal[j, i, i] += w
            diagonal[j + 1, i, i] += w
            below[j, i, i] -= w
            gradient[j, i] -= w * r[i]
            gradient[j + 1, i] += w * r[i]
    head, still = body.head_chain[-1], np.eye(3)
    columns, J, K = body.head_columns, kin.head_map[j], kin.head_map[j + 1]
    root_J, root_K = np.ascontiguousarray(J[:, :3]), np.ascontiguousarray(K[:, :3])
    for term in (ROOT_SMOOTH, ROOT_STEP):
        if weights.weight[term] > 0:
            step = frames.R_root_step[j] if term == ROOT_STEP else still
            _add_turn(term, j, columns[:3], step @ root_J, root_K, step @ kin.R[j, 0], kin.R[j + 1, 0], weights,
                      diagonal, below, gradient, energy)  # fmt: skip
    for term in (HEAD_SMOOTH, HEAD_STEP):
        if weights.weight[term] > 0:
            step = frames.R_head_step[j] if term == HEAD_STEP else still
            _add_turn(term, j, columns, step @ J, K, step @ kin.R[j, head], kin.R[j + 1, head], weights, diagonal,
                      below, gradient, energy)  # fmt: skip


@compiled
def _add_turn(term, j, columns, J, K, expected, R_next, weights, diagonal, below, gradient, energy):
    """A turn from frame to frame against the expected one."""
    r = np.empty(3)
    turn_between(expected, R_next, r)
    w = _rho(term, r @ r, 1.0, weights, energy)
    Q, g = np.zeros((6, 6)), np.empty(6)
    for i in range(3):
        Q[i, i] = Q[3 + i, 3 + i] = w
        Q[3 + i, i] = -w
        g[i], g[3 + i] = -w * r[i], w * r[i]
    _add_pair(j, columns, J, K, Q, g, diagonal, below, gradient)
