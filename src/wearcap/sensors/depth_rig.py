"""Point cloud of the person from several depth cameras, in the scene (thesis §4.5.1).

Depth images are uint16 millimetres along the optical axis, 0 for missing measurements, as Kinects give them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt16
from sklearn.cluster import DBSCAN

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import Splats, render
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.surface import SurfaceIndex, voxel_downsample
from wearcap.sensors.registration import STAGES, Registration, register

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
_SPLAT_M = 0.02
"""Radius at which a scan's points hide what is behind them: its spacing, and some more."""
_BESIDE_M = 0.04
"""Points so near to a visible one are of the same surface."""


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
        valid = np.isfinite(self.depth_m) & ~_flying(self.depth_m, Subtraction().edge_m)
        relative = np.where(valid, self.deviation_m / self.depth_m, np.inf)
        return valid & (relative <= _FLICKER * np.median(relative[valid])) if valid.any() else valid


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth camera of the rig: lens, pose in the scene and its background."""

    camera: Camera
    T_world_cam: Rigid
    background: Background


@dataclass(frozen=True)
class Subtraction:
    """Margins of the background subtraction (ours: the thesis has no margin)."""

    margin_m: float = 0.01
    """Smallest distance in front of the background."""
    deviations: float = 4.0
    """Additional margin in standard deviations of the background pixel: more at edges, less on a near floor."""
    edge_m: float = 0.06
    """Pixels without two neighbours in this depth are flying pixels, dropped before unprojection."""


def empty_scene(frames_mm: UInt16[np.ndarray, "time height width"]) -> Background:
    """Mean depth of an empty scene, of the frames that saw each pixel. Raises WearcapError without frames."""
    if not len(frames_mm):
        raise WearcapError(
            "no frames of the empty scene",
            expected="at least one depth image without the person",
            fix="Record a few seconds of the scene before the person enters.",
        )
    seen = frames_mm > 0
    count = seen.sum(0)
    depth = frames_mm.astype(np.float32) / 1000
    mean = depth.sum(0) / np.maximum(count, 1)
    variance = (seen * (depth - mean) ** 2).sum(0) / np.maximum(count - 1, 1)
    valid = count >= _SEEN_SHARE * len(frames_mm)
    return Background(np.where(valid, mean, np.inf).astype(np.float32), np.sqrt(variance, dtype=np.float32))


def foreground(
    depth_mm: UInt16[np.ndarray, "height width"], background: Background, subtraction: Subtraction = Subtraction()
) -> Bool[np.ndarray, "height width"]:
    """Pixels clearly before the empty scene's depth; all measured ones where the background gave none.

    Raises WearcapError when the sizes differ.
    """
    if depth_mm.shape != background.depth_m.shape:
        raise WearcapError(
            f"a depth image of shape {depth_mm.shape} and a background of {background.depth_m.shape}",
            expected="images of one camera",
        )
    depth = depth_mm / np.float32(1000)
    margin = subtraction.margin_m + subtraction.deviations * background.deviation_m
    before = (depth_mm > 0) & (depth < background.depth_m - margin)
    return before & ~_flying(depth, subtraction.edge_m)


def unproject_depth(
    depth_m: Float[np.ndarray, "height width"], valid: Bool[np.ndarray, "height width"], camera: Camera
) -> Float[np.ndarray, "point 3"]:
    """Points (m, camera axes) of the valid pixels; the depth lies along the optical axis."""
    rays = _rays(camera)[valid]
    points = rays * depth_m[valid][:, None]
    return points[np.isfinite(points).all(1)].astype(np.float64)


def largest_cluster(points: Float[np.ndarray, "point 3"], eps_m: float = CLUSTER_EPS_M) -> Bool[np.ndarray, "point"]:
    """Points of the DBSCAN cluster that holds most of them; none where all are noise."""
    if not len(points):
        return np.zeros(0, bool)
    centers, voxel = voxel_downsample(torch.from_numpy(points), _CLUSTER_VOXEL_M)
    rows: Int64[np.ndarray, "point"] = voxel.numpy()
    weight = np.bincount(rows)
    label = DBSCAN(eps=eps_m, min_samples=_CLUSTER_POINTS).fit_predict(centers.numpy(), sample_weight=weight)
    size = np.bincount(label + 1, weight)[1:]
    return (label == size.argmax())[rows] if len(size) else np.zeros(len(points), bool)


def register_view(
    view: DepthView, scene: Float32[np.ndarray, "scene_point 3"], correction: Rigid | None = None
) -> tuple[DepthView, Registration]:
    """The camera at the pose that ICP of its empty depth image to the scene's scan (m) finds, and ICP's report.

    `view.T_world_cam` is the approximate pose, as visual localisation gives it. Where the result is wrong, a person
    gives it back with a `correction` in scene axes (new = correction @ old), and ICP starts from there: the
    thesis's localisation, ICP, manual correction, ICP. ICP runs twice, each time to the points that the camera
    would see from where it is thought to be: scans show walls from both sides, 10 cm apart.
    Raises WearcapError as `register` does.
    """
    empty = view.background
    cloud = unproject_depth(empty.depth_m, empty.steady, view.camera)
    pose = view.T_world_cam.to(torch.float64)
    if correction is not None:
        pose = correction.to(torch.float64) @ pose
    pose = register(cloud, visible_points(scene, pose), pose).T_scene_cloud
    result = register(cloud, visible_points(scene, pose), pose, STAGES[1:])
    return replace(view, T_world_cam=result.T_scene_cloud), result


def visible_points(scene: Float32[np.ndarray, "scene_point 3"], T_world_cam: Rigid) -> Float32[np.ndarray, "point 3"]:
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
    depth_mm: Sequence[UInt16[np.ndarray, "height width"]],
    views: Sequence[DepthView],
    subtraction: Subtraction = Subtraction(),
) -> Float[np.ndarray, "point 3"]:
    """The person in the scene (m) at one instant: foreground of all cameras, merged, its largest cluster.

    `depth_mm`: one image per view. Empty where nobody is in sight. Raises WearcapError when the numbers differ.
    """
    if len(depth_mm) != len(views):
        raise WearcapError(f"{len(depth_mm)} depth images for {len(views)} cameras", expected="one for each")
    parts = []
    for image, view in zip(depth_mm, views):
        mask = foreground(image, view.background, subtraction)
        points = torch.from_numpy(unproject_depth(image / np.float32(1000), mask, view.camera))
        pose = view.T_world_cam.to(torch.float64)
        parts.append((points @ pose.R.T + pose.t).numpy())
    merged = np.concatenate(parts)
    return merged[largest_cluster(merged)]


def _flying(depth_m: np.ndarray, edge_m: float) -> np.ndarray:
    """Pixels with fewer than two of their eight neighbours in the same depth: between two surfaces (ours)."""
    height, width = depth_m.shape
    padded = np.pad(depth_m, 1, constant_values=np.nan)
    near = np.zeros(depth_m.shape, np.int8)
    for dy in range(3):
        for dx in range(3):
            neighbor = padded[dy : dy + height, dx : dx + width]
            with np.errstate(invalid="ignore"):
                near += np.abs(neighbor - depth_m) < edge_m
    return near < 3  # the pixel itself is among them


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Directions of all pixels with z = 1."""
    y, x = torch.meshgrid(torch.arange(camera.height).double(), torch.arange(camera.width).double(), indexing="ij")
    rays = camera.unproject(torch.stack([x, y], -1))
    return (rays / rays[..., 2:]).numpy().astype(np.float32)
