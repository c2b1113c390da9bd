"""Compiled kernels of the banded solver: kinematics and assembly of the normal equations.

Derivatives are taken in world axes: a perturbation of joint i rotates all its descendants about the columns of
`axes[i]`. The two joints that a foot's vertices are skinned to move as twists (v, ω), so that twenty vertices need one
12 x 12 form.

Assembly has two passes. First (`gather`) each term adds its quadratic form in the value it acts on: translation,
rotations of root and head (world axes), twist of each foot. These forms are small, and none couples two of the five.
Then `fill_system` maps them to the unknowns of a frame: translation (3), root rotation (3, right perturbation), head
rotation relative to the root's (3), axis-angles of the two legs. The spine's joints are eliminated: of all spine poses
with the same head rotation, the one nearest to the suit's pose has the least energy. `systems/hps/README.md` derives
the system.
"""

from typing import NamedTuple

import numpy as np

from wearcap.geometry.compiled import compiled

NORM, SQUARE, HUBER, CAUCHY = 0, 1, 2, 3
"""Kinds of loss, in the order of `losses.LOSSES`."""
TRANSLATION, ROOT, HEAD_ROTATION, POSE, LEG_POSE, SOLES, DIFFERENTIATED = range(7)
"""Values that a term acts on; a `DIFFERENTIATED` term is not added by these kernels."""
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
    moments: np.ndarray
    """(vertex, 64) products s s' (1, x, y, x yᵀ) of a vertex's weights and arms for each pair of the two joints."""
    patch: np.ndarray


class Kinematics(NamedTuple):
    """Kinematics of all frames: joint rotations R and origins c, perturbation axes, patch vertices."""

    R: np.ndarray
    c: np.ndarray
    axes: np.ndarray
    points: np.ndarray
    levers: np.ndarray
    """(time, vertex, 2, 3) patch vertices from the origins of their leg's last two joints, in world axes (m)."""
    foot_maps: np.ndarray
    """(time, 2, 12, 6 + leg) Jacobians of the twists of each leg's last two joints."""


class Forms(NamedTuple):
    """Quadratic forms in the values that terms act on; `small`: translation, root and head, whose forms are w I."""

    small: np.ndarray
    """(time, 3) weights w of translation, root and head."""
    small_step: np.ndarray
    """(pair, 3, 3, 3) couplings with the next frame, whose variables are the rows."""
    small_gradient: np.ndarray
    foot: np.ndarray
    """(time, 2, 12, 12) forms of the foot twists by terms along a normal, lower triangles."""
    foot_gradient: np.ndarray
    moments: np.ndarray
    """(time, 2, 64) weighted sums of the vertices' moments by terms in all directions, of which `_add_form` makes forms."""
    moments_step: np.ndarray
    """(pair, 2, 64) the same for the coupling with the next frame."""
    pose: np.ndarray
    """(time) weights of the pose prior."""
    pose_step: np.ndarray
    """(pair) weights of the legs' pose steps."""


class Rows(NamedTuple):
    """The weighted terms, by reach: what `gather` needs of `hps.TERMS`. Arrays over pairs have a last, unused frame."""

    number: np.ndarray
    """Index of each term in `hps.TERMS`."""
    value: np.ndarray
    """Which value it acts on: TRANSLATION …"""
    reach: np.ndarray
    weight: np.ndarray
    """Weight over number of residuals."""
    kind: np.ndarray
    """Kind of loss: NORM …"""
    delta: np.ndarray
    slot: np.ndarray
    """(term, 3) indices into the arrays below: of the expected value, of its normal (-1: none), of the share."""
    share: np.ndarray
    """(slot, time) factors of the residuals."""
    positions: np.ndarray
    """(slot, time, 3) expected translations or displacements."""
    rotations: np.ndarray
    """(slot, time, 3, 3) expected rotations."""
    points: np.ndarray
    """(slot, time, vertex, 3) expected positions or displacements of the patch vertices, and normals."""
    sole_share: np.ndarray
    """(slot, time, vertex) factors of the patch vertices' residuals."""
    theta_imu: np.ndarray
    """(time, joint, 3) expected axis-angles: the suit's."""


@compiled
def reweight(square, kind, delta, smooth):
    """(ρ, w = ρ'(s) / s) of a residual with squared norm `square`: its loss and its weight in iteratively reweighted
    least squares, where ½ w s² has the slope of ρ. The weight of a norm is smoothed at its tip by `smooth`."""
    if kind == SQUARE:
        return square, 2.0
    if kind == CAUCHY:
        return 0.5 * delta * np.log1p(square / delta**2), 1.0 / (delta * (1.0 + square / delta**2))
    norm = np.sqrt(square)
    if kind == HUBER and norm < delta:
        return square / (2 * delta), 1.0 / delta
    if kind == HUBER:
        return norm - delta / 2, 1.0 / norm
    return norm, 1.0 / np.sqrt(square + smooth * smooth)


@compiled
def _exp_and_jacobian(v, R, J):
    """Rotation matrix of a rotation vector, and its right Jacobian: exp(v + d) ≈ exp(v) exp(J d)."""
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if square < 1e-8:
        a, b, c = 1.0 - square / 6, 0.5 - square / 24, 1.0 / 6 - square / 120
    else:
        angle = np.sqrt(square)
        a, b, c = (np.sin(angle) / angle, (1 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle))
    for i in range(3):
        for k in range(3):
            outer = v[i] * v[k]
            R[i, k] = b * outer
            J[i, k] = c * outer
        R[i, i] += 1.0 - b * square
        J[i, i] += 1.0 - c * square
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        R[j, i] += a * v[k]
        R[i, j] -= a * v[k]
        J[j, i] -= b * v[k]
        J[i, j] += b * v[k]


@compiled
def _turn_between(A, B, v):
    """Rotation vector (world axes, rad) that rotates A into B: log(B Aᵀ), angles up to π."""
    R = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for m in range(3):
                R[i, k] += B[i, m] * A[k, m]
    v[0], v[1], v[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sine = 0.5 * np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-7:
        v *= 0.5 * angle / sine
    elif cosine > 0:
        v *= 0.5
    else:  # half a turn: the axis from the symmetric part
        k = np.argmax(np.array([R[0, 0], R[1, 1], R[2, 2]]))
        for i in range(3):
            v[i] = 0.5 * (R[i, k] + R[k, i]) + (1.0 if i == k else 0.0)
        v *= angle / np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)


@compiled
def _pose_all(theta, R_root, t, parents, offsets, R, c, axes):
    """Forward kinematics of the optimised joints (index 0: root): rotations, origins, perturbation axes (world)."""
    R_local, J = np.empty((3, 3)), np.empty((3, 3))
    for j in range(len(t)):
        R[j, 0], c[j, 0], axes[j, 0] = R_root[j], t[j], R_root[j]
        for a in range(theta.shape[1]):
            _exp_and_jacobian(theta[j, a], R_local, J)
            above = parents[a]
            for i in range(3):
                c[j, a + 1, i] = c[j, above, i]
                for k in range(3):
                    c[j, a + 1, i] += R[j, above, i, k] * offsets[a, k]
                    R[j, a + 1, i, k] = 0.0
                    for m in range(3):
                        R[j, a + 1, i, k] += R[j, above, i, m] * R_local[m, k]
            for i in range(3):
                for k in range(3):
                    axes[j, a + 1, i, k] = 0.0
                    for m in range(3):
                        axes[j, a + 1, i, k] += R[j, a + 1, i, m] * J[m, k]


@compiled
def _patch_points(R, c, leg_chains, arms, shares, patch, points, levers):
    """Positions and levers of patch vertices, each skinned to the last two joints of its leg."""
    for j in range(len(R)):
        for n in range(len(patch)):
            chain = leg_chains[patch[n] // 2]
            for i in range(3):
                points[j, n, i] = 0.0
                for h in range(2):
                    joint, lever = chain[len(chain) - 2 + h], 0.0
                    for k in range(3):
                        lever += R[j, joint, i, k] * arms[n, h, k]
                    levers[j, n, h, i] = lever
                    points[j, n, i] += shares[n, h] * (c[j, joint, i] + lever)


@compiled
def _add_form(Q, moments, R, S, sign):
    """Add ±Σ w A Bᵀ of vertices to a form (12, 12) of the twists (v, ω) of a leg's last two joints, with rotations R
    in the rows' frame and S in the columns' frame.

    A vertex with levers x and y (world axes) moves by v + ω × x, so its blocks are I, -[y], [x] and (x · y) I - y xᵀ,
    with [x] p = x × p.
    """
    x, y, half, xy = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for a in range(2):
        for b in range(2):
            first, v, u = 16 * (2 * a + b), 6 * a, 6 * b
            m = moments[first : first + 16]
            if m[0] == 0.0:
                continue
            for i in range(3):
                x[i] = sign * (R[a, i, 0] * m[1] + R[a, i, 1] * m[2] + R[a, i, 2] * m[3])
                y[i] = sign * (S[b, i, 0] * m[4] + S[b, i, 1] * m[5] + S[b, i, 2] * m[6])
                for k in range(3):
                    half[i, k] = R[a, i, 0] * m[7 + k] + R[a, i, 1] * m[10 + k] + R[a, i, 2] * m[13 + k]
            for i in range(3):
                for k in range(3):
                    xy[i, k] = sign * (half[i, 0] * S[b, k, 0] + half[i, 1] * S[b, k, 1] + half[i, 2] * S[b, k, 2])
            dot = xy[0, 0] + xy[1, 1] + xy[2, 2]
            for i in range(3):
                Q[v + i, u + i] += sign * m[0]
                Q[v + 3 + i, u + 3 + i] += dot
                for k in range(3):
                    Q[v + 3 + i, u + 3 + k] -= xy[k, i]
            for i, k, l in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                Q[v + i, u + 3 + k] += y[l]
                Q[v + k, u + 3 + i] -= y[l]
                Q[v + 3 + i, u + k] -= x[l]
                Q[v + 3 + k, u + i] += x[l]


@compiled
def _add_moments(total, moments, weight):
    """Add a vertex's weighted moments."""
    for i in range(64):
        total[i] += weight * moments[i]


@compiled
def _add_pull(g, shares, x, r, weight):
    """Add a vertex's weighted residual to the gradient (12) in the twists of its leg's last two joints."""
    for h in range(2):
        w, at = weight * shares[h], 6 * h
        for i, k, l in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            g[at + i] += w * r[i]
            g[at + 3 + i] += w * (x[h, k] * r[l] - x[h, l] * r[k])


@compiled
def _foot_map(c, axes, chain, T):
    """Jacobian, 12 x (6 + 3 joints), of the twists of a leg's last two joints in translation, root and leg joints."""
    T[:] = 0.0
    for h in range(2):
        holder = chain[len(chain) - 2 + h]
        top = c[holder]
        for i in range(3):
            T[6 * h + i, i] = 1.0
        for column in range(len(chain) + 1):
            joint = 0 if column == 0 else chain[column - 1]
            if joint > holder:
                continue
            x, y, z = top[0] - c[joint, 0], top[1] - c[joint, 1], top[2] - c[joint, 2]
            for a in range(3):
                u = axes[joint, :, a]
                at = 3 + 3 * column + a
                T[6 * h, at] = u[1] * z - u[2] * y
                T[6 * h + 1, at] = u[2] * x - u[0] * z
                T[6 * h + 2, at] = u[0] * y - u[1] * x
                for i in range(3):
                    T[6 * h + 3 + i, at] = u[i]


@compiled
def update_kinematics(theta, R_root, t, body, kin):
    """Compute joint poses, patch vertices and derivatives of a state."""
    _pose_all(theta, R_root, t, body.parents, body.offsets, kin.R, kin.c, kin.axes)
    _patch_points(kin.R, kin.c, body.leg_chains, body.arms, body.shares, body.patch, kin.points, kin.levers)
    for j in range(len(t)):
        for f in range(2):
            _foot_map(kin.c[j], kin.axes[j], body.leg_chains[f], kin.foot_maps[j, f])


@compiled
def gather(theta, t, body, rows, smooth, kin, forms, energy):
    """Add the reweighted forms of all terms at this state to `forms`, and their energies to `energy`."""
    for j in range(len(t)):
        _gather_contact(j, body, rows, smooth, kin, forms, energy)
        for k in range(len(rows.reach)):
            value, pair = rows.value[k], rows.reach[k] == 2
            if j + rows.reach[k] > len(t) or value == DIFFERENTIATED:
                continue
            if value == SOLES and pair:
                _gather_slide(j, k, body, rows, smooth, kin, forms, energy)
            elif value != SOLES and rows.share[rows.slot[k, 2], j] > 0:
                if value in (POSE, LEG_POSE):
                    _gather_pose(j, k, theta, body, rows, smooth, forms, energy)
                else:
                    _gather_motion(j, k, t, body, rows, smooth, kin, forms, energy)


@compiled
def _rho(k, square, share, rows, smooth, energy):
    """Add a residual's energy; returns its weight in the least-squares problem."""
    value, weight = reweight(square, rows.kind[k], rows.delta[k], smooth)
    energy[rows.number[k]] += rows.weight[k] * share * value
    return rows.weight[k] * share * weight


@compiled
def weigh(k, square, share, rows, smooth, energy, weight):
    """Fill `weight` (residual) as `_rho` does, for a term that is differentiated automatically."""
    for e in range(len(square)):
        weight[e] = _rho(k, square[e], share[e], rows, smooth, energy)


@compiled
def _gather_motion(j, k, t, body, rows, smooth, kin, forms, energy):
    """Add a term of one frame's translation or rotation, or of its step to the next: ½ w |r + next - step here|²."""
    value, slot, pair, r = rows.value[k], rows.slot[k, 0], rows.reach[k] == 2, np.empty(3)
    turns = value != TRANSLATION
    if turns:
        joint, here = 0 if value == ROOT else body.head_chain[-1], np.empty((3, 3))
        for i in range(3):
            for m in range(3):
                here[i, m] = rows.rotations[slot, j, i, m]
                if pair:
                    here[i, m] = 0.0
                    for l in range(3):
                        here[i, m] += rows.rotations[slot, j, i, l] * kin.R[j, joint, l, m]
        _turn_between(here, kin.R[j + pair, joint], r)
    else:
        for i in range(3):
            r[i] = t[j + pair, i] - (t[j, i] if pair else 0.0) - rows.positions[slot, j, i]
    w = _rho(k, _square(r), rows.share[rows.slot[k, 2], j], rows, smooth, energy)
    forms.small[j + pair, value] += w
    for i in range(3):
        forms.small_gradient[j + pair, value, i] += w * r[i]
    if pair:
        forms.small[j, value] += w
        for i in range(3):
            for m in range(3):
                step = rows.rotations[slot, j, i, m] if turns else (1.0 if i == m else 0.0)
                forms.small_step[j, value, i, m] -= w * step
                forms.small_gradient[j, value, m] -= w * step * r[i]


@compiled
def _gather_pose(j, k, theta, body, rows, smooth, forms, energy):
    """Add the weight of a term of all joints' axis-angles, or of the legs' from frame to frame; `fill_system` adds
    the rest."""
    square = 0.0
    if rows.value[k] == POSE:
        for a in range(theta.shape[1]):
            for i in range(3):
                square += (theta[j, a, i] - rows.theta_imu[j, a, i]) ** 2
        forms.pose[j] += _rho(k, square, rows.share[rows.slot[k, 2], j], rows, smooth, energy)
    else:
        for f in range(2):
            for joint in body.leg_chains[f]:
                for i in range(3):
                    square += _pose_change(j, joint, i, theta, rows.theta_imu) ** 2
        forms.pose_step[j] += _rho(k, square, rows.share[rows.slot[k, 2], j], rows, smooth, energy)


@compiled
def _pose_change(j, joint, i, theta, theta_imu):
    """Change of a joint's deviation from the suit's axis-angle from frame j to j + 1 (rad)."""
    here = theta[j, joint - 1, i] - theta_imu[j, joint - 1, i]
    return theta[j + 1, joint - 1, i] - theta_imu[j + 1, joint - 1, i] - here


@compiled
def _gather_contact(j, body, rows, smooth, kin, forms, energy):
    """Add the terms of one frame's patch vertices, measured in all directions or along a normal."""
    along, r = np.empty(12), np.empty(3)
    for n in range(len(body.patch)):
        f, levers, shares = body.patch[n] // 2, kin.levers[j, n], body.shares[n]
        Q, g = forms.foot[j, f], forms.foot_gradient[j, f]
        for k in range(len(rows.reach)):
            slot, normal, factor = rows.slot[k]
            if rows.value[k] != SOLES or rows.reach[k] != 1 or rows.sole_share[factor, j, n] == 0:
                continue
            share = rows.sole_share[factor, j, n]
            _difference(kin.points[j, n], rows.points[slot, j, n], r)
            if normal < 0:
                w = _rho(k, _square(r), share, rows, smooth, energy)
                _add_moments(forms.moments[j, f], body.moments[n], w)
                _add_pull(g, shares, levers, r, w)
                continue
            up = rows.points[normal, j, n]
            distance = r[0] * up[0] + r[1] * up[1] + r[2] * up[2]
            w = _rho(k, distance * distance, share, rows, smooth, energy)
            along[:] = 0.0
            _add_pull(along, shares, levers, up, 1.0)
            for i in range(12):
                g[i] += w * distance * along[i]
                for m in range(i + 1):
                    Q[i, m] += w * along[i] * along[m]


@compiled
def _gather_slide(j, k, body, rows, smooth, kin, forms, energy):
    """Add a term of the patch vertices' displacement to the next frame."""
    r = np.empty(3)
    slot, _, factor = rows.slot[k]
    for n in range(len(body.patch)):
        share = rows.sole_share[factor, j, n]
        if share == 0:
            continue
        f, shares, here, after = body.patch[n] // 2, body.shares[n], kin.levers[j, n], kin.levers[j + 1, n]
        _difference(kin.points[j + 1, n], kin.points[j, n], r)
        _difference(r, rows.points[slot, j, n], r)
        w = _rho(k, _square(r), share, rows, smooth, energy)
        for moments in (forms.moments[j, f], forms.moments[j + 1, f], forms.moments_step[j, f]):
            _add_moments(moments, body.moments[n], w)
        _add_pull(forms.foot_gradient[j, f], shares, here, r, -w)
        _add_pull(forms.foot_gradient[j + 1, f], shares, after, r, w)


@compiled
def _difference(a, b, r):
    r[0], r[1], r[2] = a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _square(r):
    return r[0] * r[0] + r[1] * r[1] + r[2] * r[2]


@compiled
def fill_system(theta, theta_imu, body, kin, forms, diagonal, below, gradient):
    """Fill diagonal blocks (time, n, n), couplings (pair, n, n; rows of the next frame) and gradient (time, n)."""
    diagonal[:], below[:], gradient[:] = 0.0, 0.0, 0.0
    for j in range(len(diagonal)):
        _fill_trunk(j, theta, theta_imu, body, kin, forms, diagonal, gradient)
        for f in range(2):
            _fill_foot(j, f, theta, theta_imu, body, kin, forms, diagonal, below, gradient)
        if j + 1 == len(diagonal):
            continue
        # Couplings of translation, root and head with the next frame's.
        B, here, after, head = below[j], kin.R[j, 0], kin.R[j + 1, 0], forms.small_step[j, 2]
        for i in range(3):
            for k in range(3):
                B[i, k] += forms.small_step[j, 0, i, k]
                B[HEAD + i, HEAD + k] += head[i, k]
                for m in range(3):
                    B[HEAD + i, 3 + k] += head[i, m] * here[m, k]
                    B[3 + i, HEAD + k] += after[m, i] * head[m, k]
                    for l in range(3):
                        both = forms.small_step[j, 1, m, l] + head[m, l]
                        B[3 + i, 3 + k] += after[m, i] * both * here[l, k]


@compiled
def _fill_trunk(j, theta, theta_imu, body, kin, forms, diagonal, gradient):
    """Add translation, root and head; eliminating the spine turns its pose prior into the form w (J Jᵀ)⁻¹ of the
    head."""
    D, g, R = diagonal[j], gradient[j], kin.R[j, 0]
    inverse, turn = _spine_form(theta, theta_imu, body, kin, j)
    pull = inverse @ turn
    for i in range(3):
        D[i, i] += forms.small[j, 0]
        D[3 + i, 3 + i] += forms.small[j, 1] + forms.small[j, 2]
        D[HEAD + i, HEAD + i] += forms.small[j, 2]
        g[i] += forms.small_gradient[j, 0, i]
        g[HEAD + i] += forms.small_gradient[j, 2, i] + forms.pose[j] * pull[i]
        for k in range(3):
            g[3 + i] += R[k, i] * (forms.small_gradient[j, 1, k] + forms.small_gradient[j, 2, k])
            D[HEAD + i, 3 + k] += forms.small[j, 2] * R[i, k]
            D[3 + k, HEAD + i] += forms.small[j, 2] * R[i, k]
            D[HEAD + i, HEAD + k] += forms.pose[j] * inverse[i, k]


@compiled
def _spine_form(theta, theta_imu, body, kin, j):
    """((J Jᵀ)⁻¹, J d): J is the head rotation's Jacobian (world axes) in the spine's axis-angles, d their deviation
    from the suit's."""
    gram, turn = np.zeros((3, 3)), np.zeros(3)
    for joint in body.head_chain:
        J = kin.axes[j, joint]
        for i in range(3):
            for k in range(3):
                turn[i] += J[i, k] * (theta[j, joint - 1, k] - theta_imu[j, joint - 1, k])
                for m in range(3):
                    gram[i, k] += J[i, m] * J[k, m]
    return np.linalg.inv(gram), turn


@compiled
def _fill_foot(j, f, theta, theta_imu, body, kin, forms, diagonal, below, gradient):
    """Add a foot's twist forms and the leg's pose terms."""
    chain, T = body.leg_chains[f], kin.foot_maps[j, f]
    first = LEGS + 3 * len(chain) * f
    for k in range(len(chain)):
        for i in range(3):
            at = first + 3 * k + i
            diagonal[j, at, at] += forms.pose[j]
            away = theta[j, chain[k] - 1, i] - theta_imu[j, chain[k] - 1, i]
            gradient[j, at] += forms.pose[j] * away
            if j + 1 < len(diagonal):
                w, change = forms.pose_step[j], _pose_change(j, chain[k], i, theta, theta_imu)
                diagonal[j, at, at] += w
                diagonal[j + 1, at, at] += w
                below[j, at, at] -= w
                gradient[j, at] -= w * change
                gradient[j + 1, at] += w * change
    Q, R = forms.foot[j, f], kin.R[j, chain[len(chain) - 2 :]]
    for i in range(12):
        for k in range(i):
            Q[k, i] = Q[i, k]
    _add_form(Q, forms.moments[j, f], R, R, 1.0)
    if Q[0, 0] + Q[6, 6] > 0:
        _scatter(diagonal[j], first, np.dot(T.T, np.dot(Q, T)))
        along = np.dot(T.T, forms.foot_gradient[j, f])
        for a in range(len(along)):
            gradient[j, a if a < 6 else first + a - 6] += along[a]
    step = forms.moments_step[j, f] if j + 1 < len(diagonal) else forms.moments[j, f][:0]
    if step.any():
        Q[:] = 0.0
        _add_form(Q, step, kin.R[j + 1, chain[len(chain) - 2 :]], R, -1.0)
        _scatter(below[j], first, np.dot(kin.foot_maps[j + 1, f].T, np.dot(Q, T)))


@compiled
def _scatter(target, first, block):
    """Add a block over (translation, root, leg) to a frame's rows and columns."""
    for a in range(len(block)):
        row = a if a < 6 else first + a - 6
        for b in range(6):
            target[row, b] += block[a, b]
        for b in range(6, len(block)):
            target[row, first + b - 6] += block[a, b]


@compiled
def apply_step(step, scale, theta, R_root, t, theta_imu, body, kin):
    """Update a state by -`scale` times the system's solution; the spine follows the head's rotation."""
    R_turn, J = np.empty((3, 3)), np.empty((3, 3))
    for j in range(len(t)):
        inverse, turn = _spine_form(theta, theta_imu, body, kin, j)
        pull = inverse @ (turn - step[j, HEAD : HEAD + 3])
        for joint in body.head_chain:
            for k in range(3):
                away = theta[j, joint - 1, k] - theta_imu[j, joint - 1, k]
                along = 0.0
                for i in range(3):
                    along += kin.axes[j, joint, i, k] * pull[i]
                theta[j, joint - 1, k] += scale * (along - away)
        for f in range(2):
            chain = body.leg_chains[f]
            for k in range(len(chain)):
                at = LEGS + 3 * (len(chain) * f + k)
                for i in range(3):
                    theta[j, chain[k] - 1, i] -= scale * step[j, at + i]
        for i in range(3):
            t[j, i] -= scale * step[j, i]
        _exp_and_jacobian(-scale * step[j, 3:6], R_turn, J)
        R_root[j] = R_root[j] @ R_turn
