"""Streams against each other: head device and head joint, points, floor, camera."""

import math

from wearcap.doctor.inertial import offset_finding
from wearcap.doctor.report import Finding
from wearcap.doctor.signals import lag_between, quantile, spin_of
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording import CameraStream, Cue, FloorTrack, HeadStream, Motion, PointCloud
from wearcap.scene.floor import estimate_floor


def check_head_against_body(head: HeadStream, motion: Motion) -> list[Finding]:
    """The device is fixed to the motion's head joint, at the recorded pose and on the same clock."""
    if "head" not in motion.skeleton:
        return []
    joint = motion.joint("head")
    body = Trajectory(motion.timestamps, joint.R, joint.t)
    device = Trajectory(head.timestamps, head.R_world_device, head.t_world_device)
    findings = []
    lag = lag_between(body.timestamps, spin_of(body).norm(dim=-1), device.timestamps, spin_of(device).norm(dim=-1))
    offset = offset_finding(lag, "the head stream")
    if offset:
        findings.append(
            Finding(offset.severity, "head against body: clock offset", offset.what, offset.evidence, offset.fix)
        )
    inside = (body.timestamps >= device.timestamps[0]) & (body.timestamps <= device.timestamps[-1])
    if inside.sum() < 10:
        return [
            *findings,
            Finding(
                "error",
                "head against body",
                "hardly overlap in time",
                f"{int(inside.sum())} shared frames",
                "Bring both to one clock.",
            ),
        ]
    at = resample(device, body.timestamps[inside])
    T_head_device = Rigid(body.R_world_body[inside].double(), body.t_world_body[inside].double()).inverse() @ Rigid(
        at.R_world_body.double(), at.t_world_body.double()
    )
    return [*findings, _check_mounting(T_head_device, head)]


def _check_mounting(T_head_device: Rigid, head: HeadStream) -> Finding:
    mean_R, mean_t = rotation.mean_rotation(T_head_device.R), T_head_device.t.median(0).values
    turn = math.degrees(quantile(rotation.geodesic(T_head_device.R, mean_R.expand_as(T_head_device.R)), 0.9))
    shift = quantile((T_head_device.t - mean_t).norm(dim=-1), 0.9)
    check, evidence = (
        "head against body: seat",
        f"90 % of the time within {100 * shift:.1f} cm and {turn:.1f}° of a constant seat",
    )
    if shift > 0.3 or turn > 30:
        return Finding(
            "error",
            check,
            "the device does not ride on the head",
            evidence,
            "Head and body are in different worlds (align them), on different clocks, or of different people.",
        )
    off_m = (mean_t - head.t_head_device.double()).norm().item()
    off_deg = math.degrees(rotation.geodesic(mean_R, head.R_head_device.double()).item())
    evidence += f"; mean {100 * off_m:.1f} cm and {off_deg:.1f}° from the stated one"
    if off_m > 0.08 or off_deg > 15:
        return Finding(
            "warning",
            check,
            "the stated seat of the device is off",
            evidence,
            f"t_head_device = ({', '.join(f'{v:.3f}' for v in mean_t.tolist())}) m fits this recording.",
        )
    severity = "warning" if shift > 0.06 or turn > 12 else "ok"
    return Finding(
        severity,
        check,
        "the device moves on the head" if severity == "warning" else "constant",
        evidence,
        "A drifting alignment or a slipping device." if severity == "warning" else "",
    )


def check_head_cue(head: HeadStream, cue: Cue) -> list[Finding]:
    """A head joint tracked by another system moves with the device: same clock, same world, same wearer."""
    check = "head against cues"
    inside = (cue.timestamps >= head.timestamps[0]) & (cue.timestamps <= head.timestamps[-1])
    inside &= (cue.confidence > 0) & cue.points.isfinite().all(-1)
    if cue.points.shape[-1] != 3 or inside.sum() < 2:
        return [
            Finding(
                "error",
                check,
                "hardly overlap in time",
                f"{int(inside.sum())} shared keypoints",
                "Bring both to one clock.",
            )
        ]
    track = Trajectory(head.timestamps, head.R_world_device, head.t_world_device)
    at = resample(track, cue.timestamps[inside])
    t_device_joint = (at.R_world_body.mT @ (cue.points[inside] - at.t_world_body)[..., None])[..., 0]
    mean = t_device_joint.median(0).values
    shift = quantile((t_device_joint - mean).norm(dim=-1), 0.9)
    evidence = (
        f"90 % of the time within {100 * shift:.2g} cm of a constant place, "
        f"({', '.join(f'{v:.3f}' for v in mean.tolist())}) m of the device"
    )
    if shift > 0.1 or mean.norm() > 0.4:
        return [
            Finding(
                "error",
                check,
                "the tracked head does not ride with the device",
                evidence,
                "They are in different worlds, on different clocks, or of different people.",
            )
        ]
    return [Finding("ok", check, "the tracked head rides with the device", evidence)]


def check_points(points: PointCloud, head: HeadStream | None) -> list[Finding]:
    """A cloud in metres around the wearer, with a floor at standing height below the head."""
    cloud = points.points_world
    if not cloud.isfinite().all():
        return [
            Finding(
                "error",
                "points",
                "points are NaN",
                f"{int((~cloud.isfinite()).any(-1).sum())} of {len(cloud)}",
                "Drop them.",
            )
        ]
    if len(cloud) < 50:
        return [
            Finding(
                "warning",
                "points",
                "hardly any points",
                f"{len(cloud)} points",
                "If few were sure enough to keep, loosen the thresholds.",
            )
        ]
    spread = quantile((cloud - cloud.median(0).values).norm(dim=-1), 0.5)
    evidence = f"{len(cloud)} points, half of them within {spread:.3g} m"
    if not 0.2 < spread < 200:
        return [Finding("error", "points", "not a surrounding in metres", evidence, "Check the cloud's unit.")]
    findings = [Finding("ok", "points", "a surrounding in metres", evidence)]
    return findings if head is None else [*findings, _floor_below(points, head)]


def _floor_below(points: PointCloud, head: HeadStream) -> Finding:
    check = "points: floor"
    try:
        floor = estimate_floor(points.points_world, head.t_world_device)
    except WearcapError as error:
        return Finding(
            "error",
            check,
            "no points below the head",
            str(error),
            "Points and head are in different worlds, or z is not up.",
        )
    clearance = head.t_world_device[:, 2] - floor.height
    usual = quantile(clearance, 0.8)
    evidence = f"the head is {usual:.2f} m above it (80 % of the time less), confidence {floor.confidence.median():.2f}"
    if floor.confidence.median() < 0.1:
        return Finding(
            "note",
            check,
            "no clear floor",
            evidence,
            "Check that points and head share a world with z up; else give the floor's height or the wearer's stature.",
        )
    if not 0.9 < usual < 2.1:
        return Finding(
            "warning",
            check,
            "the floor is at no standing or sitting distance",
            evidence,
            "Check unit and up axis of both.",
        )
    return Finding("ok", check, "a floor below the head", evidence)


def floor_below(points: PointCloud, head: HeadStream) -> FloorTrack | None:
    """Height of the floor in the points along the head's path; None if there is none."""
    try:
        floor = estimate_floor(points.points_world, head.t_world_device)
    except WearcapError:
        return None
    return FloorTrack(head.timestamps, floor.height) if floor.confidence.median() > 0.3 else None


def check_camera(stream: CameraStream) -> list[Finding]:
    """The camera looks ahead and is upright on the head; it has as many images as timestamps."""
    findings = []
    count = len(stream.image_files) if stream.image_files is not None else None
    if stream.embedding is not None:
        count = len(stream.embedding)
    if count is not None and count != len(stream.timestamps):
        findings.append(
            Finding(
                "error",
                "camera: frames",
                "images and timestamps differ in number",
                f"{count} and {len(stream.timestamps)}",
                "Pair them again.",
            )
        )
    view, down = stream.R_head_cam[:, 2], stream.R_head_cam[:, 1]
    evidence = f"view {100 * view[0]:.0f} % forward, image's down {-100 * down[2]:.0f} % downward in head axes"
    if view[0] < 0.3:
        findings.append(
            Finding(
                "warning",
                "camera: axes",
                "the camera does not look ahead",
                evidence,
                "R_head_cam turns camera axes (x right, y down, z forward) into head axes.",
            )
        )
    elif down[2] > -0.5:
        findings.append(
            Finding(
                "note", "camera: axes", "the camera is rolled", evidence, "Turn the images upright, or keep it in mind."
            )
        )
    else:
        findings.append(Finding("ok", "camera: axes", "looks ahead, upright", evidence))
    focal = stream.camera.fx / stream.camera.width
    if not 0.1 < focal < 5:
        findings.append(
            Finding(
                "warning",
                "camera: intrinsics",
                "a focal length of no camera",
                f"fx {stream.camera.fx:g} px at {stream.camera.width} px width",
                "fx is in pixels of the stored image size.",
            )
        )
    return findings
