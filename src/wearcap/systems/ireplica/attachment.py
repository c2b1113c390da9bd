"""Attachment of objects to hands: which object is held, how it moves, where it is left (thesis §5.3.2, §5.3.3)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.interactions import Interactions
from wearcap.scene.environment import Environment
from wearcap.scene.object_motion import ANCHORS, ObjectState, follow_hands
from wearcap.scene.objects import CONTACT_CLASSES, SceneObject
from wearcap.systems.ireplica.contact_intervals import ContactInterval, ContactSettings, active, contact_intervals


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
    """Longest approach and retreat (s) at an interval's beginning and end, cut off where the hands are slowest; 0: none
    is cut off (thesis)."""
    keep_object: bool = True
    """Whether the object stays the same when hands join or leave without a pause; False: it is searched again
    (thesis)."""

    def __post_init__(self):
        if self.anchor not in ANCHORS or not self.reach_m > 0:
            raise WearcapError(
                f"anchor {self.anchor!r}, reach {self.reach_m} m",
                expected=f"one of {', '.join(ANCHORS)}, and a positive distance",
            )


@dataclass(frozen=True)
class Held:
    """An interval in which hands hold an object, with the object's poses at its frames."""

    interval: ContactInterval
    scene_object: SceneObject
    contact_class: str
    state: ObjectState
    """State of the object when it was taken."""
    points_world: Float[Tensor, "hand 3"]
    """Touched point at the start: the object's point nearest to each hand (m); NaN for a hand without contact."""
    goes_on: bool
    """Whether a hand already held the object before the interval."""
    T_world_object: Rigid
    """Poses of the object at the interval's frames."""
    value: Float[Tensor, "time"]
    """Value of the object's degree of freedom at the interval's frames."""

    @property
    def hands(self) -> Bool[Tensor, "hand"]:
        return torch.tensor(self.interval.hands)

    @property
    def left_state(self) -> ObjectState:
        """State of the object at the end of the interval."""
        return ObjectState(self.T_world_object[-1], float(self.value[-1]))


@dataclass(eq=False)
class Room:
    """Current state of all objects while interactions are processed in order of time."""

    environment: Environment
    settings: AttachmentSettings
    states: dict[str, ObjectState] = field(init=False)

    def __post_init__(self):
        self.states = {
            scene_object.name: ObjectState(scene_object.T_world_object) for scene_object in self.environment.objects
        }

    def nearest(
        self, palms_world: Float[Tensor, "hand 3"], contact_class: str, contact: ContactInterval
    ) -> SceneObject | None:
        """The object of the class that is nearest to a contacting hand, within reach; None if there is none."""
        contacting = palms_world[torch.tensor(contact.hands)]
        poses = {name: state.T_world_object for name, state in self.states.items()}
        found = self.environment.nearest(contacting, poses, contact_class, self.settings.reach_m)
        if not bool((found.object_index >= 0).any()):
            return None
        return self.environment.objects[int(found.object_index[found.distance.argmin()])]

    def touched(
        self, scene_object: SceneObject, palms_world: Float[Tensor, "hand 3"], contact: ContactInterval
    ) -> Tensor:
        """Contact points p_c: the object's point nearest to each contacting hand (m; NaN for the other hand)."""
        pose = self.states[scene_object.name].T_world_object
        _, points = self.environment.distance(scene_object.name, palms_world, pose)
        points[~torch.tensor(contact.hands)] = torch.nan
        return points

    def take(
        self,
        contact: ContactInterval,
        contact_class: str,
        scene_object: SceneObject,
        points: Tensor,
        goes_on: bool,
        palms_world: Float[Tensor, "time hand 3"],
    ) -> Held:
        """Move the object with the hands over the interval's frames, and leave it there."""
        state = self.states[scene_object.name]
        hands = torch.tensor(contact.hands)
        T, value = follow_hands(scene_object, state, palms_world, hands, self.settings.anchor)
        held = Held(contact, scene_object, contact_class, state, points, goes_on, T, value)
        self.states[scene_object.name] = held.left_state
        return held


def class_intervals(
    contact_prob: dict[str, Float[Tensor, "time hand"]],
    timestamps: Float64[Tensor, "time"],
    contact: ContactSettings,
    one_class: bool,
) -> list[tuple[ContactInterval, str]]:
    """Contact intervals of every class, in order of time. With `one_class`, a hand's less probable class is dropped."""
    if one_class and len(contact_prob) > 1:
        best = torch.stack(list(contact_prob.values())).amax(0)
        contact_prob = {name: torch.where(prob >= best, prob, 0.0) for name, prob in contact_prob.items()}
    found = [
        (interval, name)
        for name in CONTACT_CLASSES
        if name in contact_prob
        for interval in contact_intervals(active(contact_prob[name], timestamps, contact))
    ]
    return sorted(found, key=lambda row: (row[0].start, row[0].stop))


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
