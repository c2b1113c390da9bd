"""Absolute camera pose: 2D-3D matches by descriptors, LO-RANSAC, refinement, covariance."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.extras import at_first_use
from wearcap.geometry.camera import Camera
from wearcap.geometry.compiled import compiled

cv2 = at_first_use("cv2", "localisation")
poselib = at_first_use("poselib", "localisation")

_KEPT = 4
"""Number of best landmarks per keypoint that are kept for the ratio test."""


def match_landmarks(
    query: Float32[np.ndarray, "keypoint feature"],
    descriptors: Float32[np.ndarray, "landmark feature"],
    positions: Float32[np.ndarray, "landmark 3"],
    *,
    max_ratio: float = 0.85,
    same_m: float = 0.05,
    tile: int = 1024,
) -> Int64[np.ndarray, "match 2"]:
    """Mutually nearest (keypoint, landmark) pairs whose distance is below `max_ratio` times the next place's.

    Landmarks within `same_m` of the nearest one are the same place seen differently: they do not count against it.
    Descriptors have unit length.
    """
    if not len(query) or not len(descriptors):
        return np.zeros((0, 2), np.int64)
    best = np.full((len(query), _KEPT), -2.0, np.float32)
    number = np.full((len(query), _KEPT), -1, np.int64)
    reverse, reverse_best = np.full(len(descriptors), -1), np.full(len(descriptors), -2.0, np.float32)
    rows = torch.from_numpy(np.ascontiguousarray(query))
    for start in range(0, len(descriptors), tile):
        similarity = rows @ torch.from_numpy(descriptors[start : start + tile]).T
        _keep_best(similarity.numpy(), start, best, number, reverse_best, reverse)
    nearest = number[:, 0]
    apart = np.linalg.norm(positions[number] - positions[nearest][:, None], axis=-1) > same_m
    apart &= number >= 0
    rival = np.where(apart, best, -np.inf).max(1)
    rival = np.where(np.isfinite(rival), rival, best[:, -1])  # at least as far as the last one kept
    distance, rival_distance = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (best[:, 0], rival))
    keep = (reverse[nearest] == np.arange(len(query))) & (distance < max_ratio * rival_distance)
    chosen = np.flatnonzero(keep)
    return np.stack([chosen, nearest[chosen]], 1)


def match_nearby(
    query: Float32[np.ndarray, "keypoint feature"],
    descriptors: Float32[np.ndarray, "landmark feature"],
    near: Int64[np.ndarray, "pair 2"],
    min_cosine: float,
) -> Int64[np.ndarray, "match 2"]:
    """Most similar landmark of each keypoint among candidate (keypoint, landmark) pairs, if similar enough."""
    cosine = np.einsum("pf,pf->p", query[near[:, 0]], descriptors[near[:, 1]])
    near, cosine = near[cosine >= min_cosine], cosine[cosine >= min_cosine]
    near = near[np.argsort(-cosine, kind="stable")]
    _, first = np.unique(near[:, 0], return_index=True)
    near = near[np.sort(first)]
    _, first = np.unique(near[:, 1], return_index=True)
    return near[first]


@compiled
def _keep_best(similarity, offset, best, number, reverse_best, reverse):
    """Merge one tile of similarities into each row's list of the largest and each column's largest."""
    kept = best.shape[1]
    for row in range(similarity.shape[0]):
        worst = best[row, kept - 1]
        for column in range(similarity.shape[1]):
            value = similarity[row, column]
            if value > reverse_best[offset + column]:
                reverse_best[offset + column] = value
                reverse[offset + column] = row
            if value > worst:
                place = kept - 1
                while place > 0 and best[row, place - 1] < value:
                    best[row, place] = best[row, place - 1]
                    number[row, place] = number[row, place - 1]
                    place -= 1
                best[row, place] = value
                number[row, place] = offset + column
                worst = best[row, kept - 1]


@dataclass(frozen=True)
class CameraPose:
    """Estimated camera pose with its uncertainty."""

    R_world_cam: Float[Tensor, "3 3"]
    t_world_cam: Float[Tensor, "3"]
    inliers: int
    confidence: float
    """0…1, from the number of inliers and their spread over the image."""
    covariance: Float[Tensor, "6 6"]
    """Covariance of the pose error in the world: rotation vector ω (rad) with R_true = exp(ω) R, then position (m)."""
    matches: "Matches | None" = None
    """The matches that agree with the pose, of a picture that was localised in a map."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose and the matches that agree with it."""

    R_world_cam: Float64[np.ndarray, "3 3"]
    t_world_cam: Float64[np.ndarray, "3"]
    inlier: Bool[np.ndarray, "match"]

    def project(self, points_world: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Project world points into the camera at this pose: pixels, and where they are valid."""
        points_cam = (points_world.astype(np.float64) - self.t_world_cam) @ self.R_world_cam
        ahead = points_cam[:, 2] > 1e-6
        plane = points_cam[:, :2] / np.where(ahead, points_cam[:, 2], 1.0)[:, None]
        pixels, _ = _projected(np.concatenate([plane, np.ones((len(plane), 1))], 1), camera)
        inside = ((pixels >= -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(1)
        return pixels, ahead & inside & ((plane**2).sum(1) < camera.lens_terms.fold)


def _projected(
    points_cam: Float64[np.ndarray, "point 3"], camera: Camera
) -> tuple[Float64[np.ndarray, "point 2"], Float64[np.ndarray, "point 2 6"]]:
    """Pixels of points before a pinhole or OpenCV camera, and their derivatives in a turn (rad) and shift (m) of the points."""
    if not len(points_cam):
        return np.zeros((0, 2)), np.zeros((0, 2, 6))
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    pixels, jacobian = cv2.projectPoints(points_cam, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    return pixels[:, 0], jacobian[:, :6].reshape(-1, 2, 6)


@dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of a picture and the points of the world (m) that they are taken for, some of them wrongly."""

    pixels: Float32[np.ndarray, "match 2"]
    points_world: Float32[np.ndarray, "match 3"]
    camera: Camera

    def ransac(self, max_error_px: float) -> Fit | None:
        """P3P in LO-RANSAC over matches with outliers; None where no pose is found.

        Raises WearcapError for cameras that PoseLib has not.
        """
        if len(self.pixels) < 4:
            return None
        options = {"max_reproj_error": max_error_px, "max_iterations": 20_000, "min_iterations": 50}
        options |= {"success_prob": 0.9999, "seed": 0}
        pixels, points = self.pixels.astype(np.float64), self.points_world.astype(np.float64)
        pose, report = poselib.estimate_absolute_pose(pixels, points, self._lens(), options, {})
        inlier = np.asarray(report["inliers"], bool)
        if inlier.sum() < 4 or not np.isfinite(pose.Rt).all():
            return None
        return _fit(pose, inlier)

    def refined(self, start: Fit, max_error_px: float) -> Fit:
        """Robust least squares of the reprojection error from an initial pose (`start.inlier` is not used)."""
        initial = poselib.CameraPose()
        initial.R = start.R_world_cam.T
        initial.t = -start.R_world_cam.T @ start.t_world_cam
        options = {"loss_type": "CAUCHY", "loss_scale": 0.5 * max_error_px, "max_iterations": 50}
        inlier, fit = np.ones(len(self.pixels), bool), start
        for _ in range(2):
            pixels, points = (part[inlier].astype(np.float64) for part in (self.pixels, self.points_world))
            initial, _ = poselib.refine_absolute_pose(pixels, points, initial, self._lens(), options)
            fit = _fit(initial, inlier)
            inlier = self.errors(fit) < max_error_px
            if inlier.sum() < 4:
                break
        return Fit(fit.R_world_cam, fit.t_world_cam, inlier)

    def errors(self, fit: Fit) -> Float64[np.ndarray, "match"]:
        """Distance (px) between each keypoint and its point's projection; infinite where that is not in view."""
        seen, valid = fit.project(self.points_world, self.camera)
        return np.where(valid, np.linalg.norm(seen - self.pixels, axis=1), np.inf)

    def covariance(self, fit: Fit) -> Float64[np.ndarray, "6 6"]:
        """Covariance of rotation (rad) and position (m) in the world: σ² (JᵀJ)⁻¹ of the inliers, σ² from residuals.

        σ is at least half a pixel, so that few matches that fit by chance do not look certain.
        """
        pixels = self.pixels[fit.inlier]
        offset = self.points_world[fit.inlier].astype(np.float64) - fit.t_world_cam
        points_cam = offset @ fit.R_world_cam
        # p_cam = Rᵀ exp(-ω) (X - t - δ): a turn of p_cam by -Rᵀ ω and a shift by -Rᵀ δ
        seen, d_pixel_d_cam = _projected(points_cam, self.camera)
        jacobian = -np.concatenate([part @ fit.R_world_cam.T for part in np.split(d_pixel_d_cam, 2, 2)], 2).reshape(
            -1, 6
        )
        residual = pixels - seen
        variance = max((residual**2).sum() / max(2 * len(pixels) - 6, 1), 0.5**2)
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
        covariance = variance * np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), hermitian=True)
        return covariance / scale[:, None] / scale

    def _lens(self) -> dict:
        """The camera in PoseLib's format. Raises WearcapError for fisheyes: undistort their images first."""
        camera, count = self.camera, len(self.camera.distortion)
        if camera.model not in ("pinhole", "opencv"):
            raise WearcapError(f"absolute pose with the camera model {camera.model!r}", expected="pinhole or opencv")
        model = "PINHOLE" if camera.model == "pinhole" else "OPENCV" if count == 4 else "FULL_OPENCV"
        bent = () if model == "PINHOLE" else (*camera.distortion, *[0.0] * (0 if count == 4 else 3))
        params = [camera.fx, camera.fy, camera.cx, camera.cy, *bent]
        return {"model": model, "width": camera.width, "height": camera.height, "params": params}


def _fit(pose: Any, inlier: np.ndarray) -> Fit:
    R_cam_world = np.asarray(pose.R)
    return Fit(R_cam_world.T.copy(), -R_cam_world.T @ np.asarray(pose.t), inlier)
