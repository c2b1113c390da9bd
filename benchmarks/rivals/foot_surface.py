"""How standing feet meet a scan (HPS thesis Table 4.3): their distance from its surface, and how far they slide on it.

Inputs in metres, results in centimetres, as in the table.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.model import FOOT_REGIONS, BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex


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
