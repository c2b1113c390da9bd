"""What the head-driven networks share: body size, frame differences, true contacts of the feet."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.metrics import physics
from wearcap.recording.recording import Recording
from wearcap.recording.store import RecordingFile

LIMBS = {
    "stature": (),
    "leg": ("left_knee", "left_ankle"),
    "arm": ("left_elbow", "left_wrist"),
    "trunk": ("l5", "l3", "t12", "t8", "neck", "head"),
}
"""Measures of body size, each as the chain of joints whose bones add up to it."""


SPREAD_M = 0.05
"""Deviation (m) whose logarithm counts as 0."""
_LOGARITHMS = -5.0, 3.0


def deviations(logarithm: Float[Tensor, "*batch joint"]) -> Float[Tensor, "*batch joint"]:
    """Standard deviations (m) along each axis of joints' positions relative to the head, as networks say them (ours)."""
    return SPREAD_M * logarithm.clamp(*_LOGARITHMS).exp()


def body_size(skeleton: Skeleton) -> Float[Tensor, "limb"]:
    """`LIMBS` of a skeleton (m): height of the head joint in the rest pose, length of leg, arm and trunk."""
    lengths = [
        sum(float(skeleton.t_parent_joint[skeleton.index(name)].norm()) for name in names) for names in LIMBS.values()
    ]
    return torch.tensor([skeleton.height_of("head"), *lengths[1:]])


def on_level_ground(file: RecordingFile) -> bool:
    """Whether a recording's floor may be taken to be where it says, or at z = 0; not where people climb on what was not
    captured, so that their height over the floor says nothing (`data_prep.shared.mocap`)."""
    motion = file.part("motion")
    return file.part("floor") is not None or motion is None or motion.provenance.get("floor") != "uneven"


def first_repeated(step: Float[Tensor, "batch step *rest"]) -> Float[Tensor, "batch time *rest"]:
    """Differences to the previous frame for every frame; the first frame repeats the second's."""
    return torch.cat([step[:, :1], step], 1)


def true_foot_contact(recording: Recording) -> Bool[Tensor, "time foot"]:
    """Contact of the left and right foot at the motion's frames, as recorded or else estimated from the true motion."""
    motion, feet = recording.motion, None if recording.contacts is None else recording.contacts.feet
    assert motion is not None
    if feet is not None and len(feet) == len(motion):
        return physics.foot_contact(feet)
    pose = motion.T_world_joint
    points = physics.foot_points(motion.skeleton, pose)
    return physics.contact_from_motion(points, physics.local_floor(pose.t, motion.fps), motion.fps)
