"""Distances between a captured body and scans: of standing feet (thesis Table 4.3), of the whole body (Tables 4.1, 4.2).

"Bidirectional Chamfer distance between the SMPL model and the ground truth point cloud, without Procrustes
alignment" (thesis §4.5.1): the thesis gives no formula. Ours is the mean of the two directions' mean (not squared)
distances. Inputs in metres, results in centimetres, as in the tables.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.body.model import FOOT_REGIONS, BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex
from wearcap.geometry.triangle_distance import TriangleIndex


@dataclass(frozen=True)
class FootSurface:
    """Scores of contacting feet against the scan; NaN without contact near it."""

    distance_cm: float
    """Mean signed point-to-plane distance, positive above the surface (the table's distance to surface)."""
    absolute_distance_cm: float
    """Mean absolute point-to-plane distance: penetration and floating do not cancel."""
    sliding_cm: float
    """Mean displacement along the surface plane per frame."""
    contacts: int
    """Number of pairs of frame and vertex in contact."""
    off_scan: int
    """Number of these pairs without a surface within the index's reach, which are not scored."""


def foot_surface(
    points: Float[Tensor, "time vertex 3"], contact: Bool[Tensor, "time vertex"], surface: SurfaceIndex
) -> FootSurface:
    """Signed distance to the local scan plane and foot sliding, over vertices in contact (world, m).

    Sliding counts pairs of frames with contact in both; the displacement is projected onto the plane below its start.
    Contacts far from the scan (a drifted tracker) have no plane and count as `off_scan`.
    """
    points = points.detach().cpu().double()
    contact = contact.cpu()
    origin, normal = torch.full_like(points, torch.nan), torch.full_like(points, torch.nan)
    touching = points[contact]
    planes = surface.plane(touching.numpy())
    origin[contact], normal[contact] = (torch.from_numpy(part) for part in planes)
    distance = ((points - origin) * normal).sum(-1)[contact]
    on_scan = distance.isfinite()
    step = points.diff(dim=0)
    along = step - (step * normal[:-1]).sum(-1, keepdim=True) * normal[:-1]
    slide = along.norm(dim=-1)[contact[1:] & contact[:-1]]
    return FootSurface(
        100 * float(distance[on_scan].mean()),
        100 * float(distance[on_scan].abs().mean()),
        100 * float(slide[slide.isfinite()].mean()),
        int(contact.sum()),
        int((~on_scan).sum()),
    )


def foot_vertices(
    body: BodyModel, T_world_joint: Rigid, contact: Bool[Tensor, "time patch"]
) -> tuple[Float[Tensor, "time vertex 3"], Bool[Tensor, "time vertex"]]:
    """Vertices of the foot patches (m) and their contacts; patches in the order of `FOOT_PATCHES`. Raises WearcapError
    when contacts and poses differ in length."""
    if len(contact) != len(T_world_joint.t):
        what = f"contacts of {len(contact)} frames for poses of {len(T_world_joint.t)}"
        raise WearcapError(what, expected="as many of either")
    vertices = [body.vertices(T_world_joint, FOOT_REGIONS[patch]) for patch in FOOT_PATCHES]
    touching = [contact[:, i, None].expand(-1, part.shape[1]) for i, part in enumerate(vertices)]
    return torch.cat(vertices, 1), torch.cat(touching, 1)


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
