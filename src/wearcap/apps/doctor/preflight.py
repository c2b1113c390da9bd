"""Preflight: whether a recording has what a system needs, before anything slow runs."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.checks.report import Check, Finding, refusal
from wearcap.errors import WearcapError
from wearcap.recording import Localization, Recording
from wearcap.runtime.needs import SCAN, Need
from wearcap.runtime.system import CaptureInput
from wearcap.scene.floor import estimate_floor

LEAST_OVERLAP = 0.9
"""Least share of the head's or suit's span that every needed stream covers."""
COVERED = 0.5
"""Least share of the path below which points show a floor."""
_FLOOR_CONFIDENCE = 0.3
MAX_POINTS = 1_000_000
"""Points of a scan that are looked at."""


def preflight(recording: Recording, folder: Path | None, name: str, needs: Sequence[Need]) -> list[Finding]:
    """Findings on every need of the system called `name`: there or missing, time spans, floor below the path."""
    source = CaptureInput(recording) if folder is None else CaptureInput.in_dataset(recording, folder)
    findings = []
    for need in needs:
        check = Check(f"{name} needs: {need.what}")
        if need.has(source):
            findings.append(check.ok("there"))
        else:
            what = "missing" if need.required else "missing, and helps"
            findings.append(check.found("error" if need.required else "warning", what, "", need.fix))
    findings += _spans(recording, name, {need.stream for need in needs if need.stream})
    if any(need.stream == "head" for need in needs):
        findings += _floor(recording)
    if recording.localization is not None and any(need.what == SCAN.what for need in needs):
        findings += _scanned(source, recording.localization)
    return findings


def _spans(recording: Recording, name: str, streams: set[str]) -> list[Finding]:
    """Whether every needed stream covers the one that leads: the suit's motion, else the head's path."""
    leads = next((part for part in ("suit", "head") if part in streams and getattr(recording, part) is not None), None)
    if leads is None:
        return []
    reference = getattr(recording, leads).timestamps
    check, findings = Check(f"{name}: overlap"), []
    for other, times in _times(recording, streams - {leads}).items():
        start, stop = max(times[0], reference[0]).item(), min(times[-1], reference[-1]).item()
        span = (reference[-1] - reference[0]).item()
        share = max(stop - start, 0.0) / max(span, 1e-9)
        evidence = (
            f"{leads} {reference[0].item():.2f} … {reference[-1].item():.2f} s, "
            f"{other} {times[0].item():.2f} … {times[-1].item():.2f} s"
        )
        by_claps = leads == "suit" and other in ("camera", "localization") and set(WRISTS) & set(recording.imu)
        if share <= 0 and by_claps:
            what = f"{other} shares no time with {leads}: their clocks must be joined by claps"
            findings.append(check.note(what, evidence, "Clap at the beginning and at the end."))
        elif share <= 0:
            fix = "Bring both to one clock (wearcap calibrate), or take the logs of one session."
            findings.append(check.error(f"{other} shares no time with {leads}", evidence, fix))
        elif share < LEAST_OVERLAP:
            fix = "Cut the recording to what all streams cover."
            findings.append(check.warning(f"{other} covers {100 * share:.0f} % of {leads}", evidence, fix))
        else:
            findings.append(check.ok(f"{other} covers {100 * share:.0f} % of {leads}", evidence))
    return findings


def _times(recording: Recording, streams: set[str]) -> dict[str, Float64[Tensor, "_"]]:
    found = {}
    for part in sorted(streams):
        value = getattr(recording, part)
        parts = (
            {joint: value[joint] for joint in WRISTS if joint in value} if isinstance(value, dict) else {part: value}
        )
        found |= {name: one.timestamps for name, one in parts.items() if one is not None and len(one.timestamps) > 1}
    return found


def _scanned(source: CaptureInput, path: Localization) -> list[Finding]:
    """Share of the localised path below which the scan shows a floor."""
    known = (path.confidence > 0) & path.t_world_cam.isfinite().all(-1)
    if known.sum() < 2:
        return [
            Check("floor below the path").error("no frame is localised", "", "Localise again, or build another map.")
        ]
    try:
        scan = source.read_scan()
    except WearcapError as error:
        return [refusal(error, "scan")]
    if scan is None:
        return []
    points = torch.from_numpy(scan.points[:: len(scan.points) // MAX_POINTS + 1]).float()
    return _floor_below(path.timestamps[known], path.t_world_cam[known], points)


def _floor(recording: Recording) -> list[Finding]:
    """Share of the head's path below which the points show a floor."""
    head, points = recording.head, recording.points
    if head is None or points is None or len(head.timestamps) < 2:
        return []
    return _floor_below(head.timestamps, head.t_world_device, points.points_world)


def _floor_below(
    times: Float64[Tensor, "time"], path: Float[Tensor, "time 3"], points: Float[Tensor, "point 3"]
) -> list[Finding]:
    check = Check("floor below the path")
    # Every half second is enough, and quick.
    path = path[:: max(1, round(0.5 / times.diff().median().clamp_min(1e-3).item()))]
    covered, height = 0.0, None
    with suppress(WearcapError):
        found = estimate_floor(points, path)
        covered = (found.confidence > _FLOOR_CONFIDENCE).double().mean().item()
        height = (path[:, 2] - found.height).median().item()
    evidence = f"{100 * covered:.0f} % of the path" + ("" if height is None else f", the head {height:.2f} m above it")
    if covered < COVERED:
        fix = "Look at the floor while walking, or scan the whole way; check that path and points are in one world."
        return [check.warning("points hardly show it", evidence, fix)]
    return [check.ok("points show it", evidence)]
