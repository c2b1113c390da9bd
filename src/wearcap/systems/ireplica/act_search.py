"""Which object is active when, found as iReplica finds it: contact told from the pose, then the nearest object."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from wearcap.recording import Motion
from wearcap.recording.acts import MARGIN_S, Act, spread_acts
from wearcap.recording.timing import resampled
from wearcap.scene.environment import Environment
from wearcap.systems.ireplica.contact_prediction import ContactPredictor
from wearcap.systems.ireplica.object_tracker import ObjectTracker


@dataclass(eq=False)
class ActSearch:
    """Searches in a motion of the human alone, which `Echo` captures first."""

    checkpoints: Sequence[str]
    """Of iReplica's contact networks."""
    tracker: ObjectTracker = field(default_factory=lambda: ObjectTracker(None))
    """Without correction: the wearer stays where the head was measured."""
    margin_s: float = MARGIN_S
    """For which an object is the active one before it is touched and after it is let go."""

    @cached_property
    def predictor(self) -> ContactPredictor:
        return ContactPredictor.load(*self.checkpoints)

    def __call__(self, motion: Motion, environment: Environment) -> tuple[Act, ...]:
        """Acts in the order of time; none where no hand holds anything within reach of an object."""
        rate = max(detector.fps for detector in self.predictor.detectors)
        fine = resampled(motion, rate)
        contacts = {"timestamps": fine.timestamps, **self.predictor(fine)}
        held = self.tracker(fine, contacts, environment).interactions
        if held is None:
            return ()
        rows = sorted(zip(held.start_s.tolist(), held.stop_s.tolist(), held.objects))
        return tuple(spread_acts([Act(name, start, stop) for start, stop, name in rows if name], self.margin_s))  # fmt: skip
