"""Absolute camera pose from 2D-3D matches: LO-RANSAC, refinement, covariance."""

from dataclasses import dataclass

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera


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


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose and the matches that agree with it."""

    R_world_cam: Float64[np.ndarray, "3 3"]
    t_world_cam: Float64[np.ndarray, "3"]
    inlier: Bool[np.ndarray, "match"]


def lens_of(camera: Camera) -> dict:
    """The camera in PoseLib's format. Raises WearcapError for fisheyes: undistort their images first."""
    size = {"width": camera.width, "height": camera.height}
    principal = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.model == "pinhole":
        return {"model": "PINHOLE", **size, "params": principal}
    if camera.model == "opencv" and len(camera.distortion) == 4:
        return {"model": "OPENCV", **size, "params": [*principal, *camera.distortion]}
    if camera.model == "opencv":
        return {"model": "FULL_OPENCV", **size, "params": [*principal, *camera.distortion, 0.0, 0.0, 0.0]}
    raise WearcapError(f"absolute pose with the camera model {camera.model!r}", expected="pinhole or opencv")


def ransac_pose(
    pixels: Float32[np.ndarray, "match 2"],
    points_world: Float32[np.ndarray, "match 3"],
    camera: Camera,
    max_error_px: float,
    max_iterations: int = 20_000,
    seed: int = 0,
) -> Fit | None:
    """P3P in LO-RANSAC over matches with outliers; None where no pose is found."""
    if len(pixels) < 4:
        return None
    options = {
        "max_reproj_error": max_error_px,
        "max_iterations": max_iterations,
        "min_iterations": 50,
        "success_prob": 0.9999,
        "seed": seed,
    }
    pose, report = poselib.estimate_absolute_pose(
        pixels.astype(np.float64), points_world.astype(np.float64), lens_of(camera), options, {}
    )
    inlier = np.asarray(report["inliers"], bool)
    if inlier.sum() < 4 or not np.isfinite(pose.Rt).all():
        return None
    return _fit(pose, inlier)


def refined_pose(
    pixels: Float32[np.ndarray, "match 2"],
    points_world: Float32[np.ndarray, "match 3"],
    camera: Camera,
    start: Fit,
    max_error_px: float,
) -> Fit:
    """Robust least squares of the reprojection error from an initial pose (`start.inlier` is not used)."""
    initial = poselib.CameraPose()
    initial.R = start.R_world_cam.T
    initial.t = -start.R_world_cam.T @ start.t_world_cam
    inlier = np.ones(len(pixels), bool)
    fit = start
    for _ in range(2):
        options = {"loss_type": "CAUCHY", "loss_scale": 0.5 * max_error_px, "max_iterations": 50}
        pose, _ = poselib.refine_absolute_pose(
            pixels[inlier].astype(np.float64),
            points_world[inlier].astype(np.float64),
            initial,
            lens_of(camera),
            options,
        )
        fit = _fit(pose, inlier)
        inlier = reprojection_errors(pixels, points_world, camera, fit) < max_error_px
        if inlier.sum() < 4:
            return Fit(fit.R_world_cam, fit.t_world_cam, inlier)
        initial = pose
    return Fit(fit.R_world_cam, fit.t_world_cam, inlier)


def _fit(pose: poselib.CameraPose, inlier: np.ndarray) -> Fit:
    R_cam_world = np.asarray(pose.R)
    return Fit(R_cam_world.T.copy(), -R_cam_world.T @ np.asarray(pose.t), inlier)


def project(points_world: np.ndarray, camera: Camera, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Project world points into the camera at a pose: pixels, and where they are valid."""
    points_cam = (points_world.astype(np.float64) - fit.t_world_cam) @ fit.R_world_cam
    pixels, valid = camera.project(torch.from_numpy(points_cam))
    return pixels.numpy(), valid.numpy()


def reprojection_errors(
    pixels: Float32[np.ndarray, "match 2"], points_world: Float32[np.ndarray, "match 3"], camera: Camera, fit: Fit
) -> Float64[np.ndarray, "match"]:
    """Distance (px) between each keypoint and its point's projection; infinite where that is not in view."""
    seen, valid = project(points_world, camera, fit)
    return np.where(valid, np.linalg.norm(seen - pixels, axis=1), np.inf)


def pose_covariance(
    pixels: Float32[np.ndarray, "match 2"],
    points_world: Float32[np.ndarray, "match 3"],
    camera: Camera,
    fit: Fit,
    min_sigma_px: float = 0.5,
) -> Float64[np.ndarray, "6 6"]:
    """Covariance of rotation (rad) and position (m) in the world: σ² (JᵀJ)⁻¹ of the inliers, σ² from residuals.

    σ is at least `min_sigma_px`, so that few matches that fit by chance do not look certain.
    """
    pixels, offset = pixels[fit.inlier], points_world[fit.inlier].astype(np.float64) - fit.t_world_cam
    points_cam = offset @ fit.R_world_cam
    step = 1e-5 * np.maximum(np.linalg.norm(points_cam, axis=1), 1e-6)
    shifts = step[:, None, None] * np.concatenate([np.eye(3), -np.eye(3)])
    seen, _ = camera.project(torch.from_numpy(points_cam[:, None] + shifts))
    d_pixel_d_cam = ((seen[:, :3] - seen[:, 3:]) / (2 * torch.from_numpy(step)[:, None, None])).mT.numpy()
    # p_cam = Rᵀ exp(-ω) (X - t - δ): its derivative is Rᵀ [X - t]× in ω and -Rᵀ in δ
    cross = np.cross(offset[:, None], np.eye(3)).swapaxes(1, 2)
    d_pixel_d_world = d_pixel_d_cam @ fit.R_world_cam.T
    jacobian = np.concatenate([d_pixel_d_world @ cross, -d_pixel_d_world], 2).reshape(-1, 6)
    centre, _ = camera.project(torch.from_numpy(points_cam))
    residual = pixels - centre.numpy()
    freedom = max(2 * len(pixels) - 6, 1)
    variance = max((residual**2).sum() / freedom, min_sigma_px**2)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    covariance = variance * np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), hermitian=True)
    return covariance / scale[:, None] / scale
