"""Pictures before features are sought in them: of the calibrated size, and flat where the camera is a fisheye."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.localization.features import Features
from wearcap.localization.point_map import undistortion


def flat_picture(
    image: UInt8[np.ndarray, "height width 3"], camera: Camera, horizontal_fov_deg: float
) -> tuple[np.ndarray, Camera, np.ndarray | None]:
    """Picture and camera, undistorted where that is a fisheye, with the valid pixels (None: all)."""
    if not camera.is_fisheye:
        return image, camera, None
    remap = undistortion(camera, horizontal_fov_deg)
    return remap.image(image), remap.camera, _well_inside(remap.valid)


def features_within(features: Features, valid: Bool[np.ndarray, "height width"] | None) -> Features:
    """Without keypoints beyond the border of what the camera saw."""
    if valid is None:
        return features
    column, row = np.rint(features.keypoints).astype(np.int64).T
    return features.subset(valid[row.clip(0, valid.shape[0] - 1), column.clip(0, valid.shape[1] - 1)].astype(bool))


def _well_inside(valid: np.ndarray, margin: int = 6) -> np.ndarray:
    return cv2.erode(valid.astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8), borderValue=0) > 0


def check_size(image: UInt8[np.ndarray, "height width 3"], camera: Camera, where: str) -> None:
    """Raises WearcapError when a picture has not the size that its camera was calibrated for."""
    if image.shape[:2] != (camera.height, camera.width):
        raise WearcapError(
            f"a picture of {image.shape[1]}x{image.shape[0]} pixels with a calibration for "
            f"{camera.width}x{camera.height}",
            where=where,
            expected="the size that the camera was calibrated at",
            fix="Resize the calibration with it (Camera.scaled), or take the original pictures.",
        )
