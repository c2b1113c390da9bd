"""Position, velocity and rotation errors of captured joints. Pure functions on tensors."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import SIDES, Skeleton
from wearcap.geometry.rotation import geodesic

CM_PER_M = 100.0


def joint_error_cm(
    joints: Float[Tensor, "*batch joint 3"], joints_true: Float[Tensor, "*batch joint 3"]
) -> Float[Tensor, "*batch joint"]:
    """Distance (cm) of every joint (m) from its true position, without any alignment."""
    return (joints - joints_true).norm(dim=-1) * CM_PER_M


def mpjpe_cm(
    joints: Float[Tensor, "*batch joint 3"], joints_true: Float[Tensor, "*batch joint 3"]
) -> Float[Tensor, ""]:
    """Mean per joint position error (cm): the mean over frames and joints. The caller first anchors captures of systems
    that are driven by the head to the true head (thesis §6.4)."""
    return joint_error_cm(joints, joints_true).mean()


def body_parts(skeleton: Skeleton) -> dict[str, list[int]]:
    """Joint indices of the body parts in the papers' tables.

    hand: both wrists. lower: hips, knees, ankles, toes. upper: every joint above the pelvis, so all but the
    pelvis and the lower ones. Raises WearcapError when the skeleton lacks one of the named joints.
    """
    hand = [skeleton.index(f"{side}_wrist") for side in SIDES]
    lower = [skeleton.index(f"{side}_{name}") for side in SIDES for name in ("hip", "knee", "ankle", "toe")]
    upper = [joint for joint in range(1, len(skeleton)) if joint not in lower]
    return {"hand": hand, "lower": lower, "upper": upper}


_PAIRED = {
    "shoulder": "arm",
    "elbow": "arm",
    "wrist": "hand",
    "hip": "leg",
    "knee": "leg",
    "ankle": "foot",
    "toe": "foot",
}
PARTS = ("head", "trunk", "arm", "hand", "leg", "foot")
"""Parts of the body that share out all joints, from head to foot; "head" has the neck, "trunk" the collars."""


def part_errors_cm(skeleton: Skeleton, error_cm: Float[Tensor, "time joint"]) -> dict[str, Float[Tensor, ""]]:
    """Mean error (cm) over frames and joints of each of `PARTS`; NaN for a part without joints."""
    part_of = []
    for name in skeleton.joint_names:
        plain = name.removeprefix("left_").removeprefix("right_")
        part_of.append("head" if plain in ("neck", "head") else _PAIRED.get(plain, "trunk"))
    joints = {part: [k for k, mine in enumerate(part_of) if mine == part] for part in PARTS}
    return {part: error_cm[:, chosen].mean() for part, chosen in joints.items()}


def mpjve_cm_s(
    joints: Float[Tensor, "time joint 3"], joints_true: Float[Tensor, "time joint 3"], fps: float
) -> Float[Tensor, ""]:
    """Mean per joint velocity error (cm/s): the mean over frames and joints of the length of the difference
    between captured and true velocity, both from successive frames. NaN for fewer than two frames."""
    return (joints - joints_true).diff(dim=0).norm(dim=-1).mean() * (fps * CM_PER_M)


def error_percentile_cm(error_cm: Float[Tensor, "time"], percent: float = 95.0) -> Float[Tensor, ""]:
    """Percentile over one sequence's frames of an error of each frame (cm), such as its mean joint error.

    Thesis §6.4.4 computes it within each sequence and averages over sequences, so that hard sequences alone do not
    determine the tail. Linear interpolation between frames.
    """
    return torch.quantile(error_cm, percent / 100.0)


def root_error_cm(
    t_world_root: Float[Tensor, "time 3"], t_world_root_true: Float[Tensor, "time 3"]
) -> Float[Tensor, ""]:
    """Mean distance (cm) between captured and true root."""
    return (t_world_root - t_world_root_true).norm(dim=-1).mean() * CM_PER_M


def rotation_error_deg(
    R: Float[Tensor, "*batch joint 3 3"], R_true: Float[Tensor, "*batch joint 3 3"]
) -> Float[Tensor, ""]:
    """Mean geodesic distance (degrees) between rotations over frames and joints (MPJRE of local rotations)."""
    return geodesic(R, R_true).mean().rad2deg()
