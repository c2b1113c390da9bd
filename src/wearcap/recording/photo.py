"""An image of the scene with known camera and pose, from which a visual map is built."""

from dataclasses import dataclass
from pathlib import Path

from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid


@dataclass(frozen=True)
class Photo:
    """An image file, its calibrated camera, and the camera's pose in the scene (no batch axes, m)."""

    file: Path
    camera: Camera
    T_world_cam: Rigid
