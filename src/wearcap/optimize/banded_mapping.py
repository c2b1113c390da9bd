"""Maps the terms' quadratic forms to the block tridiagonal system in the frames' unknowns, and its solution to a
state."""

import numpy as np

from wearcap.geometry.compiled import compiled
from wearcap.optimize.banded_assembly import HEAD, LEGS, pose_change
from wearcap.optimize.banded_kernels import exp_and_jacobian


@compiled
def fill_system(theta, body, frames, kin, forms, diagonal, below, gradient):
    """Fill diagonal blocks (time, n, n), couplings (pair, n, n; rows of the next frame) and gradient (time, n)."""
    diagonal[:], below[:], gradient[:] = 0.0, 0.0, 0.0
    for j in range(len(diagonal)):
        _fill_trunk(j, theta, body, frames, kin, forms, diagonal, gradient)
        for f in range(2):
            _fill_foot(j, f, theta, body, frames, kin, forms, diagonal, below, gradient)
        if j + 1 < len(diagonal):
            _fill_trunk_step(j, kin, forms, below)


@compiled
def _fill_trunk(j, theta, body, frames, kin, forms, diagonal, gradient):
    """Add translation, root and head; eliminating the spine turns its pose prior into the form w (J Jᵀ)⁻¹ of the
    head."""
    D, g, R = diagonal[j], gradient[j], kin.R[j, 0]
    inverse, turn = spine_form(theta, body, frames, kin, j)
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
def spine_form(theta, body, frames, kin, j):
    """((J Jᵀ)⁻¹, J d): J is the head rotation's Jacobian (world axes) in the spine's axis-angles, d their deviation
    from the suit's."""
    gram, turn = np.zeros((3, 3)), np.zeros(3)
    for joint in body.head_chain:
        J = kin.axes[j, joint]
        for i in range(3):
            for k in range(3):
                turn[i] += J[i, k] * (theta[j, joint - 1, k] - frames.theta_imu[j, joint - 1, k])
                for m in range(3):
                    gram[i, k] += J[i, m] * J[k, m]
    return np.linalg.inv(gram), turn


@compiled
def _fill_trunk_step(j, kin, forms, below):
    """Add the couplings of translation, root and head with the next frame's."""
    B, here, after = below[j], kin.R[j, 0], kin.R[j + 1, 0]
    head = forms.small_step[j, 2]
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
def _fill_foot(j, f, theta, body, frames, kin, forms, diagonal, below, gradient):
    """Add a foot's twist forms and the leg's pose terms."""
    chain, T = body.leg_chains[f], kin.foot_maps[j, f]
    first = LEGS + 3 * len(chain) * f
    for k in range(len(chain)):
        for i in range(3):
            at = first + 3 * k + i
            diagonal[j, at, at] += forms.pose[j]
            away = theta[j, chain[k] - 1, i] - frames.theta_imu[j, chain[k] - 1, i]
            gradient[j, at] += forms.pose[j] * away
            if j + 1 < len(diagonal):
                w, change = forms.pose_step[j], pose_change(j, chain[k], i, theta, frames)
                diagonal[j, at, at] += w
                diagonal[j + 1, at, at] += w
                below[j, at, at] -= w
                gradient[j, at] -= w * change
                gradient[j + 1, at] += w * change
    Q = forms.foot[j, f]
    if Q[0, 0] > 0:
        for i in range(12):
            for k in range(i):
                Q[k, i] = Q[i, k]
        _scatter(diagonal[j], first, np.dot(T.T, np.dot(Q, T)))
        along = np.dot(T.T, forms.foot_gradient[j, f])
        for a in range(len(along)):
            gradient[j, a if a < 6 else first + a - 6] += along[a]
    if j + 1 < len(diagonal) and forms.foot_step[j, f, 0, 0] != 0:
        _scatter(below[j], first, np.dot(kin.foot_maps[j + 1, f].T, np.dot(forms.foot_step[j, f], T)))


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
def apply_step(step, scale, theta, R_root, t, body, frames, kin):
    """Update a state by -`scale` times the system's solution; the spine follows the head's rotation."""
    R_turn, J = np.empty((3, 3)), np.empty((3, 3))
    for j in range(len(t)):
        inverse, turn = spine_form(theta, body, frames, kin, j)
        pull = inverse @ (turn - step[j, HEAD : HEAD + 3])
        for joint in body.head_chain:
            for k in range(3):
                away = theta[j, joint - 1, k] - frames.theta_imu[j, joint - 1, k]
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
        exp_and_jacobian(-scale * step[j, 3:6], R_turn, J)
        R_root[j] = R_root[j] @ R_turn
