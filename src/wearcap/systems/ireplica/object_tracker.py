"""Object tracking from contacts of a registered wearer: attach, correct, move, release (thesis §5.3.1–5.3.3).

Without correction it also finds the active objects of a motion, for ECHO (`ActSearch`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.recording import Motion
from wearcap.recording.acts import MARGIN_S, Act, spread_acts
from wearcap.recording.motion import Interactions
from wearcap.recording.timing import at_times, resampled
from wearcap.scene.environment import Environment
from wearcap.scene.objects import ANCHORS, ObjectState, SceneObject, follow_hands
from wearcap.systems.ireplica.contact_intervals import ContactInterval, ContactSettings, Span, class_intervals, settled
from wearcap.systems.ireplica.contact_prediction import ContactPredictor


@dataclass(frozen=True)
class AttachmentSettings:
    """Rules of attachment. Raises WearcapError for an unknown anchor or a reach that is not positive."""

    reach_m: float = 0.5
    """Largest distance (m) from a contacting hand to the object it takes; a contact farther from every object of its
    class is a false positive (thesis §5.3.1)."""
    anchor: str = "middle"
    """Point that carries an object held by two hands: the "right" hand (thesis) or the "middle" of both (ours)."""
    one_class: bool = True
    """Whether a hand can hold by its more probable class only; False: both networks work independently (thesis)."""
    settle_s: float = 0.4
    """Longest approach and retreat (s) at an interval's ends, cut off where the hands are slowest; 0: none (thesis)."""
    keep_object: bool = True
    """Whether the object stays when hands join or leave without a pause; False: it is searched again (thesis)."""

    def __post_init__(self):
        if self.anchor not in ANCHORS or not self.reach_m > 0:
            raise WearcapError(
                f"anchor {self.anchor!r}, reach {self.reach_m} m",
                expected=f"one of {', '.join(ANCHORS)}, and a positive distance",
            )


PALMS = ("left_palm", "right_palm")
"""Keypoints in the middle of each hand (thesis §5.3.3)."""


@dataclass(frozen=True)
class Held:
    """An interval in which hands hold an object, with the object's poses at its frames."""

    interval: ContactInterval
    scene_object: SceneObject
    contact_class: str
    state: ObjectState
    """State of the object when it was taken."""
    T_world_object: Rigid
    """Poses of the object at the interval's frames."""


class Correction(ABC):
    """Contact-based correction: moves the wearer in the ground plane so that hands meet the object (thesis §5.3.1)."""

    def start(self, palms_world: Float[Tensor, "time hand 3"], motion: Motion) -> None:
        """Begin a recording: target offset (m) and weight of each frame are zero."""
        self._palms, self._timestamps = palms_world, motion.timestamps
        self._path = motion.t_world_root[:, :2].double()
        self._targets = palms_world.new_zeros(len(palms_world), 2)
        self._weights = palms_world.new_zeros(len(palms_world))

    @abstractmethod
    def offset(
        self, contact: ContactInterval, scene_object: SceneObject, points_world: Float[Tensor, "hand 3"], goes_on: bool
    ) -> Float[Tensor, "frame 2"]:
        """Offset of the wearer (m) at an interval's frames; intervals are passed in order of time."""

    @abstractmethod
    def finish(self, held: list[Held]) -> Float[Tensor, "time 2"]:
        """Offset of the wearer (m) at every frame of the recording, smooth into and out of interactions."""


@dataclass(eq=False)
class ObjectTracker:
    """Moves objects with the hands that hold them, one contact interval after the other."""

    correction: Correction | None
    """Contact-based correction of the wearer; None: the thesis's row "w/o contact correction"."""
    contact: ContactSettings = field(default_factory=ContactSettings)
    attachment: AttachmentSettings = field(default_factory=AttachmentSettings)
    hands: Callable[[Motion, Sequence[Held], Environment], Motion] | None = None
    """Correction of the arms (ours, `HandSnapping`); None: only the whole body is moved."""

    def __call__(self, registered: Motion, contacts: dict[str, Tensor], environment: Environment) -> Motion:
        """Return the corrected motion with `object_motion`, `interactions` and `hand_contact_prob`, at the contacts'
        frames within the registered motion's time span.

        `contacts` has probabilities "time hand" by class, and their "timestamps". Raises WearcapError if no frame is
        within the motion's time span.
        """
        times, first, last = contacts["timestamps"], registered.timestamps[0], registered.timestamps[-1]
        inside = (times >= first) & (times <= last)
        if not inside.any():
            raise WearcapError(
                f"a motion in the scene from {first.item():.3f} to {last.item():.3f} s and contacts at other times",
                expected="both on one clock",
            )
        motion = at_times(registered, times[inside].contiguous())
        prob = {
            name: interpolate(times, value, motion.timestamps)
            for name, value in contacts.items()
            if name != "timestamps"
        }
        palms = site_positions(motion.skeleton, motion.T_world_joint, PALMS).double()
        spans = class_intervals(prob, motion.timestamps, self.contact, self.attachment.one_class)
        spans = settled(spans, palms, motion.timestamps, self.attachment.settle_s)
        held = self._held(motion, palms, spans, environment)
        offset = palms.new_zeros(len(motion), 2) if self.correction is None else self.correction.finish(held)
        shift = torch.nn.functional.pad(offset, (0, 1))
        moved = replace(
            motion,
            t_world_root=(motion.t_world_root.double() + shift).float(),
            hand_contact_prob=torch.stack(list(prob.values())).amax(0).float(),
            object_motion=object_trajectories(environment, held, motion.timestamps),
            interactions=interactions_of(held, motion.timestamps),
        )
        return moved if self.hands is None else self.hands(moved, held, environment)

    def _held(
        self, motion: Motion, palms: Float64[Tensor, "time hand 3"], spans: list[Span], environment: Environment
    ) -> list[Held]:
        """Attach, correct, move and release: one interval after the other, each object being where it was left."""
        states = {one.name: ObjectState(one.T_world_object) for one in environment.objects}
        held, busy_until = [], [0, 0]
        if self.correction is not None:
            self.correction.start(palms, motion)
        for contact, contact_class in spans:
            if self.attachment.one_class:  # a hand takes nothing while it holds another object
                busy = [until for on, until in zip(contact.hands, busy_until) if on]
                contact = replace(contact, start=max(contact.start, *busy))
            if contact.start >= contact.stop:
                continue
            before = self._kept(held, contact, contact_class)
            scene_object = before or self._nearest(environment, states, palms[contact.start], contact_class, contact)
            if scene_object is None:
                continue
            state, hands = states[scene_object.name], torch.tensor(contact.hands)
            _, points = environment.distance(scene_object.name, palms[contact.start], state.T_world_object)
            points[~hands] = torch.nan
            frames = palms[contact.start : contact.stop].clone()
            if self.correction is not None:
                offset = self.correction.offset(contact, scene_object, points, before is not None)
                frames[..., :2] += offset[:, None]
            T, value = follow_hands(scene_object, state, frames, hands, self.attachment.anchor)
            states[scene_object.name] = ObjectState(T[-1], float(value[-1]))
            held.append(Held(contact, scene_object, contact_class, state, T))
            busy_until = [contact.stop if on else until for on, until in zip(contact.hands, busy_until)]
        return sorted(held, key=lambda row: row.interval.start)

    def _kept(self, held: list[Held], contact: ContactInterval, contact_class: str) -> SceneObject | None:
        """The object that the hands already hold, if only the set of hands changes."""
        if not self.attachment.keep_object:
            return None
        for row in reversed(held[-4:]):
            if row.contact_class == contact_class and contact.continues(row.interval):
                return row.scene_object
        return None

    def _nearest(
        self,
        environment: Environment,
        states: dict[str, ObjectState],
        palms_world: Float[Tensor, "hand 3"],
        contact_class: str,
        contact: ContactInterval,
    ) -> SceneObject | None:
        """The object of the class that is nearest to a contacting hand, within reach; None if there is none."""
        poses = {name: state.T_world_object for name, state in states.items()}
        contacting = palms_world[torch.tensor(contact.hands)]
        found = environment.nearest(contacting, poses, contact_class, self.attachment.reach_m)
        if not bool((found.object_index >= 0).any()):
            return None
        return environment.objects[int(found.object_index[found.distance.argmin()])]


def object_trajectories(
    environment: Environment, held: Sequence[Held], timestamps: Float64[Tensor, "time"]
) -> dict[str, Trajectory]:
    """Poses of every object over time: static except while held. Objects that never move have two frames only."""
    tracks = {}
    for scene_object in environment.objects:
        own = [row for row in held if row.scene_object.name == scene_object.name]
        if not own:
            ends = timestamps[[0, -1]]
            tracks[scene_object.name] = Trajectory(
                ends,
                scene_object.R_world_object.float().expand(2, 3, 3),
                scene_object.t_world_object.float().expand(2, 3),
            )
            continue
        R = scene_object.R_world_object.float().repeat(len(timestamps), 1, 1)
        t = scene_object.t_world_object.float().repeat(len(timestamps), 1)
        for row in own:
            frames = slice(row.interval.start, row.interval.stop)
            R[frames], t[frames] = row.T_world_object.R.float(), row.T_world_object.t.float()
            R[row.interval.stop :], t[row.interval.stop :] = (R[row.interval.stop - 1], t[row.interval.stop - 1])
        tracks[scene_object.name] = Trajectory(timestamps, R, t)
    return tracks


def interactions_of(held: Sequence[Held], timestamps: Float64[Tensor, "time"]) -> Interactions:
    """Interactions (object, hands, times) as a recording stores them."""
    edges = torch.cat([timestamps, timestamps[-1:] + (timestamps.diff().median() if len(timestamps) > 1 else 0.0)])
    start = [float(edges[row.interval.start]) for row in held]
    stop = [float(edges[row.interval.stop]) for row in held]
    hands = torch.tensor([row.interval.hands for row in held], dtype=torch.bool).reshape(-1, 2)
    return Interactions(
        torch.tensor(start, dtype=torch.float64),
        torch.tensor(stop, dtype=torch.float64),
        hands,
        tuple(row.scene_object.name for row in held),
        tuple(row.contact_class for row in held),
    )


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
