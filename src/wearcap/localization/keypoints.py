"""What finds a body's joints in the pictures of a video, and detections that another program wrote down."""

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
    """Finds joints in the pictures of one video, which it is shown in their order."""

    @property
    def joints(self) -> tuple[str, ...]:
        """All that it may find, by the skeleton's names."""
        ...

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], time_s: float) -> dict[str, Keypoint]:
        """The joints that are seen; those that are not are absent."""
        ...


class RecordedDetections:
    """A detector that repeats what was found before: for each picture the detections nearest in time."""

    def __init__(self, cues: Mapping[str, Cue], within_s: float):
        """`within_s`: detections further than this from a picture's time are not its own.

        Raises WearcapError for cues that are no pixels.
        """
        for cue in cues.values():
            if cue.points.shape[-1] != 2:
                raise WearcapError(
                    f"{cue.joint!r} has {cue.points.shape[-1]} coordinates", expected="2: pixels"
                )
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
