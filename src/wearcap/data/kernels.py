"""Random numbers and rotations of many windows in one pass over memory: loops compiled for the CPU.

`draws.Draws`, `batch.between` and `batch.matrices` have the same in tensor operations, for other devices. Inner loops run over
joints that lie side by side in memory, which compilers turn into vector instructions.
"""

import numpy as np

from wearcap.geometry.compiled import compiled


def _mixed(bits):
    """SplitMix64's output function, as `draws._mixed`."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


mixed = compiled(_mixed, inline="always")


def _uniforms(seeds, name, found):
    """Uniform numbers of 24 bits, as `Draws.uniform`: one of every 64 bits; `found` "batch number"."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    for window in range(len(seeds)):
        state, row = mixed(np.uint64(seeds[window]) ^ np.uint64(name)), found[window]
        for place in range(len(row)):
            state += golden
            row[place] = np.float32(mixed(state) >> np.uint64(40)) * np.float32(2.0**-24)


def _normals(seeds, name, table, found):
    """Four normal numbers of every 64 bits, as `Draws.normal`; `found` "batch number", a multiple of four."""
    golden, low = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xFFFF)
    for window in range(len(seeds)):
        state, row = mixed(np.uint64(seeds[window]) ^ np.uint64(name)), found[window]
        for place in range(len(row) // 4):
            state += golden
            bits = mixed(state)
            row[4 * place] = table[np.intp(bits & low)]
            row[4 * place + 1] = table[np.intp((bits >> np.uint64(16)) & low)]
            row[4 * place + 2] = table[np.intp((bits >> np.uint64(32)) & low)]
            row[4 * place + 3] = table[np.intp(bits >> np.uint64(48))]


def _between(values, low, high, share, found):
    """Values "row value" between two rows each; `low`, `high` and `share` "place", `found` "place value"."""
    for place in range(len(low)):
        a, row, portion = values[low[place]], found[place], share[place]
        if portion > 0:
            b = values[high[place]]
            for number in range(len(row)):
                row[number] = a[number] + portion * (b[number] - a[number])
        else:
            for number in range(len(row)):
                row[number] = a[number]


def _matrices(quaternions, low, high, share, twins, mirrored, found):
    """Rotation matrices between two rows each; those of mirrored windows are their twins', mirrored left to right.

    `quaternions` "row 4 joint" (w, x, y, z of any length), `low`, `high` and `share` "batch time", `twins` "joint",
    `mirrored` "batch", `found` "batch time joint 9".
    """
    joints, one, two = quaternions.shape[2], np.float32(1), np.float32(2)
    q, R = np.empty((4, joints), np.float32), np.empty((9, joints), np.float32)
    for window in range(low.shape[0]):
        side = np.float32(-1) if mirrored[window] else one
        for frame in range(low.shape[1]):
            a, b, portion = quaternions[low[window, frame]], quaternions[high[window, frame]], share[window, frame]
            if portion > 0:
                rest = one - portion
                for j in range(joints):
                    w, x, y, z = np.float32(a[0, j]), np.float32(a[1, j]), np.float32(a[2, j]), np.float32(a[3, j])
                    v, i, k, m = np.float32(b[0, j]), np.float32(b[1, j]), np.float32(b[2, j]), np.float32(b[3, j])
                    near = portion if w * v + x * i + y * k + z * m >= 0 else -portion
                    q[0, j], q[1, j] = rest * w + near * v, rest * x + near * i
                    q[2, j], q[3, j] = rest * y + near * k, rest * z + near * m
            else:
                for j in range(joints):
                    q[0, j], q[1, j] = np.float32(a[0, j]), np.float32(a[1, j])
                    q[2, j], q[3, j] = np.float32(a[2, j]), np.float32(a[3, j])
            for j in range(joints):
                w, x, y, z = q[0, j], side * q[1, j], q[2, j], side * q[3, j]
                double = two / (w * w + x * x + y * y + z * z)
                xs, ys, zs = double * x, double * y, double * z
                R[0, j], R[1, j], R[2, j] = one - (y * ys + z * zs), x * ys - w * zs, x * zs + w * ys
                R[3, j], R[4, j], R[5, j] = x * ys + w * zs, one - (x * xs + z * zs), y * zs - w * xs
                R[6, j], R[7, j], R[8, j] = x * zs - w * ys, y * zs + w * xs, one - (x * xs + y * ys)
            entries = found[window, frame]
            for j in range(joints):
                row = entries[twins[j] if mirrored[window] else j]
                for entry in range(9):
                    row[entry] = R[entry, j]


uniforms = compiled(_uniforms)
normals = compiled(_normals)
between = compiled(_between)
matrices = compiled(_matrices)
