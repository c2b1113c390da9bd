"""Checks of poses over time: valid rotations, metres, upright, quaternion order, heading along the path."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.doctor.report import Finding
from wearcap.doctor.signals import quantile
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, linear_velocity

FASTEST_M_S = 12.0
"""Highest running speed (m/s); a faster frame is a jump, a faster recording is in the wrong unit."""
UPRIGHT = 0.7
"""Least mean z component of a head's or pelvis' own z axis in a recording of daily life."""
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "CMU's units": 0.0254 / 0.45}


def check_rotations(stream: str, R: Float[Tensor, "*batch 3 3"]) -> list[Finding]:
    """Rotations are finite, orthonormal and right-handed; the list is empty if so."""
    check = f"{stream}: rotations"
    flat = R.reshape(-1, 3, 3).double()
    bad = ~flat.isfinite().all(-1).all(-1)
    if bad.any():
        return [
            Finding(
                "error", check, "rotations are NaN", f"{int(bad.sum())} of {len(flat)}", "Drop or fill these frames."
            )
        ]
    error = (flat.mT @ flat - torch.eye(3, dtype=torch.float64)).abs().amax((-1, -2))
    if (error > 1e-2).any():
        return [
            Finding(
                "error",
                check,
                "matrices that are no rotations",
                f"{int((error > 1e-2).sum())} of {len(flat)}, off by up to {error.max():.2g}",
                "Normalise quaternions before converting; check which columns hold them.",
            )
        ]
    if (torch.linalg.det(flat) < 0).any():
        return [
            Finding(
                "error",
                check,
                "mirrored (left-handed) axes",
                "determinant -1",
                "Turn axes by rotations only; negate an axis in pairs.",
            )
        ]
    return []


def check_speed(stream: str, track: Trajectory) -> list[Finding]:
    """Positions are in metres, without jumps."""
    check = f"{stream}: positions"
    if not track.t_world_body.isfinite().all():
        return [
            Finding(
                "error",
                check,
                "positions are NaN",
                f"{int((~track.t_world_body.isfinite()).any(-1).sum())} frames",
                "Drop or fill these frames.",
            )
        ]
    moved = track.t_world_body.double().diff(dim=0).norm(dim=-1)
    speed = moved / track.timestamps.diff()
    usual = quantile(speed, 0.9)
    path = moved.sum().item()
    evidence = f"90 % of frames below {usual:.3g} m/s, path {path:.4g} m"
    if usual > FASTEST_M_S:
        unit = min(_UNITS, key=lambda name: abs(math.log(usual * _UNITS[name] / 1.2)))
        return [
            Finding(
                "error",
                check,
                "positions are not in metres",
                evidence,
                f"In {unit} it would be {usual * _UNITS[unit]:.2f} m/s: multiply positions by {_UNITS[unit]:.4g}.",
            )
        ]
    if len(speed) > 2 and track.timestamps[-1] - track.timestamps[0] > 10 and path < 0.01:
        return [
            Finding(
                "warning", check, "nothing moves", evidence, "Check the unit, and that this stream recorded at all."
            )
        ]
    jumps = speed > FASTEST_M_S
    if jumps.any():
        worst = int(speed.argmax())
        return [
            Finding(
                "warning",
                check,
                "jumps",
                f"{int(jumps.sum())} steps faster than {FASTEST_M_S:g} m/s, the worst {moved[worst]:.2f} m at "
                f"{track.timestamps[worst + 1] - track.timestamps[0]:.2f} s",
                "Tracking was lost there: mask these frames (geometry.trajectory.outlier_mask).",
            )
        ]
    return [Finding("ok", check, "in metres, without jumps", evidence)]


def check_upright(stream: str, track: Trajectory) -> list[Finding]:
    """Whether the body's own z axis points along the world's z, and if not, the likely mix-up."""
    check = f"{stream}: up axis"
    R = track.R_world_body.double()
    up_world, up_body = R[:, :, 2].mean(0), R[:, 2, :].mean(0)
    evidence = f"its z axis points along {_listed(up_world)} of the world, on average"
    if up_world[2] > UPRIGHT:
        return [Finding("ok", check, "z is up", evidence)]
    vertical = _vertical_axis(track)
    order = _quaternion_order(R)
    consistent = up_world.norm() > 0.8
    if order and not (consistent and vertical in (0, 1)):
        return [
            Finding(
                "error",
                check,
                "quaternions are read in the wrong order",
                f"{evidence}; read as {order} it is upright",
                f"Read the quaternions as {order}.",
            )
        ]
    if consistent and vertical != 2 and up_world.abs().max() > 0.7:
        name = _axis_name(up_world)
        return [
            Finding(
                "error",
                check,
                f"the world's {name} axis is up, not z",
                evidence,
                f"Turn the world so that {name} becomes z (reader option up, or {name} → z for poses and points alike).",
            )
        ]
    if up_body.norm() > 0.8 and up_body.abs().max() > 0.7:
        name = _axis_name(up_body)
        return [
            Finding(
                "error",
                check,
                f"the body's {name} axis points up, not z",
                f"{evidence}; its {name} axis does",
                "Turn the device's own axes to x forward, y left, z up (R_world_device @ R_device_head axes).",
            )
        ]
    severity = "error" if up_world[2] < 0.3 else "warning"
    return [
        Finding(
            severity,
            check,
            "is not upright",
            evidence,
            "Check axes and quaternion order; lying and crawling look like this too.",
        )
    ]


def check_facing(stream: str, track: Trajectory) -> list[Finding]:
    """Whether the body's x axis points where it walks; only while it walks."""
    check = f"{stream}: forward axis"
    velocity = linear_velocity(track).double()[:, :2]
    walking = (velocity.norm(dim=-1) > 0.5) & (velocity.norm(dim=-1) < FASTEST_M_S)
    walked_s = walking.double().mean().item() * (track.timestamps[-1] - track.timestamps[0]).item()
    if walked_s < 3:
        return []
    R = track.R_world_body.double()
    course = torch.atan2(velocity[:, 1], velocity[:, 0])[walking]
    offset, strength = _mean_angle(rotation.yaw_of(R)[walking] - course)
    evidence = f"x axis {math.degrees(offset):+.0f}° off the walking direction (agreement {strength:.2f}, {walked_s:.0f} s of walking)"
    if abs(offset) < math.radians(60) and strength > 0.5:
        return [Finding("ok", check, "x is forward", evidence)]
    inverse_offset, inverse_strength = _mean_angle(rotation.yaw_of(R.mT)[walking] - course)
    if inverse_strength > max(0.8, strength) and abs(inverse_offset) < math.radians(45):
        return [
            Finding(
                "error",
                check,
                "rotations are inverted",
                f"{evidence}; transposed they fit ({inverse_strength:.2f})",
                "Store the pose of the body in the world (R_world_body), not its inverse.",
            )
        ]
    if strength < 0.5:
        return [
            Finding(
                "note",
                check,
                "facing and walking direction hardly agree",
                evidence,
                "The wearer may walk sideways or look around.",
            )
        ]
    severity = "warning" if walked_s < 15 or abs(offset) < math.radians(75) else "error"
    return [
        Finding(
            severity,
            check,
            "x does not point forward",
            evidence,
            f"Turn the body's axes by {-math.degrees(offset):+.0f}° about z, if the wearer did walk ahead.",
        )
    ]


def _mean_angle(angle: Tensor) -> tuple[float, float]:
    """Circular mean (rad) and concentration (0 … 1) of angles."""
    cos, sin = angle.cos().mean().item(), angle.sin().mean().item()
    return math.atan2(sin, cos), math.hypot(cos, sin)


def _vertical_axis(track: Trajectory) -> int | None:
    """World axis along which the body clearly moves least, as people move along the floor; None if unclear."""
    spread = track.t_world_body.double().std(0)
    order = spread.argsort()
    return int(order[0]) if spread[order[0]] < 0.5 * spread[order[1]] else None


def _quaternion_order(R: Tensor) -> str | None:
    """Quaternion order that makes the body upright; None if none does."""
    wxyz = rotation.quat_wxyz_from_matrix(R)
    for shift, name in ((1, "xyzw"), (-1, "wxyz")):
        if rotation.matrix_from_quat_wxyz(wxyz.roll(shift, -1))[:, 2, 2].mean() > 0.85:
            return f"{name} (scalar {'last' if shift == 1 else 'first'})"
    return None


def _axis_name(direction: Tensor) -> str:
    axis = int(direction.abs().argmax())
    return ("-" if direction[axis] < 0 else "+") + "xyz"[axis]


def _listed(vector: Tensor) -> str:
    return "(" + ", ".join(f"{v:+.2f}" for v in vector.tolist()) + ")"
