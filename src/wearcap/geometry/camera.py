"""Camera models: points in the camera's axes (OpenCV: x right, y down, z forward) to pixels and back."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera; lengths in pixels, pixel centres at integers."""

    model: str
    """"pinhole" (no distortion), "opencv" (k1 k2 p1 p2 [k3]) or "fisheye" (equidistant, k1…k4)."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
