"""Registering a cloud to the scanned scene by iterative closest points, coarse to fine, with a report."""

from dataclasses import dataclass

import numpy as np
import small_gicp
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid

_FEWEST = 100
"""Points below which nothing can be registered."""
_INSIDE_M = 0.05
"""The report counts points of the cloud within this of the scene's planes."""


@dataclass(frozen=True)
class Stage:
    """One pass of ICP: both clouds thinned to voxels, pairs no further apart than `reach_m`."""

    voxel_m: float
    reach_m: float


STAGES = (Stage(0.08, 0.6), Stage(0.05, 0.25), Stage(0.03, 0.1), Stage(0.02, 0.05))
"""From a pose some 30 cm and 8° off, as visual localisation at worst gives, to the scan's own noise (ours)."""
FINE_STAGES = STAGES[1:]
"""For a pose that a person has already corrected."""


@dataclass(frozen=True)
class Registration:
    """Where ICP put a cloud, and how well it lies there."""

    T_scene_cloud: Rigid
    """float64."""
    fitness: float
    """Share of the cloud (in voxels of the last stage) within 5 cm of a scene point."""
    rmse_m: float
    """Root mean square distance of those to the scene's local plane."""
    least_seen: float
    """Share of surface (0 … 1/3) that faces the direction least faced: near 0 the cloud can slide that way."""
    moved_m: float
    """Largest shift of any point of the cloud from where it was given."""
    converged: bool

    @property
    def summary(self) -> str:
        """One line for the log."""
        doubt = "" if self.least_seen > 0.01 else ", may slide: hardly any surface faces one direction"
        return (
            f"fitness {100 * self.fitness:.1f} %, RMSE {1000 * self.rmse_m:.1f} mm, "
            f"moved {100 * self.moved_m:.1f} cm{'' if self.converged else ', not converged'}{doubt}"
        )


def register(
    cloud: Float[np.ndarray, "point 3"],
    scene: Float[np.ndarray, "scene_point 3"],
    T_scene_cloud: Rigid,
    *,
    correction: Rigid | None = None,
    stages: tuple[Stage, ...] = STAGES,
) -> Registration:
    """Point-to-plane ICP of a cloud (m, its own axes) to the scene (m) from an approximate pose.

    `correction`: what a person adds by hand after looking at the result, in scene axes (new = correction @ old);
    ICP then runs once more from there, with its finer stages (thesis §4.5.1: localisation, ICP, manual correction,
    ICP). Raises WearcapError when cloud and scene hardly overlap, or either is empty.
    """
    points = _finite(cloud, "the cloud to register")
    start = T_scene_cloud.to(torch.float64).matrix().numpy()
    pose, converged = _descend(points, _finite(scene, "the scene"), start, stages)
    if correction is not None:
        by_hand = correction.to(torch.float64).matrix().numpy() @ pose
        pose, converged = _descend(points, scene, by_hand, stages[1:] or stages)
    return _report(points, scene, start, pose, converged, stages[-1])


def _descend(
    points: np.ndarray, scene: np.ndarray, pose: np.ndarray, stages: tuple[Stage, ...]
) -> tuple[np.ndarray, bool]:
    """Pose (4, 4) after all stages, and whether the last one converged."""
    converged = False
    for stage in stages:
        target, tree, source = _thinned(points, scene, pose, stage)
        result = small_gicp.align(
            target, source, tree, pose, "PLANE_ICP", max_correspondence_distance=stage.reach_m,
            max_iterations=60, rotation_epsilon=1e-5, translation_epsilon=1e-5,
        )  # fmt: skip
        if result.num_inliers < _FEWEST:
            raise _no_overlap(stage.reach_m)
        pose, converged = result.T_target_source, result.converged
    return pose, converged


def _thinned(points: np.ndarray, scene: np.ndarray, pose: np.ndarray, stage: Stage) -> tuple:
    """The scene near the cloud with normals, its tree, and the cloud."""
    placed = points @ pose[:3, :3].T + pose[:3, 3]
    near = ((scene > placed.min(0) - stage.reach_m) & (scene < placed.max(0) + stage.reach_m)).all(1)
    if near.sum() < _FEWEST:
        raise _no_overlap(stage.reach_m)
    target, tree = small_gicp.preprocess_points(scene[near].astype(np.float64), stage.voxel_m, 12)
    return target, tree, small_gicp.voxelgrid_sampling(points, stage.voxel_m)


def _report(
    points: np.ndarray, scene: np.ndarray, start: np.ndarray, pose: np.ndarray, converged: bool, stage: Stage
) -> Registration:
    target, _, source = _thinned(points, scene, pose, stage)
    thin = source.points()[:, :3]
    placed = thin @ pose[:3, :3].T + pose[:3, 3]
    distance, index = KDTree(target.points()[:, :3]).query(placed)
    inside = distance < _INSIDE_M
    normals = target.normals()[index[inside], :3]
    to_plane = ((placed[inside] - target.points()[index[inside], :3]) * normals).sum(1)
    facing = np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))
    shift = placed - (thin @ start[:3, :3].T + start[:3, 3])
    return Registration(
        Rigid.from_matrix(torch.from_numpy(np.array(pose))), float(inside.mean()),
        float(np.sqrt(np.mean(to_plane**2))) if inside.any() else float("nan"),
        float(facing[0]), float(np.linalg.norm(shift, axis=1).max()), converged,
    )  # fmt: skip


def _finite(points: np.ndarray, name: str) -> Float[np.ndarray, "point 3"]:
    if len(points) < _FEWEST or not np.isfinite(points).all():
        raise WearcapError(f"{name} has {len(points)} points, or some are NaN",
                           expected=f"at least {_FEWEST} finite points (m)")  # fmt: skip
    return points.astype(np.float64)


def _no_overlap(reach_m: float) -> WearcapError:
    return WearcapError(
        f"fewer than {_FEWEST} points of the cloud lie within {100 * reach_m:.0f} cm of the scene",
        expected="an approximate pose, within some 30 cm and 8°",
        fix="Check the camera's pose, and that cloud and scene are both in metres; or give a correction by hand.",
    )
