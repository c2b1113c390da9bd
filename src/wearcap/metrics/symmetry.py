"""Errors of objects that look the same from several sides: their symmetry, found from the surface, and ADD-S.

A box that is turned by 180° is where it was: measured plainly its vertices are a length off. Inputs in metres, results in
degrees and centimetres.
"""

from dataclasses import dataclass

import numpy as np
import torch
from einops import rearrange, reduce
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import exp, geodesic, quat_wxyz_from_matrix
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.metrics.objects import vertex_error_cm

SAME = 0.02
"""Share of the object's size (the diagonal of its box) within which a turn brings 95 % of its surface back to itself."""
STEPS = 24
"""Turns about an axis that must all do so for an object that is round about it."""
FEW = 10
"""A tenth of the points rules most turns out."""
EVERY = 5
"""ADD-S is the mean over every fifth point of an object's cloud."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rotations about an object's centre, in its own axes, that leave its surface where it is."""

    turns: Float[Tensor, "turn 3 3"]
    """The identity among them."""
    axes: Float[Tensor, "axis 3"]
    """Axes about which every turn does so: none of a suitcase, one of a bottle, three of a ball."""
    center: Float[Tensor, "3"]
    """Where all turns meet, in the mesh's axes (m)."""

    @classmethod
    def of(cls, mesh: Mesh, points: Float[Tensor, "point 3"], surface: TriangleIndex) -> "Symmetry":
        """Found by trial: turns by quarters and thirds of the object's own and of its principal axes.

        `points` lie on the mesh's surface, evenly by area.
        """
        cloud = points.double().numpy()
        center, principal = _center_and_axes(mesh)
        allowed = SAME * float(np.linalg.norm(np.ptp(cloud, axis=0)))

        def kept(R: Float64[np.ndarray, "3 3"]) -> bool:
            for part in (cloud[::FEW], cloud):
                distance, _ = surface.nearest(np.ascontiguousarray((part - center) @ R.T + center))
                if np.percentile(distance, 95) > allowed:
                    return False
            return True

        turns = [
            frame.T @ R @ frame for frame in (np.eye(3), principal) for R in Rotation.create_group("O").as_matrix()
        ]
        turns = [R for R in turns if kept(R)]
        steps = 2 * np.pi / STEPS * np.arange(1, STEPS)
        axes: list[Float64[np.ndarray, "3"]] = []
        for axis in (*np.eye(3), *principal):
            known = any(abs(axis @ other) > 0.97 for other in axes)
            if not known and all(kept(R) for R in Rotation.from_rotvec(steps[:, None] * axis).as_matrix()):
                axes.append(axis)
        found = np.stack(turns), np.array(axes).reshape(-1, 3), center
        return cls(*(torch.from_numpy(part) for part in found))

    def alike(self, T_world_mesh: Rigid, R_reference: Float[Tensor, "*batch 3 3"]) -> Rigid:
        """All poses of the mesh that look the same, "*batch turn"; where they are a continuum, those of orientations that
        are nearest to a reference."""
        R, reference = T_world_mesh.R.double(), R_reference.double()
        if len(self.axes) > 1:
            turned = reference[..., None, :, :]
        else:
            turned = R[..., None, :, :] @ self.turns
            if len(self.axes):
                turned = turned @ _nearest_about(self.axes[0], turned.mT @ reference[..., None, :, :])
        center = T_world_mesh.t.double() + (R @ self.center[:, None])[..., 0]
        return Rigid(turned, center[..., None, :] - (turned @ self.center[:, None])[..., 0])

    def nearest(self, T_world_mesh: Rigid, R_reference: Float[Tensor, "*batch 3 3"]) -> Rigid:
        """The pose that looks the same as `T_world_mesh` and whose orientation is nearest to the reference."""
        alike = self.alike(T_world_mesh, R_reference)
        best = (alike.R * R_reference.double()[..., None, :, :]).sum((-1, -2)).argmax(-1, keepdim=True)
        R = alike.R.take_along_dim(best[..., None, None], -3)[..., 0, :, :]
        return Rigid(R, alike.t.take_along_dim(best[..., None], -2)[..., 0, :])

    def vertex_error_cm(
        self, T_found: Rigid, T_true: Rigid, vertices: Float[Tensor, "vertex 3"]
    ) -> Float[Tensor, "*batch"]:
        """E_v2v (cm) from the true pose or one that looks the same, whichever is nearest. Poses are of the mesh."""
        alike = self.alike(T_true, T_found.R)
        errors = [
            vertex_error_cm(
                T_found.to(torch.float64), Rigid(alike.R[..., k, :, :], alike.t[..., k, :]), vertices.double()
            )
            for k in range(alike.t.shape[-2])
        ]
        return torch.stack(errors).amin(0)

    def rotation_difference_deg(self, T_found: Rigid, T_true: Rigid) -> Float[Tensor, "*batch"]:
        """Smallest angle (degrees) between the captured and the true orientation, modulo the symmetry."""
        found, true = T_found.R.double()[..., None, :, :] @ self.turns, T_true.R.double()[..., None, :, :]
        if len(self.axes) > 1:
            return torch.zeros(found.shape[:-3], dtype=torch.float64)
        if len(self.axes) == 1:
            ends = [(R @ self.axes[0][:, None])[..., 0] for R in (found, true.expand_as(found))]
            away = torch.linalg.cross(*ends).norm(dim=-1)
            return torch.atan2(away, (ends[0] * ends[1]).sum(-1)).amin(-1).rad2deg()
        return geodesic(found, true.expand_as(found)).amin(-1).rad2deg()


def _nearest_about(axis: Float[Tensor, "3"], R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The turn about an axis that is nearest to a rotation: the twist of its quaternion."""
    quat_wxyz = quat_wxyz_from_matrix(R)
    angle = 2 * torch.atan2((quat_wxyz[..., 1:] * axis).sum(-1), quat_wxyz[..., 0])
    return exp(angle[..., None] * axis)


def _center_and_axes(mesh: Mesh) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"]]:
    """Centroid (m) of a surface, or of a cloud, and its principal axes, one per row."""
    corners = mesh.vertices.astype(np.float64)[
        mesh.faces if len(mesh.faces) else np.arange(len(mesh.vertices))[:, None]
    ]
    corners = np.broadcast_to(corners, (len(corners), 3, 3))
    weight = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = weight / weight.sum() if weight.sum() > 0 else np.full(len(corners), 1 / len(corners))
    center = weight @ corners.mean(1)
    inside = corners - center
    # Second moment of a triangle about the origin: (Σ corners ⊗ corners + 9 middle ⊗ middle) / 12 of its area
    spread = np.einsum("f,fki,fkj->ij", weight, inside, inside)
    spread += 9 * np.einsum("f,fi,fj->ij", weight, inside.mean(1), inside.mean(1))
    axes = np.linalg.eigh(spread)[1].T
    return center, axes * np.linalg.det(axes)


def closest_surface_error_cm(
    T_found: Rigid, T_true: Rigid, cloud: Float[Tensor, "point 3"], middle: Float[Tensor, "3"], surface: TriangleIndex
) -> Float[Tensor, "time"]:
    """ADD-S: mean distance (cm) of the captured object's points from the true object, whichever of its sides is near.

    The nearest point of the true surface counts, not the nearest of its vertices as in Hinterstoisser et al.: their
    spacing would add a constant. Poses are of the object's `middle`, to which `cloud` is relative.
    """
    T_true_found = T_true.to(torch.float64).inverse() @ T_found.to(torch.float64)
    points: Tensor = T_true_found[:, None] @ cloud[::EVERY].double()  # pyright: ignore[reportAssignmentType]
    distance, _ = surface.nearest(
        np.ascontiguousarray(rearrange((points + middle.double()).numpy(), "time point xyz -> (time point) xyz"))
    )
    return 100 * reduce(torch.from_numpy(distance), "(time point) -> time", "mean", time=len(points))
