"""From where a person is filmed: directions from which no object hides the body, changed as little as possible."""

import math

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from wearcap.geometry.mesh import Mesh

CANDIDATES = 16
"""Directions around the person that are tried."""
KEY_S, SMOOTH_S = 0.5, 0.6
"""Time between tries, and deviation of the Gaussian that smooths the camera's path (s)."""
TURN_COST, AWAY_COST = 0.05, 0.004
"""Share of the body that may be hidden rather than turning by one direction, and rather than looking from one direction
beside the wanted one for the time of a try."""
MOST_FACES = 2000
"""Objects with more faces count as their boxes."""


def azimuths(
    bodies: list[Float[np.ndarray, "joint 3"]],
    objects: list[list[Mesh]],
    wanted_rad: float,
    tilt: float,
    distance: float,
) -> Float[np.ndarray, "key"]:
    """Azimuth (rad) of the viewing direction at each key: the cheapest path over the share of hidden joints, turns, and
    the distance from the wanted azimuth. `tilt`: the direction's vertical part, its horizontal part having length 1."""
    steps = np.arange(CANDIDATES) - CANDIDATES // 2
    angles = wanted_rad + 2 * math.pi * steps / CANDIDATES
    directions = np.stack([np.cos(angles), np.sin(angles), np.full(CANDIDATES, tilt)], -1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cost = np.array([_hidden(body, around, directions, distance) for body, around in zip(bodies, objects)])
    cost += AWAY_COST * np.abs(steps)
    turn = TURN_COST * np.abs(steps[:, None] - steps[None, :])
    best, back = cost[0], []
    for row in cost[1:]:
        reached = best[None, :] + turn
        back.append(reached.argmin(1))
        best = row + reached.min(1)
    path = [int(best.argmin())]
    for row in reversed(back):
        path.append(int(row[path[-1]]))
    return angles[path[::-1]]


def smoothed(
    keys: Float[np.ndarray, "key"], key_times: Float[np.ndarray, "key"], times: Float[np.ndarray, "time"]
) -> Float[np.ndarray, "time"]:
    """Azimuths (rad) at all times, smooth between those at the keys."""
    even = gaussian_filter1d(keys, SMOOTH_S / KEY_S, mode="nearest")
    return np.interp(times, key_times, even)


def _hidden(
    body: Float[np.ndarray, "joint 3"],
    objects: list[Mesh],
    directions: Float[np.ndarray, "direction 3"],
    distance: float,
) -> Float[np.ndarray, "direction"]:
    """Share of the joints that a triangle hides, seen from a distance (m) against each direction."""
    corners = [_corners(mesh) for mesh in objects]
    centre = body.mean(0)
    a, b, c = np.concatenate([np.zeros((0, 3, 3)), *corners]).transpose(1, 0, 2)
    near = np.linalg.norm(np.stack([a, b, c]) - centre, axis=-1).min(0) < distance + 1.0
    a, u, v = a[near], (b - a)[near], (c - a)[near]
    shares = []
    for direction in directions:
        eye = centre - distance * direction
        ray = body - eye  # Möller and Trumbore 1997, all joints against all triangles
        p = np.cross(ray[:, None], v[None])
        det = (p * u).sum(-1)
        inverse = 1 / np.where(np.abs(det) < 1e-12, np.inf, det)
        s = eye - a
        first = (p * s).sum(-1) * inverse
        q = np.cross(s, u)
        second = (ray[:, None] * q).sum(-1) * inverse
        along = (q * v).sum(-1) * inverse
        hit = (first >= 0) & (second >= 0) & (first + second <= 1) & (along > 0) & (along < 0.97)
        shares.append(hit.any(1).mean() if len(a) else 0.0)
    return np.array(shares)


def _corners(mesh: Mesh) -> Float[np.ndarray, "face 3 3"]:
    """Triangles of a mesh, or of its box where it has more than `MOST_FACES`."""
    if len(mesh.faces) <= MOST_FACES:
        return mesh.vertices[mesh.faces].astype(np.float64)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    corner = np.array([[low, high][k >> axis & 1][axis] for k in range(8) for axis in range(3)]).reshape(8, 3)
    quads = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return np.array([corner[[q[0], *q[side : side + 2]]] for q in quads for side in (1, 2)])
