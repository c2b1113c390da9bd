"""Checks of a camera-localised recording (HPS): localisation, the suit's contacts, claps, referenced files."""

from pathlib import Path

import torch

from wearcap.doctor.inertial import offset_finding
from wearcap.doctor.poses import check_rotations
from wearcap.doctor.report import Finding, refusal
from wearcap.doctor.signals import lag_between
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory, angular_velocity, outlier_mask, smooth
from wearcap.io.formats.video import video_info
from wearcap.recording import Localization, Motion, Recording
from wearcap.sensors.alignment import MAX_SPEED
from wearcap.sensors.claps import detect_claps

LONG_OUTAGE_S = 30.0


def check_localization(found: Localization, body: Motion | None) -> list[Finding]:
    """Share of localised frames, plausibility of the camera's path for a head, and its clock."""
    known = found.confidence > 0
    share = known.float().mean().item()
    evidence = f"{100 * share:.0f} % of {len(known)} frames, longest outage {_longest_outage_s(found):.1f} s"
    if int(known.sum()) < 2:
        return [
            Finding(
                "error",
                "localization",
                "hardly any frame was found",
                evidence,
                "Check that map, camera intrinsics and video belong together.",
            )
        ]
    severity = "warning" if share < 0.5 else "note" if _longest_outage_s(found) > LONG_OUTAGE_S else "ok"
    findings = [
        Finding(
            severity,
            "localization",
            "few frames were found" if share < 0.5 else "the camera was found",
            evidence,
            "Add database photos where the wearer walked." if severity != "ok" else "",
        )
    ]
    if not found.t_world_cam[known].isfinite().all():
        return [
            *findings,
            Finding("error", "localization", "found positions are NaN", "", "Their confidence should be 0."),
        ]
    track = Trajectory(found.timestamps[known], found.R_world_cam[known], found.t_world_cam[known])
    turned = check_rotations("localization", track.R_world_body)
    findings += turned
    if any(finding.severity == "error" for finding in turned):
        return findings
    good = outlier_mask(track, MAX_SPEED)
    wrong = 1 - good.float().mean().item()
    findings.append(
        Finding(
            "warning" if wrong > 0.1 else "ok",
            "localization: speed",
            "positions jump" if wrong > 0.1 else "a path that a head takes",
            f"{100 * wrong:.1f} % lie further off than {MAX_SPEED:g} m/s allow",
            "Raise the number of inliers that a pose needs." if wrong > 0.1 else "",
        )
    )
    if track.R_world_body[:, 2, 1].median() > 0:  # an OpenCV camera's y axis points down
        findings.append(
            Finding(
                "warning",
                "localization: axes",
                "the camera is mounted upside down",
                "its y axis points up in the world",
                "Poses are of OpenCV's camera in the world (x right, y down, z forward), the world's z up.",
            )
        )
    return findings + _clock(track[good], share, body)


def _longest_outage_s(found: Localization) -> float:
    known = found.timestamps[found.confidence > 0]
    if not len(known):
        return (found.timestamps[-1] - found.timestamps[0]).item()
    edges = torch.cat([found.timestamps[:1], known, found.timestamps[-1:]])
    return edges.diff().max().item()


def _clock(track: Trajectory, share: float, body: Motion | None) -> list[Finding]:
    """The camera turns like the body's head, at the same time."""
    if body is None or "head" not in body.skeleton or share < 0.5 or len(track) < 30:
        return []
    head, seen = body.joint("head"), smooth(track, 0.05)
    # Turns about the vertical, which suit and scene share, depend on neither mount nor heading.
    turning = angular_velocity(Trajectory(body.timestamps, head.R, head.t))[:, 2]
    lag = lag_between(body.timestamps, turning, seen.timestamps, angular_velocity(seen)[:, 2])
    offset = offset_finding(lag, "the camera")
    if offset is None:
        return []
    return [Finding(offset.severity, "localization: clock offset", offset.what, offset.evidence, offset.fix)]


def check_contact_prob(stream: str, motion: Motion) -> list[Finding]:
    """Foot contacts have one row per pose, are probabilities, and are neither always nor never present."""
    contact, check = motion.contact_prob, f"{stream}: contacts"
    if contact is None:
        return []
    if len(contact) != len(motion):
        short = "shorter" if len(contact) < len(motion) else "longer"
        return [
            Finding(
                "error",
                check,
                f"contacts are {short} than poses",
                f"{len(contact)} rows for {len(motion)} poses",
                "Cut or resample both together.",
            )
        ]
    if not ((contact >= 0) & (contact <= 1)).all():
        return [
            Finding(
                "error",
                check,
                "contacts are no probabilities",
                f"{contact.min():.3g} … {contact.max():.3g}",
                "Values from 0 to 1.",
            )
        ]
    share = (contact > 0.5).float().mean().item()
    evidence = f"a part of a foot touches the ground {100 * share:.0f} % of the time"
    if not 0.02 < share < 0.98:
        return [
            Finding(
                "warning",
                check,
                "feet never touch" if share < 0.5 else "feet never lift",
                evidence,
                "Check the contacts' columns: heel and toe of the left, then of the right foot.",
            )
        ]
    return [Finding("ok", check, "feet touch and lift", evidence)]


def check_claps(recording: Recording) -> list[Finding]:
    """Whether the wrist sensors recorded a clap, by which camera and suit can be synchronised."""
    filmed = recording.localization is not None or (recording.camera is not None and recording.camera.video)
    wrists = [
        recording.imu[name]
        for name in ("left_wrist", "right_wrist")
        if name in recording.imu
        and len(recording.imu[name].timestamps) > 9
        and not (recording.imu[name].acc_world is None and recording.imu[name].acc_imu is None)
    ]
    if not filmed or not wrists:
        return []
    try:
        claps = detect_claps(*wrists)
    except WearcapError as error:
        return [
            Finding(
                "note",
                "claps",
                error.what,
                str(error.where or ""),
                "Where camera and suit are not on one clock already, give the clap's time by hand.",
            )
        ]
    return [Finding("ok", "claps", f"{len(claps)} found", ", ".join(f"{t:.2f} s" for t in claps[:5].tolist()))]


def check_files(recording: Recording, root: Path) -> list[Finding]:
    """Existence of the video and the scan that a recording names, relative to its data set's folder."""
    findings = []
    stream = recording.camera
    if stream is not None and stream.video:
        findings += _video(root / stream.video, len(stream.timestamps), (stream.camera.width, stream.camera.height))
    if recording.scene and not (root / recording.scene).is_file():
        findings.append(
            Finding(
                "error",
                "scene: file",
                "the scan is missing",
                str(root / recording.scene),
                "Put it there, or prepare the data set again.",
            )
        )
    return findings


def _video(path: Path, frames: int, size: tuple[int, int]) -> list[Finding]:
    check = "camera: video"
    try:
        video = video_info(path)
    except WearcapError as error:
        return [refusal(error, check)]
    if (video.width, video.height) != size:
        return [
            Finding(
                "error",
                check,
                "image size and calibration differ",
                f"{video.width}x{video.height} pixels, calibrated at {size[0]}x{size[1]}",
                "Calibrate at the video's size (wearcap calibrate), or scale the intrinsics (Camera.scaled).",
            )
        ]
    if video.frames and abs(video.frames - frames) > 1:
        return [
            Finding(
                "error",
                check,
                "frames and timestamps differ in number",
                f"{video.frames} and {frames}",
                "Pair them again.",
            )
        ]
    return [Finding("ok", check, "fits its calibration", f"{video.frames} frames of {size[0]}x{size[1]}")]
