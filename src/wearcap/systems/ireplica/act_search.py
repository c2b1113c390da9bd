"""Detection of the active object as in iReplica: hand contact predicted from the pose, then the nearest object."""

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
    """Finds acts in a motion of the human alone, which `Echo` captures first."""

    checkpoints: Sequence[str]
    """Checkpoints of iReplica's contact networks."""
    tracker: ObjectTracker = field(default_factory=lambda: ObjectTracker(None))
    """Object tracker, without correction: the wearer stays where the head was measured."""
    margin_s: float = MARGIN_S
    """Time (s) for which an object is already active before it is touched and still active after its release."""

    @cached_property
    def predictor(self) -> ContactPredictor:
        return ContactPredictor.load(*self.checkpoints)

    def __call__(self, motion: Motion, environment: Environment) -> tuple[Act, ...]:
        """Acts in order of time; none where no contacting hand is within reach of an object."""
        rate = max(detector.fps for detector in self.predictor.detectors)
        fine = resampled(motion, rate)
        contacts = {"timestamps": fine.timestamps, **self.predictor(fine)}
        found = self.tracker(fine, contacts, environment).interactions
        if found is None:
            return ()
        rows = sorted(zip(found.start_s.tolist(), found.stop_s.tolist(), found.objects))
        return tuple(spread_acts([Act(name, start, stop) for start, stop, name in rows if name], self.margin_s))
