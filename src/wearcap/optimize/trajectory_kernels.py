"""Compiled passes over a path's steps: value function backwards, steps of the path forwards.

A frame's position and its step's turn are all that the future sees of the past. So the least energy from a frame to
the end is, to second order, a quadratic form of these three numbers, and one pass from the end to the beginning
finds it for all frames (Riccati's recursion); it leaves, for each step, by how much to turn given where one is.
"""

import numpy as np

from wearcap.geometry.compiled import compiled
from wearcap.optimize.banded_kernels import NORM, reweight

SQUARE = 0  # of trajectory.NORMS
TINY = 1e-12


@compiled
def stretch_freely(step, link, last_link, first, share, target, weight, free_start, place, z):
    """The convex relaxation in which a step may also stretch: complex factors z instead of turns.

    Minimises Σ weight |place − target|² + Σ link |z − z before|² exactly, and fills z (step) and place (time), both
    complex; place[0] is the given start. Controls of step s are first[s] … first[s + 1] − 1.
    """
    count = len(step)
    # least energy beyond a step = a|p|² + 2 Re(p* b z) + c|z|² − 2 Re(g* p + h* z)
    a, c, b, g, h = 0.0, last_link, 0.0 + 0.0j, 0.0 + 0.0j, last_link + 0.0j
    gains = np.empty((count, 3), dtype=np.complex128)
    for s in range(count - 1, -1, -1):
        d = step[s]
        c += a * abs(d) ** 2 + 2 * (np.conj(d) * b).real
        b += a * d
        h += np.conj(d) * g
        for i in range(first[s], first[s + 1]):
            w, way = weight[i], share[i] * d
            a += w
            b += w * way
            c += w * abs(way) ** 2
            g += w * target[i]
            h += w * np.conj(way) * target[i]
        k = link[s]
        if np.isinf(k):
            gains[s, 0], gains[s, 1], gains[s, 2] = 0.0, 1.0, 0.0
            continue
        whole = c + k + TINY
        gains[s, 0], gains[s, 1], gains[s, 2] = -np.conj(b) / whole, (k + TINY) / whole, h / whole
        a -= abs(b) ** 2 / whole
        g -= b * h / whole
        b, c, h = b * k / whole, k * c / whole, k * h / whole
    if free_start and a > 1e-9:
        place[0] = (g - b) / a
    before = 1.0 + 0.0j
    for s in range(count):
        z[s] = gains[s, 0] * place[s] + gains[s, 1] * before + gains[s, 2]
        place[s + 1] = place[s] + z[s] * step[s]
        before = z[s]


@compiled
def link_form(change, link, norm, smooth):
    """(energy of a link, second derivative of the form that meets it, change wrapped to ±π)."""
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    if norm == SQUARE:
        return link * change * change, 2 * link, change
    rounded = np.sqrt(change * change + smooth * smooth)
    return link * rounded, link / rounded, change


@compiled
def control_form(square, loss, delta, smooth):
    """(ρ of a squared distance, weight of reweighted squares); a norm's tip is rounded in both."""
    rho, weight = reweight(square, loss, delta, smooth)
    return (1.0 / weight if loss == NORM else rho), weight


@compiled
def control_weights(distance, loss, delta, smooth):
    """Weights of reweighted squares for distances (m)."""
    weights = np.empty_like(distance)
    for i in range(len(distance)):
        weights[i] = control_form(distance[i] ** 2, loss, delta, smooth)[1]
    return weights


@compiled
def energy(turn, place, link, last_link, first, share, target, weight, kinds, smooth):
    """(control, bending) of a path; `kinds`: norm of the links, loss and its delta, rounding in m and rad."""
    norm, loss, delta = kinds
    control, bending, before = 0.0, 0.0, 0.0
    for s in range(len(turn)):
        if not np.isinf(link[s]):
            bending += link_form(turn[s] - before, link[s], norm, smooth)[0]
        before = turn[s]
        for i in range(first[s], first[s + 1]):
            x = place[s, 0] + share[i] * (place[s + 1, 0] - place[s, 0]) - target[i, 0]
            y = place[s, 1] + share[i] * (place[s + 1, 1] - place[s, 1]) - target[i, 1]
            control += weight[i] * control_form(x * x + y * y, loss, delta, smooth)[0]
    return control, bending + link_form(before, last_link, norm, smooth)[0]


@compiled
def value_pass(turn, place, link, last_link, first, share, target, weight, kinds, smooth, damping, gains):
    """Fill gains (step, 4): the change of each turn by (x, y, turn before, 1), these being changes themselves.

    Returns the second-order form (xx, xy, yy, x, y) of the least energy in the first point's change.
    """
    norm, loss, delta = kinds
    count = len(turn)
    xx, xy, yy, xt, yt, gx, gy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    _, tt, off = link_form(turn[count - 1], last_link, norm, smooth)
    gt = tt * off
    for s in range(count - 1, -1, -1):
        ahead_x, ahead_y = place[s + 1, 0] - place[s, 0], place[s + 1, 1] - place[s, 1]
        jx, jy = -ahead_y, ahead_x  # where the step's end goes as it turns
        tt += jx * (xx * jx + 2 * xy * jy + 2 * xt) + jy * (yy * jy + 2 * yt)
        xt += xx * jx + xy * jy
        yt += xy * jx + yy * jy
        gt += gx * jx + gy * jy
        for i in range(first[s], first[s + 1]):
            u = share[i]
            rx, ry = place[s, 0] + u * ahead_x - target[i, 0], place[s, 1] + u * ahead_y - target[i, 1]
            w = weight[i] * control_form(rx * rx + ry * ry, loss, delta, smooth)[1]
            ix, iy = u * jx, u * jy
            xx, yy = xx + w, yy + w
            xt, yt, tt = xt + w * ix, yt + w * iy, tt + w * (ix * ix + iy * iy)
            gx, gy, gt = gx + w * rx, gy + w * ry, gt + w * (ix * rx + iy * ry)
        if np.isinf(link[s]):
            gains[s, 0], gains[s, 1], gains[s, 2], gains[s, 3] = 0.0, 0.0, 1.0, 0.0
            continue
        _, k, off = link_form(turn[s] - (turn[s - 1] if s > 0 else 0.0), link[s], norm, smooth)
        pull = k * off
        force, rest = gt + pull, tt + damping * (tt + k) + TINY
        whole = k + rest
        gains[s, 0], gains[s, 1], gains[s, 2], gains[s, 3] = (
            -xt / whole,
            -yt / whole,
            k / whole,
            -force / whole,
        )
        xx, xy, yy = xx - xt * xt / whole, xy - xt * yt / whole, yy - yt * yt / whole
        gx, gy = gx - xt * force / whole, gy - yt * force / whole
        xt, yt, tt, gt = xt * k / whole, yt * k / whole, k * rest / whole, k * force / whole - pull
    return xx, xy, yy, gx, gy


@compiled
def walk(turn, place, step, gains, share, shift, new_turn, new_place):
    """Go the path anew: each step turns by its gains, given how far off the old path one is by then.

    `share` of what is gained without being off, `shift` of the first point (2).
    """
    new_place[0] = place[0] + shift
    change = 0.0
    for s in range(len(turn)):
        x, y = new_place[s, 0] - place[s, 0], new_place[s, 1] - place[s, 1]
        change = gains[s, 0] * x + gains[s, 1] * y + gains[s, 2] * change + share * gains[s, 3]
        new_turn[s] = turn[s] + change
        cosine, sine = np.cos(new_turn[s]), np.sin(new_turn[s])
        new_place[s + 1, 0] = new_place[s, 0] + cosine * step[s, 0] - sine * step[s, 1]
        new_place[s + 1, 1] = new_place[s, 1] + sine * step[s, 0] + cosine * step[s, 1]
