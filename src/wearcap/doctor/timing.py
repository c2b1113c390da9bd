"""Checks of timestamps: rates, gaps, jitter, order."""

from jaxtyping import Float64
from torch import Tensor

from wearcap.doctor.report import Finding


def check_clock(stream: str, timestamps: Float64[Tensor, "time"]) -> list[Finding]:
    """Rate, order, gaps and jitter of one stream's timestamps (s)."""
    check = f"{stream}: clock"
    if len(timestamps) < 2:
        return [Finding("warning", check, f"{len(timestamps)} frames", "", "There is nothing to examine in time.")]
    if not timestamps.isfinite().all():
        return [
            Finding(
                "error",
                check,
                "timestamps are NaN",
                f"{int((~timestamps.isfinite()).sum())} of them",
                "Drop these frames.",
            )
        ]
    steps = timestamps.diff()
    if (steps <= 0).any():
        first = int((steps <= 0).nonzero()[0]) + 1
        return [
            Finding(
                "error",
                check,
                "timestamps do not rise",
                f"{int((steps <= 0).sum())} times, first at frame {first} ({timestamps[first]:.4f} s)",
                "Sort the frames by time and drop repeated ones.",
            )
        ]
    step = steps.median().item()
    findings = [_rate(check, timestamps, step), *_gaps(check, timestamps, step)]
    regular = steps[steps < 1.5 * step]
    jitter = ((regular - step).square().mean().sqrt() / step).item()
    if jitter > 0.1:
        findings.append(
            Finding(
                "warning",
                check,
                "uneven time steps",
                f"they vary by {100 * jitter:.0f} % of a step",
                "Use the sensor's own clock, not the time of arrival, or resample.",
            )
        )
    return findings


def _rate(check: str, timestamps: Tensor, step: float) -> Finding:
    span = (timestamps[-1] - timestamps[0]).item()
    evidence = f"{1 / step:.2f} Hz, {len(timestamps)} frames, {span:.1f} s"
    if 1 / step > 5000 or 1 / step < 2:
        return Finding(
            "error",
            check,
            f"a rate of {1 / step:.4g} Hz",
            evidence,
            "Timestamps are in seconds: divide µs by 1e6, ns by 1e9.",
        )
    return Finding("ok", check, f"{1 / step:.4g} Hz", evidence)


def _gaps(check: str, timestamps: Tensor, step: float) -> list[Finding]:
    steps = timestamps.diff()
    wide = steps > 1.5 * step
    if not wide.any():
        return []
    missing = int((steps[wide] / step).round().sum().item() - int(wide.sum()))
    share = missing / (missing + len(timestamps))
    longest = int(steps.argmax())
    evidence = (
        f"{int(wide.sum())} gaps, about {missing} frames ({100 * share:.2g} %), the longest "
        f"{steps[longest]:.3f} s at {timestamps[longest] - timestamps[0]:.2f} s"
    )
    severity = "error" if share > 0.2 else "warning"
    return [
        Finding(
            severity, check, "dropped frames", evidence, "Cut the recording at long gaps, resample over short ones."
        )
    ]


def check_spans(spans: dict[str, Float64[Tensor, "_"]]) -> list[Finding]:
    """Whether all streams overlap in time."""
    ends = {name: (t[0].item(), t[-1].item()) for name, t in spans.items() if len(t) > 1 and bool(t.isfinite().all())}
    if len(ends) < 2:
        return []
    shared = min(stop for _, stop in ends.values()) - max(start for start, _ in ends.values())
    longest = max(stop - start for start, stop in ends.values())
    listed = ", ".join(f"{name} {start:.2f} … {stop:.2f} s" for name, (start, stop) in ends.items())
    if shared <= 0:
        return [
            Finding(
                "error",
                "streams' time spans",
                "streams do not overlap in time",
                listed,
                "Their clocks differ: bring all timestamps to one clock.",
            )
        ]
    if shared < 0.8 * longest:
        return [
            Finding(
                "note", "streams' time spans", f"streams share {100 * shared / longest:.0f} % of the longest", listed
            )
        ]
    return [Finding("ok", "streams' time spans", "streams overlap", listed)]
