"""Compiled kernels of the banded solver: rotations, forward kinematics of the optimised joints, block elimination.

Derivatives are taken in world axes: a perturbation of joint i rotates all its descendants about the columns of
`axes[i]`. The two joints that a foot's vertices are skinned to move as twists (v, ω), so that twenty vertices need one
12 x 12 form.
"""

import numpy as np

from wearcap.geometry.compiled import compiled

NORM, SQUARE, HUBER, CAUCHY = 0, 1, 2, 3


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
def exp_and_jacobian(v, R, J):
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
def log_of(R, v):
    """Rotation vector of a rotation matrix (angles up to π)."""
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
def turn_between(A, B, v):
    """Rotation vector (world axes, rad) that rotates A into B: log(B Aᵀ)."""
    M = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for m in range(3):
                M[i, k] += B[i, m] * A[k, m]
    log_of(M, v)


@compiled
def pose_all(theta, R_root, t, parents, offsets, R, c, axes):
    """Forward kinematics of the optimised joints (index 0: root): rotations, origins, perturbation axes (world)."""
    R_local, J = np.empty((3, 3)), np.empty((3, 3))
    for j in range(len(t)):
        R[j, 0], c[j, 0], axes[j, 0] = R_root[j], t[j], R_root[j]
        for a in range(theta.shape[1]):
            exp_and_jacobian(theta[j, a], R_local, J)
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
def patch_points(R, c, leg_chains, arms, shares, patch, points):
    """Positions of patch vertices, each skinned to the last two joints of its leg."""
    for j in range(len(R)):
        for n in range(len(patch)):
            chain = leg_chains[patch[n] // 2]
            for i in range(3):
                points[j, n, i] = 0.0
                for h in range(2):
                    joint, share = chain[len(chain) - 2 + h], shares[n, h]
                    if share > 0:
                        points[j, n, i] += share * c[j, joint, i]
                        for k in range(3):
                            points[j, n, i] += share * R[j, joint, i, k] * arms[n, h, k]


@compiled
def vertex_twist(R, chain, arms, shares, A):
    """Transposed Jacobian (12, 3) of a patch vertex in the twists (v, ω) of its leg's last two joints.

    Returns the number of rows used: six if the second joint has no weight.
    """
    for h in range(2):
        share, joint = shares[h], chain[len(chain) - 2 + h]
        if share == 0 and h == 1:
            return 6
        x = share * (R[joint, 0, 0] * arms[h, 0] + R[joint, 0, 1] * arms[h, 1] + R[joint, 0, 2] * arms[h, 2])
        y = share * (R[joint, 1, 0] * arms[h, 0] + R[joint, 1, 1] * arms[h, 1] + R[joint, 1, 2] * arms[h, 2])
        z = share * (R[joint, 2, 0] * arms[h, 0] + R[joint, 2, 1] * arms[h, 1] + R[joint, 2, 2] * arms[h, 2])
        at = 6 * h
        A[at : at + 6] = 0.0
        A[at, 0] = A[at + 1, 1] = A[at + 2, 2] = share
        A[at + 4, 0], A[at + 5, 0] = z, -y
        A[at + 3, 1], A[at + 5, 1] = -z, x
        A[at + 3, 2], A[at + 4, 2] = y, -x
    return 12


@compiled
def foot_map(c, axes, chain, T):
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
def factor_and_solve(diagonal, below, right, damping):
    """Solve a block tridiagonal system in place: block Cholesky, then forward and backward substitution.

    diagonal (time, n, n) and below (time - 1, n, n; rows of the next frame) are overwritten by the factors, right
    (time, n) by the solution. Diagonal entries are multiplied by 1 + `damping`. Raises LinAlgError where the matrix is
    not positive definite.
    """
    count, n = right.shape
    for j in range(count):
        for i in range(n):
            diagonal[j, i, i] *= 1.0 + damping
        D = np.linalg.cholesky(diagonal[j])
        diagonal[j] = D
        for i in range(n):
            for k in range(i):
                right[j, i] -= D[i, k] * right[j, k]
            right[j, i] /= D[i, i]
        if j + 1 < count:
            X = np.ascontiguousarray(below[j].T)  # becomes L⁻¹ times the coupling, row by row
            for i in range(n):
                for k in range(i):
                    factor = D[i, k]
                    for m in range(n):
                        X[i, m] -= factor * X[k, m]
                inverse = 1.0 / D[i, i]
                for m in range(n):
                    X[i, m] *= inverse
            below[j] = X.T
            diagonal[j + 1] -= np.dot(X.T, X)
            right[j + 1] -= np.dot(X.T, right[j])
    for j in range(count - 1, -1, -1):
        if j + 1 < count:
            right[j] -= np.dot(below[j].T, right[j + 1])
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                right[j, i] -= diagonal[j, k, i] * right[j, k]
            right[j, i] /= diagonal[j, i, i]
