"""Interface of detectors of body joints in videos, and a detector that replays recorded detections."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from wearcap.errors import WearcapError
from wearcap.recording.recording import Cue


class Keypoint(NamedTuple):
    """One joint in a picture (pixels, centres at integers)."""

    x: float
    y: float
    confidence: float
    """0…1."""


@runtime_checkable
class Detector(Protocol):
    """Detects joints in the images of one video, called in their order."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all detectable joints, as in the skeleton."""
        ...

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        """The detected joints; others are absent."""
        ...


class RecordedDetections:
    """Replays recorded detections: for each image those nearest in time."""

    def __init__(self, cues: Mapping[str, Cue], within_s: float):
        """`within_s`: largest time difference between a detection and its image.

        Raises WearcapError for cues that are no pixels.
        """
        for cue in cues.values():
            if cue.points.shape[-1] != 2:
                raise WearcapError(f"{cue.joint!r} has {cue.points.shape[-1]} coordinates", expected="2: pixels")
        self._within_s = within_s
        self._cues = {
            cue.joint: (cue.timestamps.numpy(), cue.points.numpy(), cue.confidence.numpy())
            for cue in cues.values()
            if len(cue.timestamps)
        }

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self._cues)

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        found = {}
        for joint, (times, points, confidence) in self._cues.items():
            after = int(np.searchsorted(times, time_s).clip(max=len(times) - 1))
            row = min((max(after - 1, 0), after), key=lambda k: abs(times[k] - time_s))
            if abs(times[row] - time_s) <= self._within_s:
                found[joint] = Keypoint(*points[row].tolist(), confidence[row].item())
        return found
