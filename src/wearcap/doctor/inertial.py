"""Checks of inertial sensors: units, gravity, axes, and agreement with the motion they were worn in."""

import math

import torch
from torch import Tensor

from wearcap.doctor.poses import check_rotations
from wearcap.doctor.report import Finding
from wearcap.doctor.signals import acceleration_of, lag_between, quantile, spin_of
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate, resample
from wearcap.recording import ImuStream
from wearcap.sensors.imu import GRAVITY, mean_filter

_ACC_UNITS = {"g": GRAVITY, "milli-g": GRAVITY / 1000, "cm/s²": 0.01}


def check_imu(stream: str, imu: ImuStream, joint: Trajectory | None) -> list[Finding]:
    """All checks of one sensor; `joint` is the path of the joint it is worn on, if there is a motion."""
    findings = []
    for name in ("acc_world", "acc_imu", "gyro_imu"):
        values = getattr(imu, name)
        if values is not None and not values.isfinite().all():
            findings.append(
                Finding(
                    "error",
                    f"{stream}: {name}",
                    "values are NaN",
                    f"{int((~values.isfinite()).any(-1).sum())} samples",
                    "Drop or fill them.",
                )
            )
    if imu.R_world_imu is not None:
        findings += check_rotations(stream, imu.R_world_imu)
    if any(finding.severity == "error" for finding in findings):
        return findings
    findings += check_gravity(stream, imu)
    findings += check_gyroscope(stream, imu)
    return findings if joint is None else findings + check_against_motion(stream, imu, joint)


def check_gravity(stream: str, imu: ImuStream) -> list[Finding]:
    """Specific force is 9.81 m/s² upwards on average; free acceleration has no mean."""
    findings = []
    if imu.acc_imu is not None:
        findings.append(_specific_force(f"{stream}: accelerometer", imu.acc_imu, imu.R_world_imu))
    if imu.acc_world is not None:
        mean, check = imu.acc_world.double().mean(0), f"{stream}: free acceleration"
        evidence = f"mean ({', '.join(f'{v:+.2f}' for v in mean.tolist())}) m/s²"
        if mean.norm() > 0.6 * GRAVITY:
            fix = f"Subtract ({', '.join(f'{v:.2f}' for v in (GRAVITY * mean / mean.norm()).tolist())}) m/s²."
            findings.append(Finding("error", check, "gravity is still in it", evidence, fix))
        elif mean.norm() > 1.0:
            findings.append(Finding("warning", check, "has a mean", evidence, "Orientation or bias is off."))
        else:
            findings.append(Finding("ok", check, "free of gravity", evidence))
    return findings


def _specific_force(check: str, acc_imu: Tensor, R_world_imu: Tensor | None) -> Finding:
    usual = quantile(acc_imu.norm(dim=-1), 0.5)
    evidence = f"median length {usual:.4g} m/s²"
    if not 0.8 * GRAVITY < usual < 1.25 * GRAVITY:
        unit = min(_ACC_UNITS, key=lambda name: abs(math.log(max(usual, 1e-9) * _ACC_UNITS[name] / GRAVITY)))
        if abs(math.log(max(usual, 1e-9) * _ACC_UNITS[unit] / GRAVITY)) < 0.25:
            return Finding("error", check, f"is in {unit}, not m/s²", evidence, f"Multiply by {_ACC_UNITS[unit]:.5g}.")
        return Finding(
            "error", check, "does not measure gravity", evidence, "If gravity was removed, it belongs into acc_world."
        )
    if R_world_imu is None:
        return Finding("ok", check, "measures gravity", evidence)
    up = (R_world_imu.double() @ acc_imu.double()[..., None])[..., 0].mean(0) / GRAVITY
    evidence += f", points along ({', '.join(f'{v:+.2f}' for v in up.tolist())}) of the world"
    if up[2] > 0.85:
        return Finding("ok", check, "measures gravity, upwards", evidence)
    if up[2] < -0.85:
        return Finding("error", check, "its sign is reversed", evidence, "Negate it: at rest specific force points up.")
    return Finding(
        "error",
        check,
        "gravity does not point along z",
        evidence,
        "The sensor's orientation is in another world, or its axes are exchanged.",
    )


def check_gyroscope(stream: str, imu: ImuStream) -> list[Finding]:
    """Angular velocity is the derivative of the sensor's own orientation, in rad/s."""
    if imu.gyro_imu is None:
        return []
    check, gyro = f"{stream}: gyroscope", imu.gyro_imu.double()
    if imu.R_world_imu is None:
        fast = quantile(gyro.norm(dim=-1), 0.99)
        severity = "warning" if fast > 60 else "ok"
        fix = "If it is in degrees, multiply by π/180." if fast > 60 else ""
        return [
            Finding(
                severity,
                check,
                "faster than a person" if fast > 60 else "of a person's speed",
                f"99 % below {fast:.3g} rad/s",
                fix,
            )
        ]
    track = Trajectory(imu.timestamps, imu.R_world_imu, torch.zeros(len(gyro), 3))
    spin = spin_of(track)
    scale, agreement = _fit(spin.flatten(), gyro.flatten())
    evidence = f"{scale:.3g} × the orientation's derivative, correlation {agreement:.2f}"
    if agreement < 0.6:
        flipped = _fit(
            (imu.R_world_imu.double() @ gyro[..., None])[..., 0].flatten() * 0 + spin.flatten(),
            (imu.R_world_imu.double().mT @ gyro[..., None]).flatten(),
        )[1]
        hint = "It is in world axes: turn it by R_world_imu⁻¹." if flipped > 0.8 else "Check its axes, sign and clock."
        return [Finding("warning", check, "does not agree with the orientation", evidence, hint)]
    if 40 < scale < 75:
        return [Finding("error", check, "is in degrees per second", evidence, "Multiply by π/180.")]
    if not 0.7 < scale < 1.4:
        return [
            Finding(
                "warning", check, "has another scale than the orientation", evidence, "Check its unit and frame rate."
            )
        ]
    return [Finding("ok", check, "agrees with the orientation", evidence)]


def check_against_motion(stream: str, imu: ImuStream, joint: Trajectory) -> list[Finding]:
    """The sensor is fixed to its joint: constant mounting, the same rotations and accelerations at the same time."""
    findings = []
    lag = _clock_offset(imu, joint)
    if lag is not None:
        findings.append(lag)
    inside = (imu.timestamps >= joint.timestamps[0]) & (imu.timestamps <= joint.timestamps[-1])
    if inside.sum() < 30:
        return [
            Finding(
                "warning",
                f"{stream}: against motion",
                "hardly overlaps the motion",
                f"{int(inside.sum())} samples",
                "Check its clock.",
            )
        ]
    at = resample(joint, imu.timestamps[inside])
    if imu.R_world_imu is not None:
        findings.append(
            _mounting(f"{stream}: mounting", imu, imu.R_world_imu[inside].double(), at.R_world_body.double())
        )
    if imu.acc_world is not None:
        findings.append(
            _acceleration(f"{stream}: acceleration", imu.acc_world[inside].double(), joint, imu.timestamps[inside])
        )
    return [
        Finding(
            f.severity, f"{stream}: clock offset" if f.check == "clock offset" else f.check, f.what, f.evidence, f.fix
        )
        for f in findings
    ]


def _clock_offset(imu: ImuStream, joint: Trajectory) -> Finding | None:
    """Lag from angular speed (any sensor axes), or from acceleration without orientation and gyroscope."""
    if imu.gyro_imu is not None:
        measured = imu.gyro_imu.double().norm(dim=-1)
    elif imu.R_world_imu is not None:
        measured = spin_of(Trajectory(imu.timestamps, imu.R_world_imu, torch.zeros(len(imu.timestamps), 3))).norm(
            dim=-1
        )
    elif imu.acc_world is not None:
        return offset_finding(
            lag_between(
                joint.timestamps, acceleration_of(joint).norm(dim=-1), imu.timestamps, imu.acc_world.norm(dim=-1)
            )
        )
    else:
        return None
    return offset_finding(lag_between(joint.timestamps, spin_of(joint).norm(dim=-1), imu.timestamps, measured))


def offset_finding(lag: tuple[float, float, float] | None, who: str = "the sensor") -> Finding | None:
    """Finding about a lag between two clocks; None if it could not be measured."""
    if lag is None:
        return None
    seconds, best, unshifted = lag
    evidence = f"correlation {best:.2f} at {1000 * seconds:+.0f} ms, {unshifted:.2f} without a shift"
    if best < 0.5:
        return Finding(
            "warning",
            "clock offset",
            "does not match this motion",
            evidence,
            "Another joint, another recording, or a clock more than a second off.",
        )
    if abs(seconds) > 0.02 and 1 - unshifted > 2 * (1 - best) + 0.001:
        severity = "error" if abs(seconds) > 0.05 else "warning"
        late = "late" if seconds > 0 else "early"
        return Finding(
            severity, "clock offset", f"{who} is {late}", evidence, f"Add {-seconds:+.3f} s to its timestamps."
        )
    return Finding("ok", "clock offset", "in time with the motion", evidence)


def _mounting(check: str, imu: ImuStream, R_world_imu: Tensor, R_world_joint: Tensor) -> Finding:
    R_joint_imu = R_world_joint.mT @ R_world_imu
    mean = rotation.mean_rotation(R_joint_imu)
    spread = math.degrees(quantile(rotation.geodesic(R_joint_imu, mean.expand_as(R_joint_imu)), 0.9))
    evidence = f"90 % of the time within {spread:.1f}° of a constant mounting"
    if spread > 25:
        inverse = R_world_joint @ R_world_imu
        other = math.degrees(
            quantile(rotation.geodesic(inverse, rotation.mean_rotation(inverse).expand_as(inverse)), 0.9)
        )
        fix = (
            "Its orientation is inverted: use the sensor's pose in the world."
            if other < 15
            else ("Check the joint it is named for, quaternion order, heading drift, clock.")
        )
        return Finding("error", check, "the sensor does not ride on its joint", evidence, fix)
    if imu.R_joint_imu is not None:
        off = math.degrees(rotation.geodesic(mean, imu.R_joint_imu.double()).item())
        if off > 15:
            return Finding(
                "warning",
                check,
                "differs from the stated mounting",
                f"{evidence}; {off:.0f}° from R_joint_imu",
                "Calibrate again.",
            )
    severity = "warning" if spread > 12 else "ok"
    return Finding(
        severity,
        check,
        "drifts against its joint" if spread > 12 else "constant",
        evidence,
        "Heading drift or a loose strap." if spread > 12 else "",
    )


def _acceleration(check: str, acc_world: Tensor, joint: Trajectory, timestamps: Tensor) -> Finding:
    """Free acceleration against the second difference of the joint's path (MocapEvery eq. 8)."""
    expected = interpolate(joint.timestamps, acceleration_of(joint), timestamps)
    window = 2 * round(0.033 / timestamps.diff().median().item()) + 1  # approximately the span that eq. 8 averages over
    scale, agreement = _fit(expected.flatten(), mean_filter(acc_world, window).flatten())
    evidence = f"{scale:.2g} × the motion's, correlation {agreement:.2f}"
    if quantile(expected.norm(dim=-1), 0.9) < 0.5:
        return Finding("ok", check, "hardly any to compare", evidence)
    if agreement < -0.5:
        return Finding("error", check, "has the opposite sign", evidence, "Negate it.")
    if agreement < 0.4:
        return Finding(
            "warning",
            check,
            "does not agree with the motion",
            evidence,
            "Check its axes, its world's heading and its clock.",
        )
    if 0.06 < scale < 0.16:
        return Finding("error", check, "is in g", evidence, f"Multiply by {GRAVITY}.")
    if not 0.5 < scale < 2:
        return Finding(
            "warning", check, "has another scale than the motion's", evidence, "Check units and frame rates."
        )
    return Finding("ok", check, "agrees with the motion", evidence)


def _fit(reference: Tensor, measured: Tensor) -> tuple[float, float]:
    """Least-squares scale of measured = scale · reference, and their correlation through the origin."""
    square = reference.square().sum().clamp(min=1e-12)
    product = (reference * measured).sum()
    return (product / square).item(), (product / (square * measured.square().sum().clamp(min=1e-12)).sqrt()).item()
