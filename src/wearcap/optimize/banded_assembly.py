"""Assembly of the normal equations of HPS over a stretch of frames, in two compiled passes.

First each term adds its quadratic form in the variables it acts on: translation, rotations of root and head (world
axes), twist of each foot. These forms are small, and none couples two of the five. `banded_mapping` then maps them to
the unknowns of a frame: translation (3), root rotation (3, right perturbation), head rotation relative to the root's
(3), axis-angles of the two legs. The spine's joints are eliminated: of all spine poses with the same head rotation,
the one nearest to the suit's pose has the least energy.
"""

from typing import NamedTuple

import numpy as np

from wearcap.geometry.compiled import compiled
from wearcap.optimize.banded_kernels import foot_map, patch_points, pose_all, reweight, turn_between, vertex_twist

(
    SELF,
    CONTACT,
    CONTACT_PLANE,
    SLIDE,
    TRANSLATION_SMOOTH,
    ROOT_SMOOTH,
    HEAD_SMOOTH,
    POSE,
    HOLD,
    TRANSLATION_STEP,
    ROOT_STEP,
    HEAD_STEP,
    POSE_STEP,
) = range(13)
"""Indices into `hps.TERMS`."""

HEAD = 6
"""Index of the head's first unknown in a frame, after translation and root."""
LEGS = 9
"""Index of the legs' first unknown in a frame."""


class Body(NamedTuple):
    """The optimised part of a skeleton: root (index 0) and the joints from it to head and toes."""

    parents: np.ndarray
    offsets: np.ndarray
    head_chain: np.ndarray
    """Indices of the joints from the spine to the head."""
    leg_chains: np.ndarray
    """(2, joints) indices of the joints from hip to toe."""
    arms: np.ndarray
    """(vertex, 2, 3) patch vertices in the axes of their leg's last two joints (m)."""
    shares: np.ndarray
    """(vertex, 2) skinning weights of these two joints."""
    patch: np.ndarray


class Frames(NamedTuple):
    """Data of the stretch's frames, as in `hps.HpsData`."""

    theta_imu: np.ndarray
    R_cam: np.ndarray
    """(time, 3, 3) localised orientation of the head, R^C R_HCᵀ."""
    cam_confidence: np.ndarray
    t_hold: np.ndarray
    hold_confidence: np.ndarray
    contact: np.ndarray
    """(time, patch) contact, divided by the patch's number of vertices and by four."""
    stay: np.ndarray
    """(pair, patch) contact in both frames of a pair, divided likewise."""
    t_step: np.ndarray
    R_root_step: np.ndarray
    R_head_step: np.ndarray
    ground: np.ndarray
    """(time, vertex, 3) nearest scene points."""
    origin: np.ndarray
    normal: np.ndarray
    found: np.ndarray


class Weights(NamedTuple):
    """Weight over number of residuals, kind of loss and its delta by term; and the smoothing of norms (m, rad)."""

    weight: np.ndarray
    kind: np.ndarray
    delta: np.ndarray
    smooth: float


class Kinematics(NamedTuple):
    """Kinematics of all frames at the current state: joint rotations R and origins c, perturbation axes, patch
    vertices."""

    R: np.ndarray
    c: np.ndarray
    axes: np.ndarray
    points: np.ndarray
    foot_maps: np.ndarray
    """(time, 2, 12, 6 + leg) Jacobians of the twists of each leg's last two joints."""


class Forms(NamedTuple):
    """Quadratic forms in the variables that the terms act on; `small`: translation, root and head, whose forms are w
    I."""

    small: np.ndarray
    """(time, 3) weights w of translation, root and head."""
    small_step: np.ndarray
    """(pair, 3, 3, 3) couplings with the next frame, whose variables are the rows."""
    small_gradient: np.ndarray
    foot: np.ndarray
    """(time, 2, 12, 12) forms of the foot twists, lower triangles."""
    foot_step: np.ndarray
    foot_gradient: np.ndarray
    pose: np.ndarray
    """(time) weights of the pose prior."""
    pose_step: np.ndarray
    """(pair) weights of the legs' pose steps."""


@compiled
def update_kinematics(theta, R_root, t, body, kin):
    """Compute joint poses, patch vertices and derivatives of a state."""
    pose_all(theta, R_root, t, body.parents, body.offsets, kin.R, kin.c, kin.axes)
    patch_points(kin.R, kin.c, body.leg_chains, body.arms, body.shares, body.patch, kin.points)
    for j in range(len(t)):
        for f in range(2):
            foot_map(kin.c[j], kin.axes[j], body.leg_chains[f], kin.foot_maps[j, f])


@compiled
def gather(theta, t, body, frames, weights, kin, forms, energy):
    """Add the reweighted forms of all terms at this state to `forms`, and their energies to `energy`."""
    for j in range(len(t)):
        _gather_frame(j, theta, t, body, frames, weights, kin, forms, energy)
        _gather_contact(j, body, frames, weights, kin, forms, energy)
        if j + 1 < len(t):
            _gather_steps(j, t, body, frames, weights, kin, forms, energy)
            _gather_slide(j, body, frames, weights, kin, forms, energy)
            _gather_pose_step(j, theta, body, frames, weights, forms, energy)


@compiled
def _rho(term, square, share, weights, energy):
    """Add a residual's energy; returns its weight in the least-squares problem."""
    value, weight = reweight(square, weights.kind[term], weights.delta[term], weights.smooth)
    energy[term] += weights.weight[term] * share * value
    return weights.weight[term] * share * weight


@compiled
def _gather_frame(j, theta, t, body, frames, weights, kin, forms, energy):
    """Add the terms of single frames: `self` (thesis eq. 4.2), `pose` (eq. 4.12), `hold`."""
    if weights.weight[SELF] > 0 and frames.cam_confidence[j] > 0:
        r = np.empty(3)
        turn_between(frames.R_cam[j], kin.R[j, body.head_chain[-1]], r)
        w = _rho(SELF, r @ r, frames.cam_confidence[j], weights, energy)
        forms.small[j, 2] += w
        forms.small_gradient[j, 2] += w * r
    if weights.weight[HOLD] > 0 and frames.hold_confidence[j] > 0:
        r = t[j] - frames.t_hold[j]
        w = _rho(HOLD, r @ r, frames.hold_confidence[j], weights, energy)
        forms.small[j, 0] += w
        forms.small_gradient[j, 0] += w * r
    if weights.weight[POSE] > 0:
        square = 0.0
        for a in range(theta.shape[1]):
            for i in range(3):
                square += (theta[j, a, i] - frames.theta_imu[j, a, i]) ** 2
        forms.pose[j] = _rho(POSE, square, 1.0, weights, energy)


@compiled
def _gather_steps(j, t, body, frames, weights, kin, forms, energy):
    """Add the smoothness terms (thesis eq. 4.9–4.11) and their counterparts relative to the suit's steps."""
    for term in (TRANSLATION_SMOOTH, TRANSLATION_STEP):
        if weights.weight[term] > 0:
            r = t[j + 1] - t[j]
            if term == TRANSLATION_STEP:
                r = r - frames.t_step[j]
            w = _rho(term, r @ r, 1.0, weights, energy)
            _add_step(j, 0, w, np.eye(3), r, forms)
    r = np.empty(3)
    for term, group, joint in (
        (ROOT_SMOOTH, 1, 0),
        (ROOT_STEP, 1, 0),
        (HEAD_SMOOTH, 2, body.head_chain[-1]),
        (HEAD_STEP, 2, body.head_chain[-1]),
    ):
        if weights.weight[term] > 0:
            step = np.eye(3)
            if term == ROOT_STEP:
                step = frames.R_root_step[j]
            elif term == HEAD_STEP:
                step = frames.R_head_step[j]
            turn_between(step @ kin.R[j, joint], kin.R[j + 1, joint], r)
            w = _rho(term, r @ r, 1.0, weights, energy)
            _add_step(j, group, w, step, r, forms)


@compiled
def _gather_pose_step(j, theta, body, frames, weights, forms, energy):
    if weights.weight[POSE_STEP] == 0:
        return
    square = 0.0
    for f in range(2):
        for joint in body.leg_chains[f]:
            for i in range(3):
                square += pose_change(j, joint, i, theta, frames) ** 2
    forms.pose_step[j] = _rho(POSE_STEP, square, 1.0, weights, energy)


@compiled
def pose_change(j, joint, i, theta, frames):
    """Change of a joint's deviation from the suit's axis-angle from frame j to j + 1 (rad)."""
    here = theta[j, joint - 1, i] - frames.theta_imu[j, joint - 1, i]
    return theta[j + 1, joint - 1, i] - frames.theta_imu[j + 1, joint - 1, i] - here


@compiled
def _add_step(j, group, w, step, r, forms):
    """Add the form ½ w |r + next - step here|²."""
    forms.small[j, group] += w
    forms.small[j + 1, group] += w
    forms.small_step[j, group] -= w * step
    forms.small_gradient[j, group] -= w * (step.T @ r)
    forms.small_gradient[j + 1, group] += w * r


@compiled
def _gather_contact(j, body, frames, weights, kin, forms, energy):
    """Add the contact terms (thesis eq. 4.6), to nearest points and to planes."""
    if weights.weight[CONTACT] == 0 and weights.weight[CONTACT_PLANE] == 0:
        return
    A, along, r = np.empty((12, 3)), np.empty(12), np.empty(3)
    for n in range(len(body.patch)):
        f = body.patch[n] // 2
        share = frames.contact[j, body.patch[n]] * frames.found[j, n]
        if share == 0:
            continue
        width = vertex_twist(kin.R[j], body.leg_chains[f], body.arms[n], body.shares[n], A)
        Q, g = forms.foot[j, f], forms.foot_gradient[j, f]
        if weights.weight[CONTACT] > 0:
            _difference(kin.points[j, n], frames.ground[j, n], r)
            w = _rho(CONTACT, _square(r), share, weights, energy)
            _add_square(Q, A, width, w)
            _add_gradient(g, A, width, r, w)
        if weights.weight[CONTACT_PLANE] > 0:
            _difference(kin.points[j, n], frames.origin[j, n], r)
            up = frames.normal[j, n]
            distance = r[0] * up[0] + r[1] * up[1] + r[2] * up[2]
            w = _rho(CONTACT_PLANE, distance * distance, share, weights, energy)
            for i in range(width):
                along[i] = A[i, 0] * up[0] + A[i, 1] * up[1] + A[i, 2] * up[2]
                g[i] += w * distance * along[i]
                for k in range(i + 1):
                    Q[i, k] += w * along[i] * along[k]


@compiled
def _gather_slide(j, body, frames, weights, kin, forms, energy):
    """Add the slide term (thesis eq. 4.7)."""
    if weights.weight[SLIDE] == 0:
        return
    A, B, r = np.empty((12, 3)), np.empty((12, 3)), np.empty(3)
    for n in range(len(body.patch)):
        f = body.patch[n] // 2
        share = frames.stay[j, body.patch[n]]
        if share == 0:
            continue
        width = vertex_twist(kin.R[j], body.leg_chains[f], body.arms[n], body.shares[n], A)
        vertex_twist(kin.R[j + 1], body.leg_chains[f], body.arms[n], body.shares[n], B)
        _difference(kin.points[j + 1, n], kin.points[j, n], r)
        w = _rho(SLIDE, _square(r), share, weights, energy)
        _add_square(forms.foot[j, f], A, width, w)
        _add_square(forms.foot[j + 1, f], B, width, w)
        _add_gradient(forms.foot_gradient[j, f], A, width, r, -w)
        _add_gradient(forms.foot_gradient[j + 1, f], B, width, r, w)
        Q = forms.foot_step[j, f]
        for i in range(width):
            x, y, z = w * B[i, 0], w * B[i, 1], w * B[i, 2]
            for k in range(width):
                Q[i, k] -= x * A[k, 0] + y * A[k, 1] + z * A[k, 2]


@compiled
def _difference(a, b, r):
    r[0], r[1], r[2] = a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _square(r):
    return r[0] * r[0] + r[1] * r[1] + r[2] * r[2]


@compiled
def _add_square(Q, A, width, weight):
    """Q += weight A Aᵀ, the lower triangle, over the first `width` rows."""
    for i in range(width):
        x, y, z = weight * A[i, 0], weight * A[i, 1], weight * A[i, 2]
        for k in range(i + 1):
            Q[i, k] += x * A[k, 0] + y * A[k, 1] + z * A[k, 2]


@compiled
def _add_gradient(g, A, width, r, weight):
    for i in range(width):
        g[i] += weight * (A[i, 0] * r[0] + A[i, 1] * r[1] + A[i, 2] * r[2])
