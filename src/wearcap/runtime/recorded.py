"""The motion that a recording already has, in the coat of a system: of a suit, or of motion capture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from wearcap.errors import WearcapError
from wearcap.recording import Recording
from wearcap.runtime.needs import MOTION
from wearcap.runtime.system import Captured, CaptureInput, StageOptions, System


@dataclass(eq=False)
class RecordedMotion(System):
    """Captures nothing: returns the suit's own motion, else the true one, for its files and pictures."""

    name: str = "recorded"
    draws = False
    required = (MOTION,)

    def capture(
        self, recordings: Sequence[Recording | CaptureInput], seeds: Sequence[int], options: StageOptions | None = None
    ) -> list[Captured]:
        """The motion of each recording as it is. Raises WearcapError for one without a suit and without motion."""
        captures = []
        for source in recordings:
            recording = CaptureInput.of(source).recording
            motion = recording.suit or recording.motion
            if motion is None:
                expected = "a suit's motion, or motion capture"
                fix = "Choose the pipeline that makes motion of these sensors: pipeline=…"
                raise WearcapError("no motion in this recording", recording.name, expected, fix)
            provenance = motion.provenance | {"pipeline": self.name}
            captures.append(Captured(replace(motion, provenance=provenance)))
        return captures
