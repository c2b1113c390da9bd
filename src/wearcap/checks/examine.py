"""Examine one recording: each stream, then streams against each other."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from jaxtyping import Float64
from torch import Tensor

from wearcap.body.skeleton import xsens23
from wearcap.checks.body import check_contact_prob, check_motion
from wearcap.checks.consistency import (
    check_camera,
    check_carried,
    check_claps,
    check_fingers,
    check_hand,
    check_head_against_body,
    check_head_cue,
    check_imu,
    check_localization,
    check_points,
)
from wearcap.checks.report import SEVERITIES, Check, Finding, has_error
from wearcap.checks.streams import check_clock, check_spans, check_track
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import FloorTrack, HeadStream, Motion, Recording
from wearcap.scene.floor import estimate_floor
from wearcap.tracking.stature import estimate_stature, skeleton_of

UNUSUAL_M = 0.10
"""Difference of heights beyond which a wearer's body is doubtful."""


def examine_recording(recording: Recording) -> list[Finding]:
    """All findings of one recording, the worst first."""
    clocks = _clocks(recording)
    if is_empty(recording):
        return [Check("recording").error("is empty", "", "It holds no stream.")]
    if not clocks:
        return check_points(recording.points, None)
    findings = [finding for name, times in clocks.items() for finding in check_clock(name, times)]
    broken = {f.check.split(":")[0] for f in findings if f.severity == "error" and f.what != "dropped frames"}
    usable = {name for name, times in clocks.items() if name not in broken and len(times) > 1}
    findings += check_spans({name: times for name, times in clocks.items() if name in usable})
    # Each usable stream, then pairs of streams; streams with errors are not compared.
    head = recording.head if "head" in usable else None
    on_head: list[Finding] = []
    if head is not None:
        on_head = check_track("head", Trajectory(head.timestamps, head.R_world_device, head.t_world_device))
    tracked = None if has_error(on_head) else head
    floor = recording.floor
    if floor is None and recording.points is not None and tracked is not None:
        with suppress(WearcapError):
            below = estimate_floor(recording.points.points_world, tracked.t_world_device)
            floor = FloorTrack(tracked.timestamps, below.height) if below.confidence.median() > 0.3 else None
    bodies = {}
    for name, motion in (("motion", recording.motion), ("suit", recording.suit)):
        if motion is not None and name in usable:
            found = [*check_motion(name, motion, floor), *check_contact_prob(name, motion)]
            findings += found
            if not has_error(found):
                bodies[name] = motion
    body = bodies.get("motion", bodies.get("suit"))
    if head is not None and body is not None and has_error(on_head):
        on_head = _explained_by(body, head, on_head)
    findings += on_head
    head = None if has_error(on_head) else head
    if head is not None and body is not None:
        findings += check_head_against_body(head, body)
    if head is not None:
        findings += _check_height(recording)
        findings += [check_hand(joint, hand, head) for joint, hand in recording.tracked.items() if len(hand)]
        if recording.floor is not None and len(recording.floor.timestamps):
            findings += check_carried(head, recording.floor)
    if head is not None and "head" in recording.cues:
        findings.append(check_head_cue(head, recording.cues["head"]))
    for name, imu in recording.imu.items():
        if f"imu {name}" in usable:
            path = None
            if body is not None and imu.joint in body.skeleton:
                T, times = body.joint(imu.joint), body.timestamps
                path = Trajectory(times, T.R, T.t)
            elif head is not None and imu.joint == "head":
                path = Trajectory(head.timestamps, head.T_world_head.R, head.T_world_head.t)
            findings += check_imu(f"imu {name}", imu, path)
    if recording.points is not None:
        findings += check_points(recording.points, head)
    if recording.camera is not None:
        findings += check_camera(recording.camera)
    findings += [*(claps := check_claps(recording)), *(check_fingers(*of, head) for of in recording.fingers.items())]
    if recording.localization is not None and "localization" in usable:
        findings += check_localization(recording.localization, bodies.get("suit", body), claps)
    return sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))


def _check_height(recording: Recording) -> list[Finding]:
    """The wearer's height as the head's height over a known floor tells it, against that of the skeleton, if there is one."""
    own, check = skeleton_of(recording), Check("height")
    found = estimate_stature(recording, own or xsens23())
    if own is None and found.source != "unknown":
        return [check.note(str(found), "no skeleton in the recording", "Give height=… (m) where it is known.")]
    if own is None or not found.known:
        return []
    evidence = f"{found}; the skeleton is {own.stature:.2f} m tall"
    if abs(found.height_m - own.stature) > UNUSUAL_M:
        what, fix = "the body does not fit how high the head is carried", f"Give height={found.height_m:.2f}."
        return [check.warning(what, evidence, fix)]
    return [check.ok("the body fits how high the head is carried", evidence)]


def _explained_by(body: Motion, head: HeadStream, findings: list[Finding]) -> list[Finding]:
    """Findings of a head that is not upright, no errors where it rides on a sound body that bends down or lies."""
    if any(f.severity in ("error", "warning") for f in check_head_against_body(head, body)):
        return findings
    fix = "Its wearer bends down or lies, as the body does."
    return [
        replace(f, severity="warning", fix=fix) if f.severity == "error" and f.check == "head: up axis" else f
        for f in findings
    ]


def require_sound(recording: Recording, found: Sequence[Finding] = ()) -> None:
    """Raise WearcapError with the first error among findings on a recording that are known, and of its examination."""
    for finding in (*found, *examine_recording(recording)):
        if finding.severity == "error":
            evidence = f" ({finding.evidence})" if finding.evidence else ""
            what = f"the doctor finds, {finding.check}: {finding.what}{evidence}"
            raise WearcapError(what, fix=f"{finding.fix} check=false goes on all the same.".strip())


def is_empty(recording: Recording) -> bool:
    """Whether a recording has neither a stream nor points."""
    return not _clocks(recording) and recording.points is None


def _clocks(recording: Recording) -> dict[str, Float64[Tensor, "_"]]:
    streams = {name: getattr(recording, name) for name in ("head", "motion", "suit", "camera", "localization")}
    streams |= {f"imu {name}": imu for name, imu in recording.imu.items()}
    return {name: stream.timestamps for name, stream in streams.items() if stream is not None}
