"""Distances between a captured body and scans (thesis Tables 4.1, 4.2).

"Bidirectional Chamfer distance between the SMPL model and the ground truth point cloud, without Procrustes
alignment" (thesis §4.5.1): the thesis gives no formula. Ours is the mean of the two directions' mean (not squared)
distances. Inputs in metres, results in centimetres, as in the tables.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.triangle_distance import TriangleIndex


@dataclass(frozen=True)
class Chamfer:
    """Mean distances (cm) in both directions."""

    cloud_to_body_cm: float
    body_to_cloud_cm: float

    @property
    def mean_cm(self) -> float:
        """The bidirectional distance."""
        return 0.5 * (self.cloud_to_body_cm + self.body_to_cloud_cm)


def chamfer(
    vertices: Float[Tensor, "vertex 3"],
    cloud: Float[Tensor, "point 3"],
    *,
    faces: Int64[Tensor, "face 3"] | None = None,
) -> Chamfer:
    """Bidirectional Chamfer distance of one frame, without alignment.

    Without `faces`: the literal form, vertices to points both ways, biased by the spacing of vertices. With `faces`
    (ours, the better default): points are measured to the surface. In the other direction soles and armpits, which no
    camera sees, add a constant. Raises WearcapError for an empty cloud, no vertex, or NaN.
    """
    body, points = vertices.detach().cpu().double().numpy(), cloud.detach().cpu().double().numpy()
    for name, rows in (("the body", body), ("the cloud", points)):
        if not len(rows) or not np.isfinite(rows).all():
            what = f"{name} has {len(rows)} points" + (", some of them NaN or infinite" if len(rows) else "")
            raise WearcapError(what, expected="at least one point, all finite")
    if faces is None:
        to_body, _ = KDTree(body).query(points)
    else:
        to_body, _ = TriangleIndex.build(body, faces.cpu().numpy()).nearest(points)
    to_cloud, _ = KDTree(points).query(body)
    return Chamfer(100 * float(np.mean(to_body)), 100 * float(np.mean(to_cloud)))
