"""Compiled passes over a path's steps: value function backwards, roll-out of the path forwards.

Given a frame's position and its step's turn, the rest of the path does not depend on what came before. So the least
energy from a frame to the end is, to second order, a quadratic form of these three numbers. One backward pass computes
it for all frames (Riccati recursion), with feedback gains from position and previous turn to the next turn.
"""

import numpy as np

from wearcap.geometry.compiled import compiled
from wearcap.optimize.banded_kernels import NORM, reweight

SQUARE = 0  # of trajectory.NORMS
TINY = 1e-12


@compiled
def stretch_freely(step, link, last_link, first, share, target, weight, free_start, place, z):
    """Solve the convex relaxation in which a step may also stretch: complex factors z instead of turns.

    Minimises Σ weight |place − target|² + Σ link |z − previous z|² exactly, and fills z (step) and place (time), both
    complex; place[0] is the start. Control points of step s are first[s] … first[s + 1] − 1.
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
            w, part = weight[i], share[i] * d
            a += w
            b += w * part
            c += w * abs(part) ** 2
            g += w * target[i]
            h += w * np.conj(part) * target[i]
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
    """(energy of a link, curvature of its quadratic approximation, change wrapped to ±π)."""
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    if norm == SQUARE:
        return link * change * change, 2 * link, change
    rounded = np.sqrt(change * change + smooth * smooth)
    return link * rounded, link / rounded, change


@compiled
def control_form(square, loss, delta, smooth):
    """(ρ of a squared distance, its weight in reweighted least squares); a norm's tip is smoothed in both."""
    rho, weight = reweight(square, loss, delta, smooth)
    return (1.0 / weight if loss == NORM else rho), weight


@compiled
def control_weights(distance, loss, delta, smooth):
    """Weights in reweighted least squares for distances (m)."""
    weights = np.empty_like(distance)
    for i in range(len(distance)):
        weights[i] = control_form(distance[i] ** 2, loss, delta, smooth)[1]
    return weights


@compiled
def energy(turn, place, link, last_link, first, share, target, weight, kinds, smooth):
    """(control, bending) energy of a path; `kinds`: norm of the links, loss, its delta; `smooth` in m and rad."""
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
    """Fill gains (step, 4): each turn's change as a linear function of the changes (x, y, previous turn) and 1.

    Returns the quadratic form (xx, xy, yy, x, y) of the least energy in the change of the first point.
    """
    norm, loss, delta = kinds
    count = len(turn)
    xx, xy, yy, xt, yt, gx, gy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    _, tt, off = link_form(turn[count - 1], last_link, norm, smooth)
    gt = tt * off
    for s in range(count - 1, -1, -1):
        ahead_x, ahead_y = place[s + 1, 0] - place[s, 0], place[s + 1, 1] - place[s, 1]
        jx, jy = -ahead_y, ahead_x  # derivative of the step's end in its turn
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
        gains[s, 0], gains[s, 1], gains[s, 2], gains[s, 3] = (-xt / whole, -yt / whole, k / whole, -force / whole)
        xx, xy, yy = xx - xt * xt / whole, xy - xt * yt / whole, yy - yt * yt / whole
        gx, gy = gx - xt * force / whole, gy - yt * force / whole
        xt, yt, tt, gt = xt * k / whole, yt * k / whole, k * rest / whole, k * force / whole - pull
    return xx, xy, yy, gx, gy


@compiled
def walk(turn, place, step, gains, share, shift, new_turn, new_place):
    """Roll out a new path: each turn changes by the gains applied to the offset from the old path so far.

    `share` scales the constant part of the gains (step length); `shift` (2) moves the first point.
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
