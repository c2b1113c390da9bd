"""Keypoints in wearcap's CSV, for tests."""

from collections.abc import Mapping
from pathlib import Path

from wearcap.recording import Cue


def write_keypoints(cues: Mapping[str, Cue], path: Path) -> None:
    """Rows sorted by time; cues without confidence are left out."""
    rows, axes = [], ""
    for cue in cues.values():
        axes = "xyz"[: cue.points.shape[-1]]
        values = zip(cue.timestamps.tolist(), cue.points.tolist(), cue.confidence.tolist())
        rows += [(time, cue.joint, [*point, sure]) for time, point, sure in values if sure > 0]
    lines = [",".join(["timestamp", "joint", *axes, "confidence"])]
    lines += [",".join([repr(time), joint, *(f"{v:.9g}" for v in rest)]) for time, joint, rest in sorted(rows)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
