"""Other people in a recorded motion: bones drawn from a distribution of people, with what follows from them.

Joint rotations are kept. Everything below the hips, the pelvis's path and the floor are scaled alike, so that feet stay where
they stand; trunk, shoulders and arms have proportions of their own. Few recorded people thus become many (ours). Places on
the body, and their accelerations, are sums over the body's parts, which are packed apart and weighed for each window.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.data.batch import Batch
from wearcap.data.features import body_size
from wearcap.errors import WearcapError
from wearcap.recording.motion import Motion

PARTS = ("device", "legs", "trunk", "shoulders", "upper_arms", "forearms")
"""Parts of which a place is the sum. "device": from the joint to what it wears, the same for everybody; "legs": also feet and
hips, and the body's path; "forearms": also hands."""
_TRUNK = ("l5", "l3", "t12", "t8", "neck", "head")
_SHOULDERS = ("collar", "shoulder")


def part_of(joint: str) -> int:
    """Index in `PARTS` of the bone that ends at a joint."""
    if joint in _TRUNK:
        return PARTS.index("trunk")
    if joint.endswith(_SHOULDERS):
        return PARTS.index("shoulders")
    if joint.endswith("elbow"):
        return PARTS.index("upper_arms")
    return PARTS.index("forearms" if joint.endswith("wrist") else "legs")


def bones_in_parts(skeleton: Skeleton) -> Float[Tensor, "joint part 3"]:
    """Bone offsets (m), each in its part."""
    parts = torch.tensor([part_of(name) for name in skeleton.joint_names])
    own = torch.nn.functional.one_hot(parts, len(PARTS)).float()
    return own[..., None] * skeleton.t_parent_joint[:, None]


def places_in_parts(motion: Motion, joints: Sequence[str]) -> Float[Tensor, "time joint part 3"]:
    """Joints' positions (m), of which each part's bones give a share."""
    skeleton, chosen = motion.skeleton, motion.skeleton.indices(*joints)
    shares = []
    for part, bones in zip(PARTS, bones_in_parts(skeleton).unbind(1)):
        root = motion.t_world_root if part == "legs" else torch.zeros_like(motion.t_world_root)
        shares.append(forward_kinematics(skeleton, motion.R_parent_joint, root, bones).t[:, chosen])
    return torch.stack(shares, 2)


def head_in_parts(motion: Motion, t_world_head: Float[Tensor, "time 3"]) -> Float[Tensor, "time part 3"]:
    """A measured path of the head joint (m), of which each part's bones give a share; how far it is off is the device's."""
    shares = places_in_parts(motion, ["head"])[:, 0]
    shares[:, PARTS.index("device")] = t_world_head - shares.sum(1)
    return shares


def size_in_parts(skeleton: Skeleton) -> Float[Tensor, "part limb"]:
    """`body_size` (m), of which each part has a share."""
    own, shares = body_size(skeleton), []
    for part in range(len(PARTS)):
        longer = torch.ones(len(PARTS))
        longer[part] = 2.0
        shares.append(body_size(with_bones(skeleton, longer)) - own)
    return torch.stack(shares)


def with_bones(skeleton: Skeleton, bones: Float[Tensor, "part"]) -> Skeleton:
    """A skeleton with the bones of somebody else, by factors of `PARTS`."""
    factors = bones[[part_of(name) for name in skeleton.joint_names]]
    sites = {
        name: replace(site, t_joint_site=tuple(bones[part_of(site.joint)].item() * each for each in site.t_joint_site))
        for name, site in skeleton.sites.items()
    }
    return replace(skeleton, t_parent_joint=factors[:, None] * skeleton.t_parent_joint, sites=sites)


@dataclass(frozen=True)
class OtherBodies:
    """People that a motion is given to: a share of the windows of recordings in which nothing is handled.

    The others are standard deviations of the logarithm of a factor. They are about those among adults (statures 6 %; of
    people as tall, legs, trunk and arms 3 %, shoulders 5 %, the elbow's place along the arm 2 %), on top of the people's
    who were recorded.
    """

    share: float = 0.875
    stature: float = 0.05
    limb: float = 0.03
    shoulders: float = 0.05
    elbow: float = 0.02
    arms: float = 0.0
    """Share of these people whose arms move as somebody else's, where the trunks agree (`arm_mixing`)."""

    def __post_init__(self):
        if not 0 < self.share <= 1:
            expected = "a share of the windows, from 0 to 1, or no other bodies: null"
            raise WearcapError(f"share={self.share} of other bodies", expected=expected)
        if not 0 <= self.arms <= 1:
            raise WearcapError(f"arms={self.arms} of other bodies", expected="a share of the people, from 0 to 1")

    def cut(self, batch: Batch) -> Batch:
        """With the people who do the motion, and the tracks of those whose arms are others'."""
        assert batch.varied is not None
        draws, other = batch.draws, batch.varied & (batch.draws.uniform("other body") < self.share)
        spreads = (self.stature, self.limb, self.limb, self.limb, self.shoulders, self.elbow)
        normal = draws.normal("body", len(spreads)).unbind(1)
        stature, legs, trunk, arms, shoulders, elbow = (spread * each for spread, each in zip(spreads, normal))
        logs = (legs, trunk, shoulders, arms + elbow, arms - elbow)
        bones = torch.stack([torch.zeros_like(stature), *(stature + each for each in logs)], 1).exp()
        batch = replace(batch, bones=torch.where(other[:, None], bones, 1.0), others=other)
        if not self.arms or batch.versions is None:
            return batch
        number = (draws.uniform("whose arms", 1) * batch.versions.shape[1]).long()
        mixed = other & (draws.uniform("other arms") < self.arms)
        return replace(batch, track=torch.where(mixed, batch.versions.gather(1, number)[:, 0], batch.track))

    def __call__(self, batch: Batch) -> Batch:
        """With the body's places, its size and the floor as these people have them."""
        assert batch.bones is not None
        legs, changed = batch.bones[:, PARTS.index("legs"), None], {}
        for name, value in batch.values.items():
            if name == "t_world_root":
                changed[name] = value * legs[..., None]
            elif name.startswith("floor"):
                changed[name] = value * legs
            elif name in batch.parts:
                bones = batch.bones.reshape(len(legs), *[1] * (value.ndim - 3), len(PARTS), 1)
                changed[name] = sum(value[..., part, :] * bones[..., part, :] for part in range(len(PARTS)))
        return batch.changed(**changed)
