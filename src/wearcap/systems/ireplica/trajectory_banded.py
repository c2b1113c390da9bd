"""Second-order solver of the bending energy (ours), in time linear in the path's length.

The initial path is the unique minimum of a convex relaxation in which steps may also stretch, so no initial guess is
needed. Gauss-Newton steps follow, each one backward and one forward pass. Given a frame's position and its step's
turn, the rest of the path does not depend on what came before. So the least energy from a frame to the end is, to
second order, a quadratic form of these three numbers: the backward pass computes it for all frames (Riccati recursion),
with feedback gains from position and previous turn to the next turn. The forward pass feeds the current position back
into the turns, so errors do not accumulate over paths of kilometres.
"""

import numpy as np
import torch

from wearcap.geometry.compiled import compiled
from wearcap.optimize.losses import LOSSES
from wearcap.systems.hps.banded_kernels import NORM, reweight
from wearcap.systems.ireplica.trajectory import BendingProblem, BentPath, bent_path

TINY = 1e-12


@compiled
def _stretch_freely(step, link, last_link, first, share, target, weight, distance, loss, delta, free_start, place, z):
    """Solve the convex relaxation in which a step may also stretch: complex factors z instead of turns.

    Minimises ½ Σ weight ρ'(distance) / distance |place − target|² + Σ link |z − previous z|² exactly, with the losses'
    tips smoothed by `RELAXED_M`, and fills z (step) and place (time), both complex; place[0] is the start. Control
    points of step s are first[s] … first[s + 1] − 1, their distances (m) those of the previous solution.
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
            w = 0.5 * weight[i] * _control_form(distance[i] ** 2, loss, delta, RELAXED_M)[1]
            part = share[i] * d
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
def _link_form(change, link):
    """(energy of a link, its curvature, change wrapped to ±π)."""
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    return link * change * change, 2 * link, change


@compiled
def _control_form(square, loss, delta, smooth):
    """(ρ of a squared distance, its weight in reweighted least squares); a norm's tip is smoothed in both."""
    rho, weight = reweight(square, loss, delta, smooth)
    return (1.0 / weight if loss == NORM else rho), weight


@compiled
def _energy(turn, place, link, last_link, first, share, target, weight, kinds, smooth):
    """(control, bending) energy of a path; `kinds`: loss, its delta; `smooth` in m."""
    loss, delta = kinds
    control, bending, before = 0.0, 0.0, 0.0
    for s in range(len(turn)):
        if not np.isinf(link[s]):
            bending += _link_form(turn[s] - before, link[s])[0]
        before = turn[s]
        for i in range(first[s], first[s + 1]):
            x = place[s, 0] + share[i] * (place[s + 1, 0] - place[s, 0]) - target[i, 0]
            y = place[s, 1] + share[i] * (place[s + 1, 1] - place[s, 1]) - target[i, 1]
            control += weight[i] * _control_form(x * x + y * y, loss, delta, smooth)[0]
    return control, bending + _link_form(before, last_link)[0]


@compiled
def _value_pass(turn, place, link, last_link, first, share, target, weight, kinds, smooth, damping, gains):
    """Fill gains (step, 4): each turn's change as a linear function of the changes (x, y, previous turn) and 1.

    Returns the quadratic form (xx, xy, yy, x, y) of the least energy in the change of the first point.
    """
    loss, delta = kinds
    count = len(turn)
    xx, xy, yy, xt, yt, gx, gy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    _, tt, off = _link_form(turn[count - 1], last_link)
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
            w = weight[i] * _control_form(rx * rx + ry * ry, loss, delta, smooth)[1]
            ix, iy = u * jx, u * jy
            xx, yy = xx + w, yy + w
            xt, yt, tt = xt + w * ix, yt + w * iy, tt + w * (ix * ix + iy * iy)
            gx, gy, gt = gx + w * rx, gy + w * ry, gt + w * (ix * rx + iy * ry)
        if np.isinf(link[s]):
            gains[s, 0], gains[s, 1], gains[s, 2], gains[s, 3] = 0.0, 0.0, 1.0, 0.0
            continue
        _, k, off = _link_form(turn[s] - (turn[s - 1] if s > 0 else 0.0), link[s])
        pull = k * off
        force, rest = gt + pull, tt + damping * (tt + k) + TINY
        whole = k + rest
        gains[s, 0], gains[s, 1], gains[s, 2], gains[s, 3] = (-xt / whole, -yt / whole, k / whole, -force / whole)
        xx, xy, yy = xx - xt * xt / whole, xy - xt * yt / whole, yy - yt * yt / whole
        gx, gy = gx - xt * force / whole, gy - yt * force / whole
        xt, yt, tt, gt = xt * k / whole, yt * k / whole, k * rest / whole, k * force / whole - pull
    return xx, xy, yy, gx, gy


@compiled
def _walk(turn, place, step, gains, share, shift, new_turn, new_place):
    """Roll out a new path: each turn changes by the gains applied to the offset from the old path so far. `share`
    scales the constant part of the gains (step length); `shift` (2) moves the first point."""
    new_place[0] = place[0] + shift
    change = 0.0
    for s in range(len(turn)):
        x, y = new_place[s, 0] - place[s, 0], new_place[s, 1] - place[s, 1]
        change = gains[s, 0] * x + gains[s, 1] * y + gains[s, 2] * change + share * gains[s, 3]
        new_turn[s] = turn[s] + change
        cosine, sine = np.cos(new_turn[s]), np.sin(new_turn[s])
        new_place[s + 1, 0] = new_place[s, 0] + cosine * step[s, 0] - sine * step[s, 1]
        new_place[s + 1, 1] = new_place[s, 1] + sine * step[s, 0] + cosine * step[s, 1]


RELAXED_PASSES = 3
RELAXED_M = 0.3
"""Smoothing of distances (m) in the relaxation."""


def bend_banded(
    problem: BendingProblem,
    iterations: int = 60,
    smooth_start: float = 0.1,
    smooth_end: float = 1e-5,
    tolerance: float = 1e-6,
) -> BentPath:
    """Minimise eq. 5.2 by iteratively reweighted least squares with a decreasing smoothing of norms (m), until the
    relative decrease of the energy is below `tolerance` and the smoothing has reached its end."""
    path = _Path(problem)
    path.begin()
    smooth = smooth_start
    history, reason = [path.terms(0.0)], "all iterations done"
    best, least = path.state(), history[0]["total"]
    damping = 0.0
    for _ in range(iterations):
        before = path.terms(smooth)["total"]
        fell, damping = path.improve(smooth, damping, before)
        history.append(path.terms(0.0))
        if history[-1]["total"] < least:
            best, least = path.state(), history[-1]["total"]
        if fell <= (tolerance if smooth == smooth_end else 1e-2) * before:
            if smooth == smooth_end:
                reason = "converged"
                break
            smooth = max(smooth / 10, smooth_end)
    return bent_path(problem, *best, history, reason)


class _Path:
    """Arrays of a path during the optimisation, relative to its first point."""

    def __init__(self, problem: BendingProblem):
        settings, steps = problem.settings, len(problem.leader)
        self.free = settings.free_start
        self.step = np.ascontiguousarray(problem.step.numpy())
        seconds = problem.link_s.numpy()
        ends = settings.rigidity * settings.clamped_ends / seconds[[0, -1]]
        leads = problem.leader.numpy() == np.arange(steps)
        self.link = np.where(leads, settings.rigidity / seconds[:-1], np.inf)
        self.link[1 : problem.leader[0].item() + 1] = np.inf
        self.link[0], self.last_link = ends
        self.controls = (
            np.searchsorted(problem.control_step.numpy(), np.arange(steps + 1)),
            problem.control_share.numpy(),
            np.ascontiguousarray((problem.control_points - problem.path[0]).numpy()),
            problem.control_weights.numpy(),
        )
        loss = settings.loss
        self.kinds = (LOSSES.index(loss.kind), float(loss.delta))
        self.fixed = (self.link, self.last_link, *self.controls, self.kinds)
        self.turn, self.place = np.zeros(steps), (problem.path - problem.path[0]).numpy().copy()
        self.new_turn, self.new_place = np.empty_like(self.turn), np.empty_like(self.place)
        self.gains = np.empty((steps, 4))

    def state(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The turns φ (rad) and the shift of the first point (m)."""
        return torch.from_numpy(self.turn.copy()), torch.from_numpy(self.place[0].copy())

    def terms(self, smooth: float, turn: np.ndarray | None = None, place: np.ndarray | None = None) -> dict:
        """Energy by term of a path (default: the current one), with norms smoothed by `smooth`."""
        turn, place = self.turn if turn is None else turn, self.place if place is None else place
        control, bending = _energy(turn, place, *self.fixed, smooth)
        return {"control": control, "bending": bending, "total": control + bending}

    def begin(self) -> None:
        """Start from the reweighted relaxation, unless the original path has less energy."""
        first, share, target, weight = self.controls
        complex_target = target[:, 0] + 1j * target[:, 1]
        step = self.step[:, 0] + 1j * self.step[:, 1]
        place, z = np.zeros(len(step) + 1, dtype=complex), np.empty(len(step), dtype=complex)
        at = np.repeat(np.arange(len(step)), np.diff(first))
        distance = np.zeros(len(weight))
        for _ in range(RELAXED_PASSES):
            controls = first, share, complex_target, weight, distance
            _stretch_freely(step, self.link, self.last_link, *controls, *self.kinds, self.free, place, z)
            distance = abs(place[at] + share * (place[at + 1] - place[at]) - complex_target)
        self.gains[:] = 0.0
        turn = np.angle(z * np.conj(np.concatenate([z[:1], z[:-1]]))).cumsum() + np.angle(z[0])
        shift = np.array([place[0].real, place[0].imag])
        _walk(turn, self.place, self.step, self.gains, 0.0, shift, self.new_turn, self.new_place)
        if self.terms(0.0, self.new_turn, self.new_place)["total"] < self.terms(0.0)["total"]:
            self._take()

    def improve(self, smooth: float, damping: float, before: float) -> tuple[float, float]:
        """One Gauss-Newton step; returns the decrease of the smoothed energy, and the damping for the next step."""
        for _ in range(8):
            path = self.turn, self.place, *self.fixed
            xx, xy, yy, x, y = _value_pass(*path, smooth, damping, self.gains)
            shift = np.zeros(2)
            if self.free:
                ridge = 1e-9 * (xx + yy) + 1e-12
                shift = -np.linalg.solve([[xx + ridge, xy], [xy, yy + ridge]], [x, y])
            for share in (1.0, 0.5, 0.25):
                there = self.new_turn, self.new_place
                _walk(self.turn, self.place, self.step, self.gains, share, share * shift, *there)
                after = self.terms(smooth, *there)["total"]
                if after < before:
                    self._take()
                    return before - after, damping / 10 if damping > 1e-6 else 0.0
            damping = max(10 * damping, 1e-4)
        return 0.0, 0.0

    def _take(self) -> None:
        self.turn, self.new_turn = self.new_turn, self.turn
        self.place, self.new_place = self.new_place, self.place
