"""Checks of a recording before it enters a data set."""

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.recording.recording import MIN_DURATION_S, Recording
from wearcap.recording.serialize import flatten

RATES_HZ = (1.0, 2000.0)
ORTHOGONAL_WITHIN = 1e-3
MAY_BE_UNKNOWN = ("localization.", "cues.")
"""Streams whose frames without a measurement may hold NaN beside a confidence of 0."""


def check_recording(recording: Recording) -> None:
    """Raise WearcapError when numbers are not finite, timestamps do not rise, or rotations are invalid.

    Every stream needs rising timestamps; `motion` and `head` a plausible rate and at least `MIN_DURATION_S`.
    """
    _, tensors = flatten(recording)
    for key, tensor in tensors.items():
        if tensor.is_floating_point() and not key.startswith(MAY_BE_UNKNOWN):
            _require_finite(recording.name, key, tensor)
        if key.endswith("timestamps"):
            _require_rising(recording.name, key, tensor)
        if key.rpartition(".")[2].startswith("R_") and not key.startswith(MAY_BE_UNKNOWN):
            _require_rotations(recording.name, key, tensor)
    for part in ("motion", "head"):
        if f"{part}.timestamps" in tensors:
            _require_clock(recording.name, part, tensors[f"{part}.timestamps"])
    if recording.motion is None and recording.head is None:
        raise WearcapError("neither a motion nor a head path", where=recording.name, expected="one at least")


def _require_finite(name: str, key: str, tensor: Tensor) -> None:
    bad = ~torch.isfinite(tensor)
    if bad.any():
        frame = int(bad.flatten(1).any(1).nonzero()[0]) if tensor.ndim > 1 else int(bad.nonzero()[0])
        raise WearcapError(
            f"{int(bad.sum())} values of {key} are not finite, the first in row {frame}",
            where=name,
            expected="numbers",
            fix="Mend or drop the source.",
        )


def _require_rising(name: str, key: str, timestamps: Tensor) -> None:
    still = (timestamps.diff() <= 0).nonzero()
    if len(still):
        raise WearcapError(
            f"{key} do not rise at row {int(still[0]) + 1} (frame rate 0?)",
            where=name,
            expected="strictly rising seconds",
        )


def _require_rotations(name: str, key: str, R: Tensor) -> None:
    R = R.double().reshape(-1, 3, 3)
    away = (R.transpose(-1, -2) @ R - torch.eye(3, dtype=R.dtype)).abs().amax((-1, -2))
    bad = (away > ORTHOGONAL_WITHIN) | (torch.linalg.det(R) < 0)
    if bad.any():
        raise WearcapError(
            f"{int(bad.sum())} matrices of {key} are no rotations",
            where=name,
            expected=f"orthogonal within {ORTHOGONAL_WITHIN}, determinant +1",
        )


def _require_clock(name: str, part: str, timestamps: Tensor) -> None:
    if len(timestamps) < 2 or (duration := (timestamps[-1] - timestamps[0]).item()) < MIN_DURATION_S:
        raise WearcapError(
            f"{part} has {len(timestamps)} frames", where=name, expected=f"at least {MIN_DURATION_S} s of motion"
        )
    fps = (len(timestamps) - 1) / duration
    if not RATES_HZ[0] <= fps <= RATES_HZ[1]:
        raise WearcapError(
            f"{part} runs at {fps:.4g} frames per second",
            where=name,
            expected=f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g}",
            fix="Give the true frame rate of the source.",
        )
