"""Checks of inertial sensors: units, gravity, axes, and agreement with the motion they were worn in."""

import math

import torch
from torch import Tensor

from wearcap.doctor.report import Check, Finding, has_error
from wearcap.doctor.streams import acceleration_of, check_rotations, lag_between, quantile, spin_of
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
            evidence = f"{int((~values.isfinite()).any(-1).sum())} samples"
            findings.append(Check(f"{stream}: {name}").error("values are NaN", evidence, "Drop or fill them."))
    if imu.R_world_imu is not None:
        findings += check_rotations(stream, imu.R_world_imu)
    if has_error(findings):
        return findings
    if imu.acc_imu is not None:
        findings.append(_specific_force(Check(f"{stream}: accelerometer"), imu.acc_imu, imu.R_world_imu))
    if imu.acc_world is not None:
        check, mean = Check(f"{stream}: free acceleration"), imu.acc_world.double().mean(0)
        evidence = f"mean ({', '.join(f'{v:+.2f}' for v in mean.tolist())}) m/s²"
        if mean.norm() > 0.6 * GRAVITY:
            fix = f"Subtract ({', '.join(f'{v:.2f}' for v in (GRAVITY * mean / mean.norm()).tolist())}) m/s²."
            findings.append(check.error("gravity is still in it", evidence, fix))
        elif mean.norm() > 1.0:
            findings.append(check.warning("has a mean", evidence, "Orientation or bias is off."))
        else:
            findings.append(check.ok("free of gravity", evidence))
    if imu.gyro_imu is not None:
        findings.append(_gyroscope(Check(f"{stream}: gyroscope"), imu, imu.gyro_imu.double()))
    return findings if joint is None else findings + _against_motion(stream, imu, joint)


def _specific_force(check: Check, acc_imu: Tensor, R_world_imu: Tensor | None) -> Finding:
    """Specific force is 9.81 m/s² upwards on average."""
    usual = quantile(acc_imu.norm(dim=-1), 0.5)
    evidence = f"median length {usual:.4g} m/s²"
    if not 0.8 * GRAVITY < usual < 1.25 * GRAVITY:
        off = {name: abs(math.log(max(usual, 1e-9) * unit / GRAVITY)) for name, unit in _ACC_UNITS.items()}
        unit = min(off, key=lambda name: off[name])
        if off[unit] < 0.25:
            return check.error(f"is in {unit}, not m/s²", evidence, f"Multiply by {_ACC_UNITS[unit]:.5g}.")
        return check.error("does not measure gravity", evidence, "If gravity was removed, it belongs into acc_world.")
    if R_world_imu is None:
        return check.ok("measures gravity", evidence)
    up = (R_world_imu.double() @ acc_imu.double()[..., None])[..., 0].mean(0) / GRAVITY
    evidence += f", points along ({', '.join(f'{v:+.2f}' for v in up.tolist())}) of the world"
    if up[2] > 0.85:
        return check.ok("measures gravity, upwards", evidence)
    if up[2] < -0.85:
        return check.error("its sign is reversed", evidence, "Negate it: at rest specific force points up.")
    fix = "The sensor's orientation is in another world, or its axes are exchanged."
    return check.error("gravity does not point along z", evidence, fix)


def _gyroscope(check: Check, imu: ImuStream, gyro: Tensor) -> Finding:
    """Angular velocity is the derivative of the sensor's own orientation, in rad/s."""
    if imu.R_world_imu is None:
        fast = quantile(gyro.norm(dim=-1), 0.99)
        evidence = f"99 % below {fast:.3g} rad/s"
        if fast > 60:
            return check.warning("faster than a person", evidence, "If it is in degrees, multiply by π/180.")
        return check.ok("of a person's speed", evidence)
    spin = spin_of(Trajectory(imu.timestamps, imu.R_world_imu, torch.zeros(len(gyro), 3)))
    scale, agreement = _fit(spin.flatten(), gyro.flatten())
    evidence = f"{scale:.3g} × the orientation's derivative, correlation {agreement:.2f}"
    if agreement < 0.6:
        in_imu = (imu.R_world_imu.double().mT @ gyro[..., None]).flatten()
        in_world_axes = _fit(spin.flatten(), in_imu)[1] > 0.8
        fix = "It is in world axes: turn it by R_world_imu⁻¹." if in_world_axes else "Check its axes, sign and clock."
        return check.warning("does not agree with the orientation", evidence, fix)
    if 40 < scale < 75:
        return check.error("is in degrees per second", evidence, "Multiply by π/180.")
    if not 0.7 < scale < 1.4:
        fix = "Check its unit and frame rate."
        return check.warning("has another scale than the orientation", evidence, fix)
    return check.ok("agrees with the orientation", evidence)


def _against_motion(stream: str, imu: ImuStream, joint: Trajectory) -> list[Finding]:
    """The sensor is fixed to its joint: constant mounting, the same rotations and accelerations at the same time."""
    inside = (imu.timestamps >= joint.timestamps[0]) & (imu.timestamps <= joint.timestamps[-1])
    if inside.sum() < 30:
        evidence = f"{int(inside.sum())} samples"
        return [Check(f"{stream}: against motion").warning("hardly overlaps the motion", evidence, "Check its clock.")]
    # The lag follows from angular speed (in any sensor axes), or from acceleration without orientation and gyroscope.
    expected, measured = spin_of, None
    if imu.gyro_imu is not None:
        measured = imu.gyro_imu.double()
    elif imu.R_world_imu is not None:
        measured = spin_of(Trajectory(imu.timestamps, imu.R_world_imu, torch.zeros(len(imu.timestamps), 3)))
    elif imu.acc_world is not None:
        expected, measured = acceleration_of, imu.acc_world
    findings = []
    if measured is not None:
        lag = lag_between(joint.timestamps, expected(joint).norm(dim=-1), imu.timestamps, measured.norm(dim=-1))
        findings += check_offset(f"{stream}: clock offset", lag)
    at = resample(joint, imu.timestamps[inside])
    if imu.R_world_imu is not None:
        check, R_world_imu = Check(f"{stream}: mounting"), imu.R_world_imu[inside].double()
        R_world_joint = at.R_world_body.double()
        mean, spread = _spread_deg(R_world_joint.mT @ R_world_imu)
        evidence, off = f"90 % of the time within {spread:.1f}° of a constant mounting", 0.0
        if imu.R_joint_imu is not None:
            off = math.degrees(rotation.geodesic(mean, imu.R_joint_imu.double()).item())
        if spread > 25:
            fix = "Check the joint it is named for, quaternion order, heading drift, clock."
            if _spread_deg(R_world_joint @ R_world_imu)[1] < 15:
                fix = "Its orientation is inverted: use the sensor's pose in the world."
            findings.append(check.error("the sensor does not ride on its joint", evidence, fix))
        elif off > 15:
            evidence += f"; {off:.0f}° from R_joint_imu"
            findings.append(check.warning("differs from the stated mounting", evidence, "Calibrate again."))
        elif spread > 12:
            findings.append(check.warning("drifts against its joint", evidence, "Heading drift or a loose strap."))
        else:
            findings.append(check.ok("constant", evidence))
    if imu.acc_world is not None:
        acc_world = imu.acc_world[inside].double()
        findings.append(_acceleration(Check(f"{stream}: acceleration"), acc_world, joint, imu.timestamps[inside]))
    return findings


def check_offset(name: str, lag: tuple[float, float, float] | None, who: str = "the sensor") -> list[Finding]:
    """Whether two clocks agree, by a lag of `lag_between`; an empty list if it could not be measured."""
    if lag is None:
        return []
    check, (seconds, best, unshifted) = Check(name), lag
    evidence = f"correlation {best:.2f} at {1000 * seconds:+.0f} ms, {unshifted:.2f} without a shift"
    if best < 0.5:
        fix = "Another joint, another recording, or a clock more than a second off."
        return [check.warning("does not match this motion", evidence, fix)]
    if abs(seconds) > 0.02 and 1 - unshifted > 2 * (1 - best) + 0.001:
        severity = "error" if abs(seconds) > 0.05 else "warning"
        what, fix = f"{who} is {'late' if seconds > 0 else 'early'}", f"Add {-seconds:+.3f} s to its timestamps."
        return [check.found(severity, what, evidence, fix)]
    return [check.ok("in time with the motion", evidence)]


def _spread_deg(R: Tensor) -> tuple[Tensor, float]:
    """Mean of rotations, and the angle (°) from it that 90 % of them stay below."""
    mean = rotation.mean_rotation(R)
    return mean, math.degrees(quantile(rotation.geodesic(R, mean.expand_as(R)), 0.9))


def _acceleration(check: Check, acc_world: Tensor, joint: Trajectory, timestamps: Tensor) -> Finding:
    """Free acceleration against the second difference of the joint's path (MocapEvery eq. 8)."""
    expected = interpolate(joint.timestamps, acceleration_of(joint), timestamps)
    window = 2 * round(0.033 / timestamps.diff().median().item()) + 1  # approximately the span that eq. 8 averages over
    scale, agreement = _fit(expected.flatten(), mean_filter(acc_world, window).flatten())
    evidence = f"{scale:.2g} × the motion's, correlation {agreement:.2f}"
    if quantile(expected.norm(dim=-1), 0.9) < 0.5:
        return check.ok("hardly any to compare", evidence)
    if agreement < -0.5:
        return check.error("has the opposite sign", evidence, "Negate it.")
    if agreement < 0.4:
        fix = "Check its axes, its world's heading and its clock."
        return check.warning("does not agree with the motion", evidence, fix)
    if 0.06 < scale < 0.16:
        return check.error("is in g", evidence, f"Multiply by {GRAVITY}.")
    if not 0.5 < scale < 2:
        return check.warning("has another scale than the motion's", evidence, "Check units and frame rates.")
    return check.ok("agrees with the motion", evidence)


def _fit(reference: Tensor, measured: Tensor) -> tuple[float, float]:
    """Least-squares scale of measured = scale · reference, and their correlation through the origin."""
    square = reference.square().sum().clamp(min=1e-12)
    product = (reference * measured).sum()
    return (product / square).item(), (product / (square * measured.square().sum().clamp(min=1e-12)).sqrt()).item()
