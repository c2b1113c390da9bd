"""Object tracking from contacts of a registered wearer: attach, correct, move, release (thesis §5.3.1–5.3.3)."""

from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate
from wearcap.recording import Motion
from wearcap.recording.timing import at_times
from wearcap.scene.environment import Environment
from wearcap.scene.objects import SceneObject
from wearcap.systems.ireplica.attachment import (
    AttachmentSettings,
    Held,
    Room,
    class_intervals,
    interactions_of,
    object_trajectories,
)
from wearcap.systems.ireplica.contact_intervals import ContactInterval, ContactSettings
from wearcap.systems.ireplica.hand_snapping import HandSnapping
from wearcap.systems.ireplica.settling import settled

PALMS = ("left_palm", "right_palm")
"""Keypoints in the middle of each hand (thesis §5.3.3)."""


@runtime_checkable
class Correction(Protocol):
    """Contact-based correction: moves the wearer in the ground plane so that hands meet the object (thesis §5.3.1)."""

    def start(self, palms_world: Float[Tensor, "time hand 3"], motion: Motion) -> None:
        """Begin a recording."""
        ...

    def offset(
        self, contact: ContactInterval, scene_object: SceneObject, points_world: Float[Tensor, "hand 3"], goes_on: bool
    ) -> Float[Tensor, "frame 2"]:
        """Offset of the wearer (m) at an interval's frames; intervals are passed in order of time."""
        ...

    def finish(self, held: list[Held]) -> Float[Tensor, "time 2"]:
        """Offset of the wearer (m) at every frame of the recording, smooth into and out of interactions."""
        ...


@dataclass(eq=False)
class ObjectTracker:
    """Moves objects with the hands that hold them, one contact interval after the other."""

    correction: Correction | None
    """Contact-based correction of the wearer; None: the thesis's row "w/o contact correction"."""
    contact: ContactSettings = field(default_factory=ContactSettings)
    attachment: AttachmentSettings = field(default_factory=AttachmentSettings)
    hands: HandSnapping | None = None
    """Correction of the arms (ours); None: only the whole body is moved."""

    def __call__(self, registered: Motion, contacts: dict[str, Tensor], environment: Environment) -> Motion:
        """Return the corrected motion with `object_motion`, `interactions` and `hand_contact_prob`, at the contacts'
        frames.

        `contacts` has probabilities "time hand" by class, and their "timestamps".
        """
        motion = within(registered, contacts["timestamps"])
        prob = {
            name: interpolate(contacts["timestamps"], value, motion.timestamps)
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
        self,
        motion: Motion,
        palms: Float64[Tensor, "time hand 3"],
        spans: list[tuple[ContactInterval, str]],
        environment: Environment,
    ) -> list[Held]:
        room, held, busy_until = Room(environment, self.attachment), [], [0, 0]
        if self.correction is not None:
            self.correction.start(palms, motion)
        for span, contact_class in spans:
            contact = once_free(span, busy_until) if self.attachment.one_class else span
            if contact.start >= contact.stop:
                continue
            before = self._kept(held, contact, contact_class)
            scene_object = before or room.nearest(palms[contact.start], contact_class, contact)
            if scene_object is None:
                continue
            points = room.touched(scene_object, palms[contact.start], contact)
            frames = palms[contact.start : contact.stop].clone()
            if self.correction is not None:
                offset = self.correction.offset(contact, scene_object, points, before is not None)
                frames[..., :2] += offset[:, None]
            held.append(room.take(contact, contact_class, scene_object, points, before is not None, frames))
            busy_until = [contact.stop if on else until for on, until in zip(contact.hands, busy_until)]
        return sorted(held, key=lambda row: row.interval.start)

    def _kept(self, held: list[Held], contact: ContactInterval, contact_class: str) -> SceneObject | None:
        """The object that the hands already hold, if only the set of hands changes."""
        if not self.attachment.keep_object:
            return None
        for row in reversed(held[-4:]):
            shared = any(a and b for a, b in zip(row.interval.hands, contact.hands))
            if row.contact_class == contact_class and row.interval.stop == contact.start and shared:
                return row.scene_object
        return None


def once_free(contact: ContactInterval, busy_until: list[int]) -> ContactInterval:
    """Cut the interval's beginning until none of its hands holds another object; the result may be empty."""
    busy = [until for on, until in zip(contact.hands, busy_until) if on]
    return replace(contact, start=max(contact.start, *busy))


def within(registered: Motion, timestamps: Float64[Tensor, "time"]) -> Motion:
    """The registered motion at the contacts' frames within its time span. Raises WearcapError if there are none."""
    first, last = registered.timestamps[0], registered.timestamps[-1]
    inside = (timestamps >= first) & (timestamps <= last)
    if not inside.any():
        raise WearcapError(
            f"a motion in the scene from {first.item():.3f} to {last.item():.3f} s and contacts at other times",
            expected="both on one clock",
        )
    return at_times(registered, timestamps[inside].contiguous())
