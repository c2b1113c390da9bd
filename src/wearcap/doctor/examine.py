"""Examine one recording, or everything in a folder."""

from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float64
from torch import Tensor

from wearcap.doctor.agreement import (
    check_camera,
    check_claps,
    check_head_against_body,
    check_head_cue,
    check_localization,
    check_points,
    floor_below,
)
from wearcap.doctor.body import check_contact_prob, check_motion
from wearcap.doctor.inertial import check_imu
from wearcap.doctor.load import patients
from wearcap.doctor.report import SEVERITIES, Check, Finding, Report, has_error, refusal
from wearcap.doctor.streams import check_clock, check_spans, check_track
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Recording


def examine(source: Recording | str | Path, progress: Callable[[int, int], None] | None = None) -> Report:
    """Examine a recording, or all in a data set, recording file, MPS folder, motion capture file or folder of them.

    Unreadable files are errors in the report; `progress(done, all)` is called after each recording.
    Raises WearcapError when there is nothing to examine.
    """
    if isinstance(source, Recording):
        return Report(source.name, {source.name: tuple(examine_recording(source))})
    found = patients(Path(source))
    findings: dict[str, tuple[Finding, ...]] = {}
    for done, (name, load) in enumerate(found.items(), 1):
        try:
            recording, read = load()
        except WearcapError as error:
            findings[name] = (refusal(error),)
        else:
            only_read = read and recording.points is None and not _clocks(recording)  # with the reader's errors
            findings[name] = tuple(read if only_read else [*read, *examine_recording(recording)])
        if progress:
            progress(done, len(found))
    return Report(str(source), findings)


def examine_recording(recording: Recording) -> list[Finding]:
    """All findings of one recording, the worst first."""
    clocks = _clocks(recording)
    if not clocks and recording.points is None:
        return [Check("recording").error("is empty", "", "It holds no stream.")]
    if not clocks:
        return check_points(recording.points, None)
    findings = [finding for name, times in clocks.items() for finding in check_clock(name, times)]
    broken = {f.check.split(":")[0] for f in findings if f.severity == "error" and f.what != "dropped frames"}
    usable = {name for name, times in clocks.items() if name not in broken and len(times) > 1}
    findings += check_spans({name: times for name, times in clocks.items() if name in usable})
    findings += _streams(recording, usable)
    return sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))


def _clocks(recording: Recording) -> dict[str, Float64[Tensor, "_"]]:
    streams = {
        "head": recording.head,
        "motion": recording.motion,
        "suit": recording.suit,
        "camera": recording.camera,
        "localization": recording.localization,
    }
    streams |= {f"imu {name}": imu for name, imu in recording.imu.items()}
    return {name: stream.timestamps for name, stream in streams.items() if stream is not None}


def _streams(recording: Recording, usable: set[str]) -> list[Finding]:
    """Findings about each usable stream, then about pairs of streams; streams with errors are not compared."""
    findings: list[Finding] = []
    head = recording.head if "head" in usable else None
    if head is not None:
        findings += check_track("head", Trajectory(head.timestamps, head.R_world_device, head.t_world_device))
        head = None if has_error(findings) else head
    floor = recording.floor
    if floor is None and recording.points is not None and head is not None:
        floor = floor_below(recording.points, head)
    bodies = {}
    for name, motion in (("motion", recording.motion), ("suit", recording.suit)):
        if motion is not None and name in usable:
            found = [*check_motion(name, motion, floor), *check_contact_prob(name, motion)]
            findings += found
            if not has_error(found):
                bodies[name] = motion
    body = bodies.get("motion", bodies.get("suit"))
    if head is not None and body is not None:
        findings += check_head_against_body(head, body)
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
    if recording.localization is not None and "localization" in usable:
        findings += check_localization(recording.localization, bodies.get("suit", body))
    return [*findings, *check_claps(recording)]
