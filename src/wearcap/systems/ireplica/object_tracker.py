"""Object tracking from contacts of a registered wearer: contact probabilities to intervals with a fixed set of
contacting hands (thesis §5.3.2), then attach, correct, move, release (§5.3.1–5.3.3).

Without correction it also finds the active objects of a motion, for ECHO (`ActSearch`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate
from wearcap.recording import Motion
from wearcap.recording.active_objects import MARGIN_S, ActiveSpan, extended_spans
from wearcap.recording.motion import Interactions
from wearcap.recording.timing import at_times, resampled
from wearcap.scene.objects import (
    ANCHORS,
    CONTACT_CLASSES,
    UNKNOWN_CLASS,
    Environment,
    ObjectState,
    SceneObject,
    follow_hands,
)
from wearcap.systems.ireplica.contact_prediction import ContactPredictor


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds and gap filling. Raises WearcapError for a threshold outside 0…1 or a negative gap."""

    threshold: float = 0.15
    """Least probability of a contact."""
    keep: float = 0.08
    """Least probability with which a contact above the threshold goes on, before and after (hysteresis)."""
    gap_s: float = 1.0
    """Longest gap (s) between two contacts of a hand that is filled (thesis Table 5.4: 0.5)."""

    def __post_init__(self):
        if not 0.0 < self.keep <= self.threshold < 1.0 or self.gap_s < 0:
            expected = "probabilities between 0 and 1, the lower one to keep a contact, and no negative time"
            what = f"threshold {self.threshold}, keep {self.keep}, gap {self.gap_s} s"
            raise WearcapError(what, expected=expected)


@dataclass(frozen=True)
class ContactInterval:
    """Frames start … stop − 1 in which the same hands (left, right) are in contact."""

    start: int
    stop: int
    hands: tuple[bool, bool]

    def continues(self, before: "ContactInterval") -> bool:
        """Whether this interval follows another without a gap and shares a hand with it."""
        return before.stop == self.start and any(a and b for a, b in zip(before.hands, self.hands))


Span = tuple[ContactInterval, str]
"""A contact interval and its class of interaction."""


def active(
    contact_prob: Float[Tensor, "time hand"], timestamps: Float64[Tensor, "time"], settings: ContactSettings
) -> Bool[Tensor, "time hand"]:
    """Contacts of each hand after thresholding with hysteresis, and gap filling."""
    sure, above = contact_prob >= settings.threshold, contact_prob >= settings.keep
    if settings.keep < settings.threshold:
        run = torch.nn.functional.pad((above[1:] != above[:-1]).long(), (0, 0, 1, 0)).cumsum(0)
        count = torch.zeros_like(run).scatter_add_(0, run, sure.long())
        above = above & (count.gather(0, run) > 0)
    frames = torch.arange(len(above))[:, None].expand_as(above)
    last = torch.where(above, frames, -1).cummax(0).values
    following = torch.where(above, frames, len(above)).flip(0).cummin(0).values.flip(0)
    inside = (last >= 0) & (following < len(above))
    clamped = len(above) - 1
    gap = timestamps[following.clamp(max=clamped)] - timestamps[last.clamp(min=0)]
    return above | (inside & (gap <= settings.gap_s + 1e-9))


def contact_intervals(contact: Bool[Tensor, "time hand"]) -> list[ContactInterval]:
    """Runs of frames with the same non-empty set of contacting hands, in order of time."""
    if not len(contact):
        return []
    change = (contact[1:] != contact[:-1]).any(1).nonzero()[:, 0] + 1
    edges = [0, *change.tolist(), len(contact)]
    rows = [(a, b, contact[a].tolist()) for a, b in pairwise(edges)]
    return [ContactInterval(a, b, (bool(left), bool(right))) for a, b, (left, right) in rows if left or right]


def class_intervals(
    contact_prob: dict[str, Float[Tensor, "time hand"]],
    timestamps: Float64[Tensor, "time"],
    contact: ContactSettings,
    one_class: bool,
) -> list[Span]:
    """Contact intervals of every class, in order of time. With `one_class`, a hand's less probable class is dropped."""
    if one_class and len(contact_prob) > 1:
        best = torch.stack(list(contact_prob.values())).amax(0)
        contact_prob = {name: torch.where(prob >= best, prob, 0.0) for name, prob in contact_prob.items()}
    found = [
        (interval, name)
        for name in (*CONTACT_CLASSES, UNKNOWN_CLASS)
        if name in contact_prob
        for interval in contact_intervals(active(contact_prob[name], timestamps, contact))
    ]
    return sorted(found, key=lambda row: (row[0].start, row[0].stop))


def settled(
    spans: list[Span], palms_world: Float[Tensor, "time hand 3"], timestamps: Float64[Tensor, "time"], settle_s: float
) -> list[Span]:
    """Cut approach and retreat off the intervals (ours), each up to `settle_s` long, as a hand is at rest when it
    takes and releases.

    The networks report contact during the approach to an object and the retreat from it too: some tenths of a second
    in which the object would follow hands that do not hold it.
    Consecutive intervals of a class that share a hand form one hold; it begins and ends where the hands that begin and
    end it are slowest. Intervals entirely before or after that are dropped.
    """
    if settle_s <= 0 or len(timestamps) < 3:
        return spans
    reach = max(1, round(settle_s / float(timestamps.diff().median())))
    speed = palms_world.diff(dim=0).norm(dim=-1) / timestamps.diff()[:, None].to(palms_world)
    speed = torch.cat([speed, speed[-1:]])
    kept: list[Span] = []
    for chain in chains(spans):
        first, last = chain[0][0], chain[-1][0]
        middle = (first.start + last.stop) // 2
        start = _slowest(speed, chain, first.start, reach, first.start, min(first.start + reach, middle))
        stop = _slowest(speed, chain, last.stop - reach, reach, max(last.stop - reach, middle), last.stop)
        for contact, contact_class in chain:
            cut = replace(contact, start=max(contact.start, start), stop=min(contact.stop, stop + 1))
            if cut.start < cut.stop:
                kept.append((cut, contact_class))
    return sorted(kept, key=lambda row: (row[0].start, row[0].stop))


def chains(spans: list[Span]) -> list[list[Span]]:
    """Group intervals into holds: intervals of one class that follow without a gap and share a hand."""
    found: list[list[Span]] = []
    for contact, contact_class in spans:
        for chain in reversed(found[-4:]):
            if chain[-1][1] == contact_class and contact.continues(chain[-1][0]):
                chain.append((contact, contact_class))
                break
        else:
            found.append([(contact, contact_class)])
    return found


def _slowest(speed: Float[Tensor, "time hand"], hold: list[Span], near: int, reach: int, start: int, stop: int) -> int:
    """Frame in start … stop − 1 with the least mean speed of the hands in contact within `reach` frames from `near`."""
    if stop <= start:
        return start
    rows = [contact.hands for contact, _ in hold if contact.start < near + reach and contact.stop > near]
    hands = torch.tensor([any(column) for column in zip(*rows)] if rows else hold[0][0].hands)
    return start + int(speed[start:stop, hands].mean(1).argmin())


@dataclass(frozen=True)
class AttachmentSettings:
    """Rules of attachment. Raises WearcapError for an unknown anchor or a reach that is not positive."""

    reach_m: float = 0.2
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
    seek_s: float = 0.0
    """Longest time (s) after an interval's start in which a hand may come within reach; 0: at its start only (thesis)."""
    slip_m: float | None = None
    """Largest displacement (m) of a hand on the object that follows it: a hand that moves otherwise than the object can
    does not hold it; None: any (thesis)."""
    rest_m: float = 0.0
    """Least displacement (m) of an object's corners in a hold; an object that moves by less was only touched."""
    found_m: float | None = None
    """Largest distance (m) from a hand of an object that turns about a hinge or slides along an axis and is taken to stand
    elsewhere on its way, where the touch finds it: for contacts with nothing within reach, and only if it then follows the
    hand by `rest_m`. What a missed contact has moved is found again so. None: it is where it was left (thesis)."""
    class_m: float | None = None
    """Distance (m) that counts as much as a class that is e times as probable. Hands then hold by whichever class, and
    take the object with the least sum of distance, displacement on it while it follows, and this; None: the nearest of
    the class (thesis)."""

    def __post_init__(self):
        if self.anchor not in ANCHORS or not self.reach_m > 0:
            expected = f"one of {', '.join(ANCHORS)}, and a positive distance"
            raise WearcapError(f"anchor {self.anchor!r}, reach {self.reach_m} m", expected=expected)


FOUND_STEPS, FOUND_WITHIN_M = 61, 0.01
"""Places on an object's way at which it is sought, and distances (m) from the hand that count as alike."""
LEAST_FOLLOWING = 0.5
"""Least share of an interval in which hands stay at their places of the object."""
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

        `contacts` has probabilities "time hand" by class, and their "timestamps"; a contact of `UNKNOWN_CLASS` takes
        the nearest object of any. Raises WearcapError if no frame is
        within the motion's time span.
        """
        times, first, last = contacts["timestamps"], registered.timestamps[0], registered.timestamps[-1]
        inside = (times >= first) & (times <= last)
        if not inside.any():
            what = f"a motion in the scene from {first.item():.3f} to {last.item():.3f} s and contacts at other times"
            raise WearcapError(what, expected="both on one clock")
        motion = at_times(registered, times[inside].contiguous())
        prob = {
            name: interpolate(times, value, motion.timestamps)
            for name, value in contacts.items()
            if name != "timestamps"
        }
        palms = site_positions(motion.skeleton, motion.T_world_joint, PALMS).double()
        any_class = self.attachment.class_m is not None and len(prob) > 1
        merged = {UNKNOWN_CLASS: torch.stack(list(prob.values())).amax(0)} if any_class else prob
        spans = class_intervals(merged, motion.timestamps, self.contact, self.attachment.one_class)
        spans = settled(spans, palms, motion.timestamps, self.attachment.settle_s)
        held = self._held(motion, palms, spans, environment, prob if any_class else {})
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
        self,
        motion: Motion,
        palms: Float64[Tensor, "time hand 3"],
        spans: list[Span],
        environment: Environment,
        prob: dict[str, Float[Tensor, "time hand"]],
    ) -> list[Held]:
        """Attach, correct, move and release: one interval after the other, each object being where it was left.

        `prob` has the contact probabilities by class that decide between objects, if any do.
        """
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
            before = None  # the object that the hands already hold, if only the set of hands changes
            for row in reversed(held[-4:]) if self.attachment.keep_object else ():
                same = contact_class in (row.contact_class, UNKNOWN_CLASS)
                if same and contact.continues(row.interval):
                    before = row.scene_object
                    break
            if before is None:
                found = self._taken(palms, contact, contact_class, motion.timestamps, states, environment, prob)
                found = found or self._found_again(palms, contact, contact_class, states, environment)
                if found is None:
                    continue
                before_start, scene_object, state = found
                contact = replace(contact, start=before_start)
                self._undo_rest(held, states, scene_object)
                state = state or states[scene_object.name]
            else:
                scene_object, state = before, states[before.name]
            hands = torch.tensor(contact.hands)
            contact = self._following(palms, contact, hands, scene_object, state)
            if contact is None:
                continue
            _, points = environment.distance(scene_object.name, palms[contact.start], state.T_world_object)
            points[~hands] = torch.nan
            frames = palms[contact.start : contact.stop].clone()
            if self.correction is not None:
                offset = self.correction.offset(contact, scene_object, points, before is not None)
                frames[..., :2] += offset[:, None]
            T, value = follow_hands(scene_object, state, frames, hands, self.attachment.anchor)
            states[scene_object.name] = ObjectState(T[-1], float(value[-1]))
            held.append(Held(contact, scene_object, scene_object.freedom.contact_class, state, T))
            busy_until = [contact.stop if on else until for on, until in zip(contact.hands, busy_until)]
        for scene_object in environment.objects:
            self._undo_rest(held, states, scene_object)
        return sorted(held, key=lambda row: row.interval.start)

    def _taken(
        self,
        palms: Float64[Tensor, "time hand 3"],
        contact: ContactInterval,
        contact_class: str,
        timestamps: Float64[Tensor, "time"],
        states: dict[str, ObjectState],
        environment: Environment,
        prob: dict[str, Float[Tensor, "time hand"]],
    ) -> tuple[int, SceneObject, None] | None:
        """The first frame of an interval, up to `seek_s` after its start, in which a hand is within reach of an object of
        the class, and the object that it takes (`class_m`); None where there is none: the contact is a false positive."""
        latest = timestamps[contact.start] + self.attachment.seek_s
        stop = min(int(torch.searchsorted(timestamps, latest, right=True)), contact.stop)
        touching = palms[contact.start : stop, torch.tensor(contact.hands)]
        poses = {name: state.T_world_object for name, state in states.items()}
        found = environment.nearest(touching.flatten(0, 1), poses, contact_class or None, self.attachment.reach_m)
        index, distance = (value.unflatten(0, touching.shape[:2]) for value in (found.object_index, found.distance))
        within = (index >= 0).any(1).nonzero()[:, 0]
        if not len(within):
            return None
        frame = int(within[0])
        if self.attachment.class_m is not None:
            interval = replace(contact, start=contact.start + frame)
            return interval.start, self._likeliest(palms, interval, states, environment, prob), None
        return contact.start + frame, environment.objects[int(index[frame, distance[frame].argmin()])], None

    def _found_again(
        self,
        palms: Float64[Tensor, "time hand 3"],
        contact: ContactInterval,
        contact_class: str,
        states: dict[str, ObjectState],
        environment: Environment,
    ) -> tuple[int, SceneObject, ObjectState] | None:
        """An object that would be within `found_m` of the hands elsewhere on its way and then follow them, with that state;
        of several the nearest; None where there is none."""
        most = self.attachment.found_m
        if most is None:
            return None
        hands, frames = torch.tensor(contact.hands), palms[contact.start : contact.stop]
        touching, best = frames[0, hands], None
        for item in environment.objects:
            limits = item.freedom.limits
            wrong = contact_class not in (UNKNOWN_CLASS, item.freedom.contact_class)
            if wrong or limits is None or item.freedom.kind not in ("hinge", "axis"):
                continue
            values = torch.linspace(*limits, FOUND_STEPS, dtype=torch.float64)
            T = item.freedom.moved(item.T_world_object, values)
            away = torch.stack(
                [environment.distance(item.name, p.expand(FOUND_STEPS, 3), T)[0] for p in touching]
            ).amin(0)
            change = (values - states[item.name].value).abs()
            near = (
                away <= away.min() + FOUND_WITHIN_M
            )  # among places that fit alike, the one nearest to where it was left
            k = int(torch.where(near, change, torch.inf).argmin())
            state = ObjectState(T[k], float(values[k]))
            if away[k] > most or (best is not None and away[k] >= best[0]):
                continue
            slips = self._slip(frames, hands, item, state).quantile(0.75) > (self.attachment.slip_m or torch.inf)
            rests = (frames[:, hands] - touching).norm(dim=-1).amax() < self.attachment.rest_m
            if not slips and not rests:
                best = (float(away[k]), contact.start, item, state)
        return None if best is None else best[1:]

    def _likeliest(
        self,
        palms: Float64[Tensor, "time hand 3"],
        contact: ContactInterval,
        states: dict[str, ObjectState],
        environment: Environment,
        prob: dict[str, Float[Tensor, "time hand"]],
    ) -> SceneObject:
        """Of the objects within reach, the one with the least sum of the hands' distance from it, the root mean square of
        their displacements on it while it follows them, and what its class is less probable (`class_m`)."""
        hands, frames = torch.tensor(contact.hands), slice(contact.start, contact.stop)
        odds = {
            name: (self.attachment.class_m or 0.0) * value[frames][:, hands].mean().clamp(min=1e-3).log()
            for name, value in prob.items()
        }
        costs = []
        for item in environment.objects:
            state = states[item.name]
            away, _ = environment.distance(item.name, palms[contact.start, hands], state.T_world_object)
            cost = float(away.min())
            if cost <= self.attachment.reach_m:
                slip = self._slip(palms[frames], hands, item, state)
                costs.append(
                    (cost + float(slip.square().mean().sqrt() - odds.get(item.freedom.contact_class, 0.0)), item)
                )
        return min(costs, key=lambda row: row[0])[1]

    def _slip(
        self, palms: Float64[Tensor, "time hand 3"], hands: Bool[Tensor, "hand"], item: SceneObject, state: ObjectState
    ) -> Float64[Tensor, "time"]:
        """Displacement (m) of the hands from their places on an object that follows them, the larger of both."""
        T, _ = follow_hands(item, state, palms, hands, self.attachment.anchor)
        T = T.to(torch.float64)
        local = (T.R.mT[:, None] @ (palms[:, hands] - T.t[:, None])[..., None])[..., 0]
        return (local - local.median(0).values).norm(dim=-1).amax(1)

    def _following(
        self,
        palms: Float64[Tensor, "time hand 3"],
        contact: ContactInterval,
        hands: Bool[Tensor, "hand"],
        scene_object: SceneObject,
        state: ObjectState,
    ) -> ContactInterval | None:
        """The part of an interval in which the hands stay at their places of the object that follows them, within
        `slip_m`; None where they do not for half of it: they move otherwise than the object can."""
        frames, most = palms[contact.start : contact.stop], self.attachment.slip_m
        if most is None:
            return contact
        slip = self._slip(frames, hands, scene_object, state)
        on = slip <= most
        if on.float().mean() < LEAST_FOLLOWING:
            return None
        middle = len(on) // 2 if on[len(on) // 2] else int(on.nonzero()[:, 0].median())
        off = (~on).nonzero()[:, 0]
        before, after = off[off < middle], off[off > middle]
        start = int(before[-1]) + 1 if len(before) else 0
        stop = int(after[0]) if len(after) else len(on)
        return replace(contact, start=contact.start + start, stop=contact.start + stop)

    def _undo_rest(self, held: list[Held], states: dict[str, ObjectState], scene_object: SceneObject) -> None:
        """Leave an object where it was before its last hold if that moved it by less than `rest_m`: `held` and `states`
        are changed."""
        own = [k for k, row in enumerate(held) if row.scene_object is scene_object]
        if not own or self.attachment.rest_m == 0.0:
            return
        chain = own[-1:]
        for k in reversed(own[:-1]):
            if not held[chain[0]].interval.continues(held[k].interval):
                break
            chain.insert(0, k)
        first = held[chain[0]].state
        low, high = scene_object.mesh.vertices.min(0), scene_object.mesh.vertices.max(0)
        corners = torch.cartesian_prod(*torch.from_numpy(np.stack([low, high], 1)).double())
        rest = first.T_world_object.to(torch.float64)
        before, moved = _at(rest, corners), []
        for k in chain:
            moved.append(_at(held[k].T_world_object[:, None].to(torch.float64), corners) - before)
        if max(float(each.norm(dim=-1).max()) for each in moved) < self.attachment.rest_m:
            for k in chain:
                count = len(held[k].T_world_object.t)
                still = Rigid(rest.R.expand(count, 3, 3), rest.t.expand(count, 3))
                held[k] = replace(held[k], state=first, T_world_object=still)
            states[scene_object.name] = first


def _at(T: Rigid, points: Float64[Tensor, "point 3"]) -> Float64[Tensor, "*batch point 3"]:
    return (T.R @ points[..., None])[..., 0] + T.t


def object_trajectories(
    environment: Environment, held: Sequence[Held], timestamps: Float64[Tensor, "time"]
) -> dict[str, Trajectory]:
    """Poses of every object over time: static except while held. Objects that never move have two frames only."""
    tracks = {}
    for scene_object in environment.objects:
        own = [row for row in held if row.scene_object.name == scene_object.name]
        times = timestamps if own else timestamps[[0, -1]]
        R = scene_object.R_world_object.float().repeat(len(times), 1, 1)
        t = scene_object.t_world_object.float().repeat(len(times), 1)
        for row in own:
            frames = slice(row.interval.start, row.interval.stop)
            R[frames], t[frames] = row.T_world_object.R.float(), row.T_world_object.t.float()
            R[row.interval.stop :], t[row.interval.stop :] = R[row.interval.stop - 1], t[row.interval.stop - 1]
        tracks[scene_object.name] = Trajectory(times, R, t)
    return tracks


def interactions_of(held: Sequence[Held], timestamps: Float64[Tensor, "time"]) -> Interactions:
    """Interactions (object, hands, times) as a recording stores them."""
    edges = torch.cat([timestamps, timestamps[-1:] + (timestamps.diff().median() if len(timestamps) > 1 else 0.0)])
    return Interactions(
        edges[[row.interval.start for row in held]],
        edges[[row.interval.stop for row in held]],
        torch.tensor([row.interval.hands for row in held], dtype=torch.bool).reshape(-1, 2),
        tuple(row.scene_object.name for row in held),
        tuple(row.contact_class for row in held),
    )


@dataclass(eq=False)
class ActSearch:
    """Finds spans in a motion of the human alone, which `Echo` captures first."""

    checkpoints: Sequence[str]
    """Checkpoints of iReplica's contact networks."""
    tracker: ObjectTracker = field(
        default_factory=lambda: ObjectTracker(None, ContactSettings(0.5, 0.5, 0.5), AttachmentSettings(reach_m=0.5))
    )
    """Object tracker, without correction: the wearer stays where the head was measured. Hands are not, as a suit's are:
    they reach farther, and no motion of theirs is refused."""
    margin_s: float = MARGIN_S
    """Time (s) for which an object is already active before it is touched and still active after its release."""

    @cached_property
    def predictor(self) -> ContactPredictor:
        return ContactPredictor.load(*self.checkpoints)

    def __call__(self, motion: Motion, environment: Environment) -> tuple[ActiveSpan, ...]:
        """Acts in order of time; none where no contacting hand is within reach of an object."""
        rate = max(detector.fps for detector in self.predictor.detectors)
        fine = resampled(motion, rate)
        contacts = {"timestamps": fine.timestamps, **self.predictor(fine)}
        found = self.tracker(fine, contacts, environment).interactions
        if found is None:
            return ()
        rows = sorted(zip(found.start_s.tolist(), found.stop_s.tolist(), found.objects))
        return tuple(
            extended_spans([ActiveSpan(name, start, stop) for start, stop, name in rows if name], self.margin_s)
        )
