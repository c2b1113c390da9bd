"""Compiled solution of block tridiagonal systems."""

import numpy as np

from wearcap.geometry.compiled import compiled


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
            # Only unknowns of the next frame that are coupled to this one count: a foot in the air has none.
            coupled = np.flatnonzero(np.array([below[j, m].any() for m in range(n)]))
            X = np.ascontiguousarray(below[j][coupled].T)  # becomes L⁻¹ times the coupling, row by row
            for i in range(n):
                for k in range(i):
                    factor = D[i, k]
                    if factor != 0.0:
                        for m in range(len(coupled)):
                            X[i, m] -= factor * X[k, m]
                inverse = 1.0 / D[i, i]
                for m in range(len(coupled)):
                    X[i, m] *= inverse
            square, pull = np.dot(X.T, X), np.dot(X.T, right[j])
            for a in range(len(coupled)):
                below[j, coupled[a]] = X[:, a]
                right[j + 1, coupled[a]] -= pull[a]
                for b in range(len(coupled)):
                    diagonal[j + 1, coupled[a], coupled[b]] -= square[a, b]
    for j in range(count - 1, -1, -1):
        if j + 1 < count:
            right[j] -= np.dot(below[j].T, right[j + 1])
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                right[j, i] -= diagonal[j, k, i] * right[j, k]
            right[j, i] /= diagonal[j, i, i]
