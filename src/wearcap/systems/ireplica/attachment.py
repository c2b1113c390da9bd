"""Contact intervals become interactions: which object is held, how it moves, where it is left (thesis §5.3.2, §5.3.3)."""

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
from wearcap.systems.ireplica.contact_intervals import (
    ContactInterval,
    ContactSettings,
    active,
    contact_intervals,
)


@dataclass(frozen=True)
class AttachmentSettings:
    """How objects are taken and carried. Raises WearcapError for an unknown anchor or a reach that is not positive."""

    reach_m: float = 0.5
    """A contact with no object of its class so near to the hand is a false positive (thesis §5.3.1)."""
    anchor: str = "middle"
    """What carries an object held by two hands: "right" (document) or "middle" (ours)."""
    one_class: bool = True
    """A hand holds by its more probable class alone; False: both networks work in parallel (document)."""
    settle_s: float = 0.4
    """Up to so much of an interval's beginning and end is approach and retreat, and cut off where hands are slowest;
    0: nothing is (document)."""
    keep_object: bool = True
    """When hands join or leave without a pause, the object stays the same; False: it is looked for anew (document)."""

    def __post_init__(self):
        if self.anchor not in ANCHORS or not self.reach_m > 0:
            raise WearcapError(f"anchor {self.anchor!r}, reach {self.reach_m} m",
                               expected=f"one of {', '.join(ANCHORS)}, and a positive distance")  # fmt: skip


@dataclass(frozen=True)
class Held:
    """An interval in which hands hold an object, with the object's poses at its frames."""

    interval: ContactInterval
    thing: SceneObject
    contact_class: str
    state: ObjectState
    """In which the object was taken."""
    points_world: Float[Tensor, "hand 3"]
    """Where each hand touches it at the start: its nearest point (m); NaN for a hand that does not."""
    goes_on: bool
    """Whether a hand has held the object already when the interval starts."""
    T_world_object: Rigid
    value: Float[Tensor, "time"]

    @property
    def hands(self) -> Bool[Tensor, "hand"]:
        return torch.tensor(self.interval.hands)

    @property
    def left_state(self) -> ObjectState:
        """In which the object is left."""
        return ObjectState(self.T_world_object[-1], float(self.value[-1]))


@dataclass(eq=False)
class Room:
    """Objects as they stand while interactions are gone through in order."""

    environment: Environment
    settings: AttachmentSettings
    states: dict[str, ObjectState] = field(init=False)

    def __post_init__(self):
        self.states = {thing.name: ObjectState(thing.T_world_object) for thing in self.environment.objects}

    def nearest(
        self, palms_world: Float[Tensor, "hand 3"], contact_class: str, contact: ContactInterval
    ) -> SceneObject | None:
        """The object of the class that is nearest to a contacting hand, within reach; None where there is none."""
        held = palms_world[torch.tensor(contact.hands)]
        poses = {name: state.T_world_object for name, state in self.states.items()}
        found = self.environment.nearest(held, poses, contact_class, self.settings.reach_m)
        if not bool((found.object_index >= 0).any()):
            return None
        return self.environment.objects[int(found.object_index[found.distance.argmin()])]

    def touched(
        self, thing: SceneObject, palms_world: Float[Tensor, "hand 3"], contact: ContactInterval
    ) -> Tensor:
        """p_c: the object's point nearest to each contacting hand (m, NaN for the other)."""
        pose = self.states[thing.name].T_world_object
        _, points = self.environment.distance(thing.name, palms_world, pose)
        points[~torch.tensor(contact.hands)] = torch.nan
        return points

    def take(
        self, contact: ContactInterval, contact_class: str, thing: SceneObject, points: Tensor, goes_on: bool,
        palms_world: Float[Tensor, "time hand 3"],
    ) -> Held:  # fmt: skip
        """Let the object follow the hands (of the interval's frames) and stay where they leave it."""
        state = self.states[thing.name]
        hands = torch.tensor(contact.hands)
        T, value = follow_hands(thing, state, palms_world, hands, self.settings.anchor)
        held = Held(contact, thing, contact_class, state, points, goes_on, T, value)
        self.states[thing.name] = held.left_state
        return held


def class_intervals(
    contact_prob: dict[str, Float[Tensor, "time hand"]], timestamps: Float64[Tensor, "time"],
    contact: ContactSettings, one_class: bool,
) -> list[tuple[ContactInterval, str]]:  # fmt: skip
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
    """Every object's poses over time: at rest, except while it is held. What never moves has two frames alone."""
    tracks = {}
    for thing in environment.objects:
        own = [row for row in held if row.thing.name == thing.name]
        if not own:
            ends = timestamps[[0, -1]]
            tracks[thing.name] = Trajectory(
                ends, thing.R_world_object.float().expand(2, 3, 3), thing.t_world_object.float().expand(2, 3)
            )
            continue
        R = thing.R_world_object.float().repeat(len(timestamps), 1, 1)
        t = thing.t_world_object.float().repeat(len(timestamps), 1)
        for row in own:
            frames = slice(row.interval.start, row.interval.stop)
            R[frames], t[frames] = row.T_world_object.R.float(), row.T_world_object.t.float()
            R[row.interval.stop :], t[row.interval.stop :] = (
                R[row.interval.stop - 1],
                t[row.interval.stop - 1],
            )
        tracks[thing.name] = Trajectory(timestamps, R, t)
    return tracks


def interactions_of(held: Sequence[Held], timestamps: Float64[Tensor, "time"]) -> Interactions:
    """What was held when, as a recording keeps it."""
    edges = torch.cat(
        [timestamps, timestamps[-1:] + (timestamps.diff().median() if len(timestamps) > 1 else 0.0)]
    )
    start = [float(edges[row.interval.start]) for row in held]
    stop = [float(edges[row.interval.stop]) for row in held]
    hands = torch.tensor([row.interval.hands for row in held], dtype=torch.bool).reshape(-1, 2)
    return Interactions(
        torch.tensor(start, dtype=torch.float64), torch.tensor(stop, dtype=torch.float64), hands,
        tuple(row.thing.name for row in held), tuple(row.contact_class for row in held),
    )  # fmt: skip
