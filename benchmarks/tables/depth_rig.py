"""Depth cameras around a person (thesis §4.5.1): registered to the scene's scan, and the person's point cloud in it.

Depth images are uint16 millimetres along the optical axis, 0 for missing measurements, as Kinects give them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import small_gicp
import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt16
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import Splats, render
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex

CLUSTER_EPS_M = 0.12
"""DBSCAN's distance (thesis §4.5.1)."""
_CLUSTER_POINTS = 10
"""DBSCAN's minimum number of points of a core (ours: the thesis gives none)."""
_CLUSTER_VOXEL_M = 0.02
"""Points are clustered by voxel, each weighing as many as it holds: a sixth of eps, and a hundred times fewer."""
_SEEN_SHARE = 0.5
"""Smallest share of empty frames with a measurement for a background pixel to be valid."""
_FLICKER = 2.5
"""Largest relative deviation of a steady pixel, as a multiple of the camera's median one."""
_MARGIN_M, _DEVIATIONS = 0.01, 4.0
"""The person is at least this far before the background, and as many standard deviations of its pixel (ours)."""
_EDGE_M = 0.06
"""Pixels without two neighbours in this depth are flying pixels, between two surfaces, dropped before unprojection."""
_SPLAT_M = 0.02
"""Radius at which a scan's points hide what is behind them: its spacing, and some more."""
_BESIDE_M = 0.04
"""Points so near to a visible one are of the same surface."""
_FEWEST = 100
"""Fewest points for a registration."""
_SHARE = 0.05
"""Share of the cloud that must lie near the scene in every stage."""
_INSIDE_M = 0.05
"""A registration's fitness counts points of the cloud within this of the scene's."""
_ROOM_M = 1.5
"""Margin around the cloud within which the scene is used."""
_NORMAL_NEIGHBORS = 12
STAGES = ((0.1, 0.6), (0.06, 0.25), (0.03, 0.06))
"""Passes of ICP: both clouds are thinned to voxels of the first size (m), pairs are no further apart than the second.
From a pose some 30 cm and 8° off, as visual localisation at worst gives, to the scan's own noise (ours)."""


@dataclass(frozen=True, eq=False)
class Background:
    """Depth of the empty scene as seen by a fixed camera."""

    depth_m: Float[np.ndarray, "height width"]
    """Mean depth; infinite where nothing was measured."""
    deviation_m: Float[np.ndarray, "height width"]
    """Standard deviation over time."""

    @property
    def steady(self) -> Bool[np.ndarray, "height width"]:
        """Measured pixels that flicker no more than others at their depth: means along edges lie in mid-air."""
        valid = np.isfinite(self.depth_m) & ~_flying(self.depth_m)
        relative = np.where(valid, self.deviation_m / self.depth_m, np.inf)
        return valid & (relative <= _FLICKER * np.median(relative[valid])) if valid.any() else valid

    @classmethod
    def of(cls, frames_mm: UInt16[np.ndarray, "time height width"]) -> "Background":
        """Mean depth of an empty scene, of the frames that saw each pixel. Raises WearcapError without frames."""
        if not len(frames_mm):
            expected = "at least one depth image without the person"
            fix = "Record a few seconds of the scene before the person enters."
            raise WearcapError("no frames of the empty scene", expected=expected, fix=fix)
        seen = frames_mm > 0
        count = seen.sum(0)
        depth = frames_mm.astype(np.float32) / 1000
        mean = depth.sum(0) / np.maximum(count, 1)
        variance = (seen * (depth - mean) ** 2).sum(0) / np.maximum(count - 1, 1)
        valid = count >= _SEEN_SHARE * len(frames_mm)
        return cls(np.where(valid, mean, np.inf).astype(np.float32), np.sqrt(variance, dtype=np.float32))

    def foreground(self, depth_mm: UInt16[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
        """Pixels clearly before the empty scene's depth; all measured ones where the background gave none.

        Raises WearcapError when the sizes differ.
        """
        if depth_mm.shape != self.depth_m.shape:
            what = f"a depth image of shape {depth_mm.shape} and a background of {self.depth_m.shape}"
            raise WearcapError(what, expected="images of one camera")
        depth = depth_mm / np.float32(1000)
        before = depth < self.depth_m - (_MARGIN_M + _DEVIATIONS * self.deviation_m)
        return (depth_mm > 0) & before & ~_flying(depth)


@dataclass(frozen=True)
class _Registration:
    """Pose of a cloud found by ICP, with its quality."""

    T_scene_cloud: Rigid
    """Pose of the cloud in the scene (float64)."""
    fitness: float
    """Share of the cloud (in voxels of the last stage) within 5 cm of a scene point."""
    rmse_m: float
    """Root mean square distance of those to the scene's local plane."""
    least_seen: float
    """Share of surface (0 … 1/3) that faces the direction least faced: near 0 the cloud can slide in it."""
    converged: bool

    @property
    def summary(self) -> str:
        """One line for the log."""
        doubt = "" if self.least_seen > 0.01 else ", may slide: hardly any surface faces one direction"
        return (
            f"fitness {100 * self.fitness:.1f} %, RMSE {1000 * self.rmse_m:.1f} mm"
            f"{'' if self.converged else ', not converged'}{doubt}"
        )


def _unproject_depth(
    depth_m: Float[np.ndarray, "height width"], valid: Bool[np.ndarray, "height width"], camera: Camera
) -> Float[np.ndarray, "point 3"]:
    """Points (m, camera axes) of the valid pixels; the depth lies along the optical axis."""
    rays = _rays(camera)[valid]
    points = rays * depth_m[valid][:, None]
    return points[np.isfinite(points).all(1)].astype(np.float64)


def largest_cluster(points: Float[np.ndarray, "point 3"]) -> Bool[np.ndarray, "point"]:
    """Points of the DBSCAN cluster that holds most of them; none where all are noise."""
    if not len(points):
        return np.zeros(0, bool)
    centers, voxel = voxel_downsample(torch.from_numpy(points), _CLUSTER_VOXEL_M)
    rows: Int64[np.ndarray, "point"] = voxel.numpy()
    weight = np.bincount(rows)
    label = DBSCAN(eps=CLUSTER_EPS_M, min_samples=_CLUSTER_POINTS).fit_predict(centers.numpy(), sample_weight=weight)
    size = np.bincount(label + 1, weight)[1:]
    return (label == size.argmax())[rows] if len(size) else np.zeros(len(points), bool)


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth camera of the rig: lens, pose in the scene and its background."""

    camera: Camera
    T_world_cam: Rigid
    background: Background

    def registered(
        self, scene: Float32[np.ndarray, "scene_point 3"], correction: Rigid | None = None
    ) -> tuple["DepthView", _Registration]:
        """The camera at the pose that ICP of its empty depth image to the scene's scan (m) finds, and ICP's report.

        `T_world_cam` is the approximate pose, as visual localisation gives it. Where the result is wrong, a person
        gives it back with a `correction` in scene axes (new = correction @ old), and ICP starts from there: the
        thesis's localisation, ICP, manual correction, ICP. ICP runs twice, each time to the points that the camera
        would see from where it is thought to be: scans show walls from both sides, 10 cm apart.
        Raises WearcapError as `_register` does.
        """
        empty = self.background
        cloud = _unproject_depth(empty.depth_m, empty.steady, self.camera)
        pose = self.T_world_cam.to(torch.float64)
        if correction is not None:
            pose = correction.to(torch.float64) @ pose
        pose = _register(cloud, _visible_points(scene, pose), pose).T_scene_cloud
        result = _register(cloud, _visible_points(scene, pose), pose, STAGES[1:])
        return replace(self, T_world_cam=result.T_scene_cloud), result


def _register(
    cloud: Float[np.ndarray, "point 3"],
    scene: Float[np.ndarray, "scene_point 3"],
    T_scene_cloud: Rigid,
    stages: Sequence[tuple[float, float]] = STAGES,
) -> _Registration:
    """Point-to-plane ICP of a cloud (m, its own axes) to the scene (m) from an approximate pose.

    Raises WearcapError when cloud and scene hardly overlap, or either is empty or has NaN.
    """
    for points, name in ((cloud, "the cloud to register"), (scene, "the scene")):
        if len(points) < _FEWEST or not np.isfinite(points).all():
            what = f"{name} has {len(points)} points, or some are NaN"
            raise WearcapError(what, expected=f"at least {_FEWEST} finite points (m)")
    points, scene = cloud.astype(np.float64), scene.astype(np.float64)
    pose, converged = T_scene_cloud.to(torch.float64).matrix().numpy(), False
    placed, finest_m = _moved(points, pose), stages[-1][0]
    inside = ((scene > placed.min(0) - _ROOM_M) & (scene < placed.max(0) + _ROOM_M)).all(1)
    if inside.sum() < _FEWEST:
        raise _no_overlap(_ROOM_M)
    near = small_gicp.voxelgrid_sampling(scene[inside], finest_m).points()[:, :3]
    for voxel_m, reach_m in stages:
        target, tree = small_gicp.preprocess_points(near, voxel_m, _NORMAL_NEIGHBORS)
        source = small_gicp.voxelgrid_sampling(points, voxel_m)
        result = small_gicp.align(
            target,
            source,
            tree,
            pose,
            "PLANE_ICP",
            max_correspondence_distance=reach_m,
            max_iterations=40,
            rotation_epsilon=1e-4,
            translation_epsilon=1e-4,
        )
        if result.num_inliers < _SHARE * source.size():
            raise _no_overlap(reach_m)
        pose, converged = np.array(result.T_target_source), result.converged
    target, _ = small_gicp.preprocess_points(near, finest_m, _NORMAL_NEIGHBORS)
    placed = _moved(small_gicp.voxelgrid_sampling(points, finest_m).points()[:, :3], pose)
    distance, index = KDTree(target.points()[:, :3]).query(placed)
    inside = distance < _INSIDE_M
    normals = target.normals()[index[inside], :3]
    to_plane = ((placed[inside] - target.points()[index[inside], :3]) * normals).sum(1)
    facing = np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))
    rmse_m = float(np.sqrt(np.mean(to_plane**2))) if inside.any() else float("nan")
    T_scene_cloud = Rigid.from_matrix(torch.from_numpy(pose))
    return _Registration(T_scene_cloud, float(inside.mean()), rmse_m, float(facing[0]), converged)


def _visible_points(scene: Float32[np.ndarray, "scene_point 3"], T_world_cam: Rigid) -> Float32[np.ndarray, "point 3"]:
    """Points of a scan (m) that nothing hides from a camera at about this pose, within 100° (ours)."""
    wide = Camera.pinhole(500, 500, 100.0)
    splats = Splats(scene, np.ones(3, np.float32), _SPLAT_M, metric=True)
    index = np.unique(render(wide, T_world_cam, splats=[splats]).point_index)
    seen = scene[index[index >= 0]]
    if not len(seen):
        return seen
    near = scene[((scene > seen.min(0) - _BESIDE_M) & (scene < seen.max(0) + _BESIDE_M)).all(1)]
    # The points drawn are those that noise brought nearest to the camera: all beside them are taken.
    distance, _ = SurfaceIndex.build(seen).nearest(near.astype(np.float64), _BESIDE_M)
    return near[np.isfinite(distance)]


def person_cloud(
    depth_mm: Sequence[UInt16[np.ndarray, "height width"]], views: Sequence[DepthView]
) -> Float[np.ndarray, "point 3"]:
    """The person in the scene (m) at one instant: foreground of all cameras, merged, its largest cluster.

    `depth_mm`: one image per view. Empty where nobody is in sight. Raises WearcapError when the numbers differ.
    """
    if len(depth_mm) != len(views):
        raise WearcapError(f"{len(depth_mm)} depth images for {len(views)} cameras", expected="one for each")
    parts = []
    for image, view in zip(depth_mm, views):
        mask = view.background.foreground(image)
        points = torch.from_numpy(_unproject_depth(image / np.float32(1000), mask, view.camera))
        pose = view.T_world_cam.to(torch.float64)
        parts.append((points @ pose.R.T + pose.t).numpy())
    merged = np.concatenate(parts)
    return merged[largest_cluster(merged)]


def _flying(depth_m: np.ndarray) -> np.ndarray:
    """Pixels with fewer than two of their eight neighbours in the same depth: between two surfaces (ours)."""
    height, width = depth_m.shape
    padded = np.pad(depth_m, 1, constant_values=np.nan)
    near = np.zeros(depth_m.shape, np.int8)
    for dy in range(3):
        for dx in range(3):
            neighbor = padded[dy : dy + height, dx : dx + width]
            with np.errstate(invalid="ignore"):
                near += np.abs(neighbor - depth_m) < _EDGE_M
    return near < 3  # the pixel itself is among them


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Directions of all pixels with z = 1."""
    y, x = torch.meshgrid(torch.arange(camera.height).double(), torch.arange(camera.width).double(), indexing="ij")
    rays = camera.unproject(torch.stack([x, y], -1))
    return (rays / rays[..., 2:]).numpy().astype(np.float32)


def _moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _no_overlap(reach_m: float) -> WearcapError:
    return WearcapError(
        f"hardly any of the cloud lies within {100 * reach_m:.0f} cm of the scene",
        expected="an approximate pose, within some 30 cm and 8°",
        fix="Check the camera's pose, and that cloud and scene are both in metres.",
    )


def voxel_downsample(
    points: Float[Tensor, "point 3"], voxel_size: float
) -> tuple[Float[Tensor, "voxel 3"], Int64[Tensor, "point"]]:
    """Mean of the points in each occupied voxel (edge length in m), and the voxel index of every point."""
    cell = torch.floor(points.double() / voxel_size).long()
    _, voxel, count = torch.unique(cell, dim=0, return_inverse=True, return_counts=True)
    total = torch.zeros(len(count), 3, dtype=torch.float64, device=points.device)
    total.index_add_(0, voxel, points.double())
    return (total / count[:, None]).to(points.dtype), voxel
