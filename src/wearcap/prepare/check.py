"""Checks of a recording before it enters a data set."""

import torch

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
    where = recording.name
    _, tensors = flatten(recording)
    for key, tensor in tensors.items():
        known = not key.startswith(MAY_BE_UNKNOWN)
        if known and tensor.is_floating_point() and (bad := ~torch.isfinite(tensor)).any():
            row = int(bad.reshape(len(bad), -1).any(1).nonzero()[0])
            wrong = f"{int(bad.sum())} values of {key} are not finite, the first in row {row}"
            raise WearcapError(wrong, where=where, expected="numbers", fix="Mend or drop the source.")
        if key.endswith("timestamps") and len(still := (tensor.diff() <= 0).nonzero()):
            wrong = f"{key} do not rise at row {int(still[0]) + 1} (frame rate 0?)"
            raise WearcapError(wrong, where=where, expected="strictly rising seconds")
        if known and key.rpartition(".")[2].startswith("R_"):
            R = tensor.double().reshape(-1, 3, 3)
            away = (R.transpose(-1, -2) @ R - torch.eye(3, dtype=R.dtype)).abs().amax((-1, -2))
            bad = (away > ORTHOGONAL_WITHIN) | (torch.linalg.det(R) < 0)
            if bad.any():
                expected = f"orthogonal within {ORTHOGONAL_WITHIN}, determinant +1"
                raise WearcapError(
                    f"{int(bad.sum())} matrices of {key} are no rotations", where=where, expected=expected
                )
    for part in ("motion", "head"):
        times = tensors.get(f"{part}.timestamps")
        if times is None:
            continue
        if len(times) < 2 or (duration := (times[-1] - times[0]).item()) < MIN_DURATION_S:
            expected = f"at least {MIN_DURATION_S} s of motion"
            raise WearcapError(f"{part} has {len(times)} frames", where=where, expected=expected)
        fps = (len(times) - 1) / duration
        if not RATES_HZ[0] <= fps <= RATES_HZ[1]:
            raise WearcapError(
                f"{part} runs at {fps:.4g} frames per second",
                where=where,
                expected=f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g}",
                fix="Give the true frame rate of the source.",
            )
    if recording.motion is None and recording.head is None:
        raise WearcapError("neither a motion nor a head path", where=where, expected="one at least")
