"""The terms of HPS as pure functions that return residuals; the table `energy.TERMS` names which values each compares.

Frames at 30 Hz, rotations as matrices, metres, radians.
"""

from jaxtyping import Float
from torch import Tensor

from wearcap.geometry import rotation


def head_orientation(
    R_world_head: Float[Tensor, "time 3 3"], R_head_cam: Float[Tensor, "3 3"], R_world_cam: Float[Tensor, "time 3 3"]
) -> Float[Tensor, "time 3"]:
    """Rotation (rad, world axes) from the body's camera R^H(θ) R_HC to the localised one (thesis eq. 4.2–4.4)."""
    return rotation_offset(R_world_head @ R_head_cam, R_world_cam)


def rotation_offset(
    R_world_body: Float[Tensor, "*batch 3 3"], expected: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rotation (rad, world axes) from a body's orientation to the expected one, such as the suit's (ours)."""
    return rotation.log(expected @ R_world_body.transpose(-1, -2))


def position_offset(
    position: Float[Tensor, "time *vertex 3"], expected: Float[Tensor, "time *vertex 3"]
) -> Float[Tensor, "time *vertex 3"]:
    """Offset (m): of patch vertices M_n from their nearest scene points v(n) (thesis eq. 4.6), of the root from its
    camera-based initial position (released code; no equation)."""
    return position - expected


def plane_distance(
    position: Float[Tensor, "time vertex 3"],
    origin: Float[Tensor, "time vertex 3"],
    normal: Float[Tensor, "time vertex 3"],
) -> Float[Tensor, "time vertex 1"]:
    """Signed distance (m) of patch vertices from the scan's local plane (ours): eq. 4.6, insensitive to spacing."""
    return ((position - origin) * normal).sum(-1, keepdim=True)


def position_step(
    position: Float[Tensor, "time *vertex 3"], expected: Float[Tensor, "pair *vertex 3"]
) -> Float[Tensor, "pair *vertex 3"]:
    """Displacement (m) from frame to frame minus the expected one: zero of patch vertices (thesis eq. 4.7), zero (eq.
    4.9) or the suit's (released code) of the root."""
    return position.diff(dim=0) - expected


def rotation_step(
    R_world_body: Float[Tensor, "time 3 3"], expected: Float[Tensor, "pair 3 3"]
) -> Float[Tensor, "pair 3"]:
    """Rotation (rad) from frame to frame relative to the expected one: identity (thesis eq. 4.10, 4.11) or the
    suit's (ours).

    An expected rotation has the form R_world_body[j + 1] R_world_body[j]ᵀ.
    """
    return rotation_offset(expected @ R_world_body[:-1], R_world_body[1:])


def pose_offset(
    theta: Float[Tensor, "time joint 3"], theta_imu: Float[Tensor, "time joint 3"]
) -> Float[Tensor, "time component"]:
    """Deviation of all joints' axis-angles but the root's from the suit's, one vector per frame (thesis eq. 4.12)."""
    return (theta - theta_imu).flatten(1)


def pose_step(
    theta: Float[Tensor, "time joint 3"], theta_imu: Float[Tensor, "time joint 3"]
) -> Float[Tensor, "pair component"]:
    """Change of the deviation from the suit's pose from frame to frame; the suit's errors vary slowly (ours)."""
    return pose_offset(theta, theta_imu).diff(dim=0)
