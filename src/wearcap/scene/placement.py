"""Objects' initial poses corrected by the scan (ours): people measure where an object stands to centimetres, the scan
holds it to millimetres."""

import numpy as np
import torch
from jaxtyping import Float64

from wearcap.geometry import rotation
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.scene.objects import Environment, SceneObject
from wearcap.scene.scan import Box, Scan, SlicedCloud

PRIOR = np.array([0.02, 0.02, 0.005, np.deg2rad(2.0)])
"""Deviations of measured poses: position (m), and angle about the vertical (rad)."""
REACH_M = 0.08
"""Distance (m) from an object's surface within which scanned points may be its own."""
CLEARANCE_M = 0.03
"""Height (m) above an object's lowest point below which points are the floor's."""
SCALES_M = np.geomspace(0.03, 0.006, 20)
"""Robust scales (m) of the distances in the iterations."""
MOST_POINTS, INDEPENDENT = 4000, 100.0
"""Points of an object that are looked at, and how many of these count as independent."""


def placed_on_scan(environment: Environment, scan: Scan) -> Environment:
    """The environment with each object where the scan shows it, moved upright by centimetres and a few degrees; its hinge
    moves along.

    Objects of which the scan shows nothing stay where they were measured.
    """
    cloud = SlicedCloud(scan.points)
    return Environment(tuple(_placed(item, scan, cloud) for item in environment.objects))


def _placed(item: SceneObject, scan: Scan, cloud: SlicedCloud) -> SceneObject:
    """One object at the least robust sum of distances from the scanned points near it, and of the prior.

    Gauss-Newton in (x, y, z, yaw) about the middle of its box: a point at distance d along the surface's direction n
    comes nearer by n · (δ + δ_yaw e_z × r).
    """
    low, high = item.box_world
    middle = (low + high) / 2
    box = Box(tuple(middle.tolist()), tuple((high - low + 2 * REACH_M).tolist()))
    points = scan.points[cloud.in_box(box)].astype(np.float64)
    points = points[points[:, 2] > low[2] + CLEARANCE_M]
    points = points[:: max(1, len(points) // MOST_POINTS)]
    if not len(points):
        return item
    surface, moved = TriangleIndex.of(item.mesh), np.zeros(4)
    R, t = item.R_world_object.double().numpy(), item.t_world_object.double().numpy()
    for scale in SCALES_M:
        turn = _about_z(moved[3])
        R_now, t_now = turn @ R, middle + moved[:3] + turn @ (t - middle)
        local = (points - t_now) @ R_now
        distance, nearest = surface.nearest(local)
        near = distance < REACH_M
        away = (local[near] - nearest[near]) @ R_now.T
        normal = away / np.maximum(distance[near], 1e-9)[:, None]
        lever = points[near] - away - middle - moved[:3]
        jacobian = np.column_stack([normal, normal[:, 1] * lever[:, 0] - normal[:, 0] * lever[:, 1]])
        weight = 1 / (1 + (distance[near] / scale) ** 2) ** 2 / scale**2
        weight *= min(1.0, INDEPENDENT / max(near.sum(), 1))
        system = (jacobian * weight[:, None]).T @ jacobian + np.diag(PRIOR**-2)
        moved += np.linalg.solve(system, jacobian.T @ (weight * distance[near]) - moved / PRIOR**2)
    return item.displaced(*map(torch.from_numpy, (_about_z(moved[3]), middle, middle + moved[:3])))


def _about_z(angle: float) -> Float64[np.ndarray, "3 3"]:
    return rotation.about_axis("z", torch.tensor(angle, dtype=torch.float64)).numpy()
