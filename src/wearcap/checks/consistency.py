"""Streams against each other and against their files: inertial sensors (units, gravity, axes, too) and the motion they were worn
in, head device and head joint, points, floor, camera, localisation, claps."""

import math
from pathlib import Path

import torch
from torch import Tensor

from wearcap.checks.report import Check, Finding, has_error, refusal
from wearcap.checks.streams import acceleration_of, check_rotations, lag_between, quantile, spin_of
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, angular_velocity, interpolate, outlier_mask, resample, smooth
from wearcap.io.formats.video import video_info
from wearcap.recording import (
    CameraStream,
    Cue,
    FingerStream,
    FloorTrack,
    HeadStream,
    ImuStream,
    Localization,
    Motion,
    PointCloud,
    Recording,
)
from wearcap.scene.floor import estimate_floor
from wearcap.sensors.claps import detect_claps
from wearcap.sensors.imu import GRAVITY, mean_filter
from wearcap.sensors.initialization import MAX_SPEED
from wearcap.tracking.fingers import fit_hand

LONG_OUTAGE_S = 30.0
REACH_M = (0.05, 1.3)
"""Range of the usual distance (m) between head and hand."""
SCAN_FILE = "scene: file"
CAMERA_LAG_S = 10.0
"""Largest offset of a camera that is searched: turns about the vertical do not repeat as steps do."""
HARDLY_TURNS, CERTAIN = 0.1, 0.8
"""Deviation (rad/s) of turning below which a camera's noise hides it; correlation beyond which an offset is no chance."""
HEAD_M = (-0.1, 2.6)
"""Range of the head's height (m) above the floor, from lying to standing."""
_ACC_UNITS = {"g": GRAVITY, "milli-g": GRAVITY / 1000, "cm/s²": 0.01}


def check_head_against_body(head: HeadStream, motion: Motion) -> list[Finding]:
    """The device is fixed to the motion's head joint, at the recorded pose and on the same clock."""
    if "head" not in motion.skeleton:
        return []
    joint = motion.joint("head")
    body = Trajectory(motion.timestamps, joint.R, joint.t)
    device = Trajectory(head.timestamps, head.R_world_device, head.t_world_device)
    lag = lag_between(body.timestamps, spin_of(body).norm(dim=-1), device.timestamps, spin_of(device).norm(dim=-1))
    findings = check_offset("head against body: clock offset", lag, "the head stream")
    inside = (body.timestamps >= device.timestamps[0]) & (body.timestamps <= device.timestamps[-1])
    if inside.all() and len(inside) < 10:
        return [Check("head against body").note("too short to compare", f"{len(inside)} frames")]
    if inside.sum() < 10:
        evidence = f"{int(inside.sum())} shared frames"
        apart = Check("head against body").error("hardly overlap in time", evidence, "Bring both to one clock.")
        return [*findings, apart]
    at = resample(device, body.timestamps[inside])
    T_head_device = Rigid(body.R_world_body[inside].double(), body.t_world_body[inside].double()).inverse() @ Rigid(
        at.R_world_body.double(), at.t_world_body.double()
    )
    # The device keeps a constant pose on the head joint, the stated one.
    check = Check("head against body: seat")
    (mean_R, turn), mean_t = _spread_deg(T_head_device.R), T_head_device.t.median(0).values
    shift = quantile((T_head_device.t - mean_t).norm(dim=-1), 0.9)
    evidence = f"90 % of the time within {100 * shift:.1f} cm and {turn:.1f}° of a constant seat"
    if shift > 0.3 or turn > 30:
        fix = "Head and body are in different worlds (align them), on different clocks, or of different people."
        return [*findings, check.error("the device does not ride on the head", evidence, fix)]
    off_m = (mean_t - head.t_head_device.double()).norm().item()
    off_deg = math.degrees(rotation.geodesic(mean_R, head.R_head_device.double()).item())
    evidence += f"; mean {100 * off_m:.1f} cm and {off_deg:.1f}° from the stated one"
    if off_m > 0.08 or off_deg > 15:
        fix = f"t_head_device = ({', '.join(f'{v:.3f}' for v in mean_t.tolist())}) m fits this recording."
        return [*findings, check.warning("the stated seat of the device is off", evidence, fix)]
    if shift > 0.06 or turn > 12:
        fix = "A drifting alignment or a slipping device."
        return [*findings, check.warning("the device moves on the head", evidence, fix)]
    return [*findings, check.ok("constant", evidence)]


def check_head_cue(head: HeadStream, cue: Cue) -> Finding:
    """A head joint tracked by another system moves with the device: same clock, same world, same wearer."""
    check = Check("head against cues")
    inside = (cue.timestamps >= head.timestamps[0]) & (cue.timestamps <= head.timestamps[-1])
    inside &= (cue.confidence > 0) & cue.points.isfinite().all(-1)
    if cue.points.shape[-1] != 3 or inside.sum() < 2:
        evidence = f"{int(inside.sum())} shared keypoints"
        return check.error("hardly overlap in time", evidence, "Bring both to one clock.")
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
        fix = "They are in different worlds, on different clocks, or of different people."
        return check.error("the tracked head does not ride with the device", evidence, fix)
    return check.ok("the tracked head rides with the device", evidence)


def check_hand(joint: str, hand: Trajectory, head: HeadStream) -> Finding:
    """A tracked hand is on the head's clock and within an arm's reach of it."""
    check = Check(f"{joint}: reach")
    inside = (hand.timestamps >= head.timestamps[0]) & (hand.timestamps <= head.timestamps[-1])
    if not inside.any():
        evidence = f"{hand.timestamps[0]:.2f} … {hand.timestamps[-1]:.2f} s"
        return check.error("shares no time with the head", evidence, "Bring both to one clock.")
    t_head = interpolate(head.timestamps, head.t_world_device.double(), hand.timestamps[inside])
    usual = quantile((hand.t_world_body[inside].double() - t_head).norm(dim=-1), 0.5)
    evidence = f"half of the time within {usual:.3g} m of the head"
    if not REACH_M[0] < usual < REACH_M[1]:
        fix = "Say the unit of length (unit=cm, mm …), or take head and hands of one session."
        return check.error("out of an arm's reach" if usual > 1 else "lies in the head", evidence, fix)
    return check.ok("within an arm's reach", evidence)


MOST_WRONG = 0.3
"""Largest share of tracked frames in which a hand's points may be those of no such hand."""


def check_fingers(side: str, stream: FingerStream, head: HeadStream | None) -> Finding:
    """How much of a tracked hand is seen, and whether its points are a hand of this side."""
    check, times = Check(f"{side} fingers"), stream.timestamps
    if not len(times) or not (times.isfinite().all() and (times.diff() > 0).all()):
        return check.error("timestamps are none, or do not rise", "", "Sort the frames by time.")
    if head is not None and (times[-1] < head.timestamps[0] or times[0] > head.timestamps[-1]):
        evidence = f"{times[0]:.2f} … {times[-1]:.2f} s"
        return check.warning("share no time with the head, and rest", evidence, "Bring both to one clock.")
    hand = fit_hand(stream, side)
    seen, evidence = f"are measured in {100 * hand.measured.double().mean():.0f} % of", f"{len(times)} frames"
    if hand.wrong > MOST_WRONG:
        evidence += f", of the tracked ones {100 * hand.wrong:.0f} % do not bend as a {side} hand"
        return check.warning(seen, evidence, "Are left and right, or left- and right-handed axes, mixed up?")
    return check.ok(seen, evidence)


def check_carried(head: HeadStream, floor: FloorTrack) -> list[Finding]:
    """The head is at the height of a person's above a known floor; the list is empty if so."""
    times = head.timestamps.clamp(floor.timestamps[0].item(), floor.timestamps[-1].item())
    height = head.t_world_device[:, 2].double() - interpolate(floor.timestamps, floor.height.double(), times)
    usual = quantile(height, 0.9)
    if HEAD_M[0] < usual < HEAD_M[1]:
        return []
    fix = "Check the unit of length (unit=cm, mm …) and the floor's height."
    evidence = f"{usual:.3g} m above it (90 % of the time less)"
    return [Check("head: height").error("the head is at no person's height above the floor", evidence, fix)]


def check_points(points: PointCloud, head: HeadStream | None) -> list[Finding]:
    """A cloud in metres around the wearer, with a floor at standing height below the head."""
    check, cloud = Check("points"), points.points_world
    if not cloud.isfinite().all():
        evidence = f"{int((~cloud.isfinite()).any(-1).sum())} of {len(cloud)}"
        return [check.error("points are NaN", evidence, "Drop them.")]
    if len(cloud) < 50:
        fix = "If few were sure enough to keep, loosen the thresholds."
        return [check.warning("hardly any points", f"{len(cloud)} points", fix)]
    spread = quantile((cloud - cloud.median(0).values).norm(dim=-1), 0.5)
    evidence = f"{len(cloud)} points, half of them within {spread:.3g} m"
    if not 0.2 < spread < 200:
        return [check.error("not a surrounding in metres", evidence, "Check the cloud's unit.")]
    found = check.ok("a surrounding in metres", evidence)
    return [found] if head is None else [found, _check_floor(Check("points: floor"), points, head)]


def _check_floor(check: Check, points: PointCloud, head: HeadStream) -> Finding:
    """The floor in the points is clear, and at the distance of a standing or sitting person's head."""
    try:
        floor = estimate_floor(points.points_world, head.t_world_device)
    except WearcapError as error:
        fix = "Points and head are in different worlds, or z is not up."
        return check.error("no points below the head", str(error), fix)
    usual, confidence = quantile(head.t_world_device[:, 2] - floor.height, 0.8), floor.confidence.median()
    evidence = f"the head is {usual:.2f} m above it (80 % of the time less), confidence {confidence:.2f}"
    if confidence < 0.1:
        fix = (
            "Check that points and head share a world with z up; else give the floor's height or the wearer's stature."
        )
        return check.note("no clear floor", evidence, fix)
    if not 0.9 < usual < 2.1:
        fix = "Check unit and up axis of both."
        return check.warning("the floor is at no standing or sitting distance", evidence, fix)
    return check.ok("a floor below the head", evidence)


def check_camera(stream: CameraStream) -> list[Finding]:
    """The camera looks ahead and is upright on the head; it has as many images as timestamps."""
    findings = []
    images = stream.embedding if stream.embedding is not None else stream.image_files
    if images is not None and len(images) != len(stream.timestamps):
        evidence = f"{len(images)} and {len(stream.timestamps)}"
        check = Check("camera: frames")
        findings.append(check.error("images and timestamps differ in number", evidence, "Pair them again."))
    view, down, check = stream.R_head_cam[:, 2], stream.R_head_cam[:, 1], Check("camera: axes")
    evidence = f"view {100 * view[0]:.0f} % forward, image's down {-100 * down[2]:.0f} % downward in head axes"
    if view[0] < 0.3:
        fix = "R_head_cam turns camera axes (x right, y down, z forward) into head axes."
        findings.append(check.warning("the camera does not look ahead", evidence, fix))
    elif down[2] > -0.5:
        fix = "Turn the images upright, or keep it in mind."
        findings.append(check.note("the camera is rolled", evidence, fix))
    else:
        findings.append(check.ok("looks ahead, upright", evidence))
    if not 0.1 < stream.camera.fx / stream.camera.width < 5:
        evidence = f"fx {stream.camera.fx:g} px at {stream.camera.width} px width"
        fix = "fx is in pixels of the stored image size."
        findings.append(Check("camera: intrinsics").warning("a focal length of no camera", evidence, fix))
    return findings


def check_localization(found: Localization, body: Motion | None, claps: list[Finding]) -> list[Finding]:
    """Share of localised frames, plausibility of the camera's path for a head, and its clock; claps are `check_claps`."""
    check, known = Check("localization"), found.confidence > 0
    share = known.float().mean().item()
    edges = torch.cat([found.timestamps[:1], found.timestamps[known], found.timestamps[-1:]])
    outage_s = edges.diff().max().item()
    evidence = f"{100 * share:.0f} % of {len(known)} frames, longest outage {outage_s:.1f} s"
    if int(known.sum()) < 2:
        fix = "Check that map, camera intrinsics and video belong together."
        return [check.error("hardly any frame was found", evidence, fix)]
    fix = "Add database photos where the wearer walked."
    if share < 0.5:
        findings = [check.warning("few frames were found", evidence, fix)]
    elif outage_s > LONG_OUTAGE_S:
        findings = [check.note("the camera was found", evidence, fix)]
    else:
        findings = [check.ok("the camera was found", evidence)]
    if not found.t_world_cam[known].isfinite().all():
        return [*findings, check.error("found positions are NaN", "", "Their confidence should be 0.")]
    track = Trajectory(found.timestamps[known], found.R_world_cam[known], found.t_world_cam[known])
    turned = check_rotations("localization", track.R_world_body)
    findings += turned
    if has_error(turned):
        return findings
    good = outlier_mask(track, MAX_SPEED)
    wrong, check = 1 - good.float().mean().item(), Check("localization: speed")
    evidence = f"{100 * wrong:.1f} % lie further off than {MAX_SPEED:g} m/s allow"
    if wrong > 0.1:
        fix = "Raise the number of inliers that a pose needs."
        findings.append(check.warning("positions jump", evidence, fix))
    else:
        findings.append(check.ok("a path that a head takes", evidence))
    if track.R_world_body[:, 2, 1].median() > 0:  # an OpenCV camera's y axis points down
        evidence = "its y axis points up in the world"
        fix = "Poses are of OpenCV's camera in the world (x right, y down, z forward), the world's z up."
        findings.append(Check("localization: axes").warning("the camera is mounted upside down", evidence, fix))
    track = track[good]
    if body is None or "head" not in body.skeleton or share < 0.5 or len(track) < 30:
        return findings
    head, seen = body.joint("head"), smooth(track, 0.05)
    # Turns about the vertical, which suit and scene share, depend on neither mount nor heading.
    turning = angular_velocity(Trajectory(body.timestamps, head.R, head.t))[:, 2]
    lag = lag_between(body.timestamps, turning, seen.timestamps, angular_velocity(seen)[:, 2], CAMERA_LAG_S)
    if lag is not None and lag[1] < 0.5 and (spread := turning.std().item()) < HARDLY_TURNS:
        evidence = f"the head turns at {spread:.2g} rad/s, correlation {lag[1]:.2f}"
        return [*findings, Check("localization: clock offset").note("not enough motion to compare clocks", evidence)]
    clapped = any(finding.severity == "ok" for finding in claps)
    return findings + check_offset("localization: clock offset", lag, "the camera", clapped)


def check_claps(recording: Recording) -> list[Finding]:
    """Whether the wrist sensors recorded a clap, by which camera and suit can be synchronised."""
    filmed = recording.localization is not None or (recording.camera is not None and recording.camera.video)
    worn = [recording.imu[name] for name in ("left_wrist", "right_wrist") if name in recording.imu]
    wrists = [imu for imu in worn if len(imu.timestamps) > 9 and (imu.acc_world is not None or imu.acc_imu is not None)]
    if not filmed or not wrists:
        return []
    try:
        claps = detect_claps(*wrists)
    except WearcapError as error:
        fix = "Where camera and suit are not on one clock already, give the clap's time by hand."
        return [Check("claps").note(error.what, str(error.where or ""), fix)]
    return [Check("claps").ok(f"{len(claps)} found", ", ".join(f"{t:.2f} s" for t in claps[:5].tolist()))]


def check_files(recording: Recording, root: Path) -> list[Finding]:
    """Existence of the video (its size and frame count, too) and of the scan that a recording names, below its data set."""
    findings = []
    stream = recording.camera
    if stream is not None and stream.video:
        check, size = Check("camera: video"), (stream.camera.width, stream.camera.height)
        frames, (width, height) = len(stream.timestamps), size
        try:
            video = video_info(root / stream.video)
        except WearcapError as error:
            findings.append(refusal(error, check.name))
        else:
            if (video.width, video.height) != size:
                evidence = f"{video.width}x{video.height} pixels, calibrated at {width}x{height}"
                fix = "Calibrate at the video's size (wearcap calibrate), or scale the intrinsics (Camera.scaled)."
                findings.append(check.error("image size and calibration differ", evidence, fix))
            elif video.frames and abs(video.frames - frames) > 1:
                evidence = f"{video.frames} and {frames}"
                findings.append(check.error("frames and timestamps differ in number", evidence, "Pair them again."))
            else:
                findings.append(check.ok("fits its calibration", f"{video.frames} frames of {width}x{height}"))
    if recording.scene and not (root / recording.scene).is_file():
        fix = "Put it there, or prepare the data set again; capture takes another: scene=FOLDER."
        findings.append(Check(SCAN_FILE).error("the scan is missing", str(root / recording.scene), fix))
    return findings


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
        # Specific force is 9.81 m/s² upwards on average; its length is more while the sensor is swung about.
        check, lengths, up = Check(f"{stream}: accelerometer"), [quantile(imu.acc_imu.norm(dim=-1), 0.5)], None
        if imu.R_world_imu is not None:
            up = (imu.R_world_imu.double() @ imu.acc_imu.double()[..., None])[..., 0].mean(0) / GRAVITY
            lengths.append(GRAVITY * up.norm().item())
        usual = min(lengths, key=lambda length: abs(math.log(max(length, 1e-9) / GRAVITY)))
        evidence = f"{'median' if usual == lengths[0] else 'mean in world axes'} {usual:.4g} m/s² long"
        if not 0.8 * GRAVITY < usual < 1.25 * GRAVITY:
            off = {name: abs(math.log(max(usual, 1e-9) * unit / GRAVITY)) for name, unit in _ACC_UNITS.items()}
            unit = min(off, key=lambda name: off[name])
            what, fix = "does not measure gravity", "If gravity was removed, it belongs into acc_world."
            if off[unit] < 0.25:
                what, fix = f"is in {unit}, not m/s²", f"Multiply by {_ACC_UNITS[unit]:.5g}."
            findings.append(check.error(what, evidence, fix))
        elif up is None:
            findings.append(check.ok("measures gravity", evidence))
        else:
            evidence += f", points along ({', '.join(f'{v:+.2f}' for v in up.tolist())}) of the world"
            what = "gravity does not point along z"
            fix = "The sensor's orientation is in another world, or its axes are exchanged."
            if up[2] < -0.85:
                what, fix = "its sign is reversed", "Negate it: at rest specific force points up."
            upwards = check.ok("measures gravity, upwards", evidence)
            findings.append(upwards if up[2] > 0.85 else check.error(what, evidence, fix))
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


def check_offset(
    name: str, lag: tuple[float, float, float] | None, who: str = "the sensor", clapped: bool = False
) -> list[Finding]:
    """Whether two clocks agree, by a lag of `lag_between`; an empty list if it could not be measured.

    An offset is only noted where a capture can join the clocks by claps (`clapped`).
    """
    if lag is None:
        return []
    check, (seconds, best, unshifted) = Check(name), lag
    evidence = f"correlation {best:.2f} at {1000 * seconds:+.0f} ms, {unshifted:.2f} without a shift"
    if best < 0.5:
        fix = "Another joint, another recording, or a clock further off than is searched."
        return [check.warning("does not match this motion", evidence, fix)]
    if abs(seconds) > 0.02 and 1 - unshifted > 2 * (1 - best) + 0.001:
        severity = "error" if abs(seconds) > 0.05 and best > CERTAIN else "warning"
        what, fix = f"{who} is {'late' if seconds > 0 else 'early'}", f"Add {-seconds:+.3f} s to its timestamps."
        if clapped:
            severity, fix = "note", f"Capture joins the clocks by claps. For clock=shared: {fix}"
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
    if agreement < -0.5 and scale < -0.5:
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
