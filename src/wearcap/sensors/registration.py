"""Registration of a point cloud to the scanned scene by coarse-to-fine ICP, with a quality report."""

from dataclasses import dataclass

import numpy as np
import small_gicp
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid

_FEWEST = 100
"""Fewest points for a registration."""
_SHARE = 0.05
"""Share of the cloud that must lie near the scene in every stage."""
_INSIDE_M = 0.05
"""The report counts points of the cloud within this of the scene's."""
_ROOM_M = 1.5
"""Margin around the cloud within which the scene is used."""
_NORMAL_NEIGHBORS = 12


@dataclass(frozen=True)
class Stage:
    """One pass of ICP: both clouds thinned to voxels, pairs no further apart than `reach_m`."""

    voxel_m: float
    reach_m: float


STAGES = (Stage(0.1, 0.6), Stage(0.06, 0.25), Stage(0.03, 0.06))
"""From a pose some 30 cm and 8° off, as visual localisation at worst gives, to the scan's own noise (ours)."""


@dataclass(frozen=True)
class Registration:
    """Pose of a cloud found by ICP, with its quality."""

    T_scene_cloud: Rigid
    """Pose of the cloud in the scene (float64)."""
    fitness: float
    """Share of the cloud (in voxels of the last stage) within 5 cm of a scene point."""
    rmse_m: float
    """Root mean square distance of those to the scene's local plane."""
    least_seen: float
    """Share of surface (0 … 1/3) that faces the direction least faced: near 0 the cloud can slide that way."""
    converged: bool

    @property
    def summary(self) -> str:
        """One line for the log."""
        doubt = "" if self.least_seen > 0.01 else ", may slide: hardly any surface faces one direction"
        return (
            f"fitness {100 * self.fitness:.1f} %, RMSE {1000 * self.rmse_m:.1f} mm"
            f"{'' if self.converged else ', not converged'}{doubt}"
        )


def register(
    cloud: Float[np.ndarray, "point 3"],
    scene: Float[np.ndarray, "scene_point 3"],
    T_scene_cloud: Rigid,
    stages: tuple[Stage, ...] = STAGES,
) -> Registration:
    """Point-to-plane ICP of a cloud (m, its own axes) to the scene (m) from an approximate pose.

    Raises WearcapError when cloud and scene hardly overlap, or either is empty or has NaN.
    """
    points = _finite(cloud, "the cloud to register")
    pose, converged = T_scene_cloud.to(torch.float64).matrix().numpy(), False
    near = _near(_finite(scene, "the scene"), points, pose, stages[-1].voxel_m)
    for stage in stages:
        target, tree = small_gicp.preprocess_points(near, stage.voxel_m, _NORMAL_NEIGHBORS)
        source = small_gicp.voxelgrid_sampling(points, stage.voxel_m)
        result = small_gicp.align(
            target,
            source,
            tree,
            pose,
            "PLANE_ICP",
            max_correspondence_distance=stage.reach_m,
            max_iterations=40,
            rotation_epsilon=1e-4,
            translation_epsilon=1e-4,
        )
        if result.num_inliers < _SHARE * source.size():
            raise _no_overlap(stage.reach_m)
        pose, converged = np.array(result.T_target_source), result.converged
    return _report(points, near, pose, converged, stages[-1].voxel_m)


def _near(scene: np.ndarray, points: np.ndarray, pose: np.ndarray, voxel_m: float) -> np.ndarray:
    """The scene around the cloud's approximate pose, thinned to the finest voxels."""
    placed = _moved(points, pose)
    inside = ((scene > placed.min(0) - _ROOM_M) & (scene < placed.max(0) + _ROOM_M)).all(1)
    if inside.sum() < _FEWEST:
        raise _no_overlap(_ROOM_M)
    return small_gicp.voxelgrid_sampling(scene[inside].astype(np.float64), voxel_m).points()[:, :3]


def _report(points: np.ndarray, near: np.ndarray, pose: np.ndarray, converged: bool, voxel_m: float) -> Registration:
    target, _ = small_gicp.preprocess_points(near, voxel_m, _NORMAL_NEIGHBORS)
    thin = small_gicp.voxelgrid_sampling(points, voxel_m).points()[:, :3]
    placed = _moved(thin, pose)
    distance, index = KDTree(target.points()[:, :3]).query(placed)
    inside = distance < _INSIDE_M
    normals = target.normals()[index[inside], :3]
    to_plane = ((placed[inside] - target.points()[index[inside], :3]) * normals).sum(1)
    facing = np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))
    return Registration(
        Rigid.from_matrix(torch.from_numpy(pose)),
        float(inside.mean()),
        float(np.sqrt(np.mean(to_plane**2))) if inside.any() else float("nan"),
        float(facing[0]),
        converged,
    )


def _moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _finite(points: np.ndarray, name: str) -> Float[np.ndarray, "point 3"]:
    if len(points) < _FEWEST or not np.isfinite(points).all():
        raise WearcapError(
            f"{name} has {len(points)} points, or some are NaN", expected=f"at least {_FEWEST} finite points (m)"
        )
    return points.astype(np.float64)


def _no_overlap(reach_m: float) -> WearcapError:
    return WearcapError(
        f"hardly any of the cloud lies within {100 * reach_m:.0f} cm of the scene",
        expected="an approximate pose, within some 30 cm and 8°",
        fix="Check the camera's pose, and that cloud and scene are both in metres.",
    )
