"""Other people in a recorded motion: bones drawn from a distribution of people, with what follows from them.

Joint rotations are kept. Everything below the hips, the pelvis's path and the floor are scaled alike, so that feet stay where
they stand; trunk, shoulders and arms have proportions of their own. Few recorded people thus become many (ours).
"""

from dataclasses import dataclass, replace

import torch

from wearcap.body.skeleton import Skeleton
from wearcap.data.arm_mixing import ArmDonors
from wearcap.errors import WearcapError
from wearcap.recording.recording import FloorTrack, HeadStream, Recording
from wearcap.recording.store import RecordingFile

_TRUNK = ("l5", "l3", "t12", "t8", "neck", "head")
_SHOULDERS = ("collar", "shoulder")


@dataclass(frozen=True)
class Proportions:
    """Factors by which a body's parts are enlarged."""

    legs: float = 1.0
    """Also feet and hips, the body's path and the floor."""
    trunk: float = 1.0
    shoulders: float = 1.0
    upper_arms: float = 1.0
    forearms: float = 1.0
    """Also hands."""


@dataclass(frozen=True)
class OtherBodies:
    """People that a motion is given to: each recording has `count` of them beside its own.

    The others are standard deviations of the logarithm of a factor. They are about those among adults (statures 6 %; of
    people as tall, legs, trunk and arms 3 %, shoulders 5 %, the elbow's place along the arm 2 %), on top of the people's
    who were recorded.
    """

    count: int
    stature: float = 0.05
    limb: float = 0.03
    shoulders: float = 0.05
    elbow: float = 0.02
    arms: float = 0.0
    """Share of these people whose arms move as somebody else's, where the trunks agree (`arm_mixing`)."""

    def __post_init__(self):
        if self.count < 1:
            raise WearcapError(f"count={self.count} of other bodies", expected="1 or more, or no other bodies: null")
        if not 0 <= self.arms <= 1:
            raise WearcapError(f"arms={self.arms} of other bodies", expected="a share of the people, from 0 to 1")

    def moves_other_arms(self, seed: int) -> bool:
        """Whether the person of a seed moves the arms as somebody else."""
        return torch.rand((), generator=torch.Generator().manual_seed(seed + 1)).item() < self.arms

    def proportions(self, seed: int) -> Proportions:
        """Proportions of one person, a function of the seed."""
        normal = torch.randn(6, generator=torch.Generator().manual_seed(seed)).tolist()
        spreads = (self.stature, self.limb, self.limb, self.limb, self.shoulders, self.elbow)
        stature, legs, trunk, arms, shoulders, elbow = (spread * value for spread, value in zip(spreads, normal))
        logs = (legs, trunk, shoulders, arms + elbow, arms - elbow)
        return Proportions(*(torch.tensor(stature + each).exp().item() for each in logs))


@dataclass(frozen=True)
class OtherPerson:
    """Somebody else who does a recorded motion."""

    body: Proportions
    seed: int = 0
    donors: ArmDonors | None = None
    """Whose arms the person moves; None: the recorded ones."""

    def recording(self, file: RecordingFile) -> Recording:
        """The file's recording, done by this person."""
        recording = file.load()
        if self.donors is not None and recording.motion is not None:
            recording = replace(recording, motion=self.donors.mixed(recording.motion, file, self.seed))
        return with_proportions(recording, self.body)


def with_proportions(recording: Recording, body: Proportions) -> Recording:
    """The recording's motion done by somebody of other proportions; its head device sits as it did.

    The surroundings (points, camera, scene) and the suit's and sensors' streams are left out, as they would not fit. Raises
    WearcapError for a recording without a true motion, or in which objects are handled, which other arms would not reach.
    """
    motion = recording.motion
    if motion is None or recording.object_motion:
        what = "objects are handled" if motion is not None else "no true motion"
        raise WearcapError(f"no other body for {recording.name}: {what}", expected="a motion without objects")
    skeleton = with_bones(motion.skeleton, body)
    other = replace(motion, skeleton=skeleton, t_world_root=body.legs * motion.t_world_root)
    head, floor = recording.head, recording.floor
    if head is not None and len(head.timestamps) == len(motion):
        shift = other.joint("head").t - motion.joint("head").t
        head = HeadStream(
            head.timestamps, head.R_world_device, head.t_world_device + shift, head.R_head_device, head.t_head_device
        )
    return Recording(
        recording.name,
        head=head,
        motion=other,
        contacts=recording.contacts,
        floor=None if floor is None else FloorTrack(floor.timestamps, body.legs * floor.height),
        skeleton=skeleton,
        subject=recording.subject,
        activity=recording.activity,
        source=recording.source,
        license=recording.license,
    )


def with_bones(skeleton: Skeleton, body: Proportions) -> Skeleton:
    """A skeleton with the bones of other proportions."""
    factors = torch.tensor([_factor(name, body) for name in skeleton.joint_names])
    sites = {
        name: replace(site, t_joint_site=_scaled(site.t_joint_site, _factor(site.joint, body)))
        for name, site in skeleton.sites.items()
    }
    return replace(skeleton, t_parent_joint=factors[:, None] * skeleton.t_parent_joint, sites=sites)


def _factor(joint: str, body: Proportions) -> float:
    """Factor of the bone that ends at a joint, and of the sites on it."""
    if joint in _TRUNK:
        return body.trunk
    if joint.endswith(_SHOULDERS):
        return body.shoulders
    if joint.endswith("elbow"):
        return body.upper_arms
    return body.forearms if joint.endswith("wrist") else body.legs


def _scaled(place: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    return factor * place[0], factor * place[1], factor * place[2]
