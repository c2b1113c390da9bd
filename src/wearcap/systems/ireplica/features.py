"""Input features of the contact networks: the body's pose and the gravity direction, without position and heading."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, site_positions
from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeleton import FOOT_PATCHES, MIRROR, Skeleton, xsens23
from wearcap.body.skeletons import smpl24, smplh52
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.recording.timing import resampled


@dataclass(frozen=True)
class SmplAngles:
    """The thesis's input: axis-angle vectors of SMPL's 23 body joints (69), in SMPL's own axes (x left, y up, z
    forward).

    With `fingers`, SMPL+H's 21 body joints, six zeros in place of SMPL's two hand joints, and 30 finger joints (159).
    """

    fingers: bool = False

    @cached_property
    def skeleton(self) -> Skeleton:
        return smplh52() if self.fingers else smpl24()

    @property
    def size(self) -> int:
        return 159 if self.fingers else 69

    def encode(self, R_parent_joint: Float[Tensor, "*batch joint 3 3"]) -> Float[Tensor, "*batch feature"]:
        """Encode poses of `skeleton`."""
        angles = rotation.log(R_parent_joint[..., 1:, :, :]).roll(-1, -1).flatten(-2)
        if not self.fingers:
            return angles
        body, hands = angles.split([63, 90], -1)
        return torch.cat([body, torch.zeros_like(body[..., :6]), hands], -1)


_ROT6D = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
_SIDE_SIGNS = (*MIRROR * 4, *_ROT6D, 1.0)
_MIDDLE_SIGNS = (*MIRROR * 2, *_ROT6D, 1.0)
"""Signs of the features under mirroring: y changes sign, and the second column of a rotation once more."""


@dataclass(frozen=True)
class HandViews:
    """Pose from the view of each hand (ours); the right hand's view is mirrored, so that both share one network.

    Positions (m) are those of a standard body in this pose, in the pelvis' heading: hands and elbows relative to the
    chest, ankles relative to the pelvis, heights above the lower foot. Further features are the rotations of hands and
    chest, the directions of head and feet, and the pelvis' tilt.
    """

    @cached_property
    def skeleton(self) -> Skeleton:
        return xsens23()

    @cached_property
    def size(self) -> int:
        return self.encode(torch.eye(3).expand(len(self.skeleton), 3, 3)).shape[-1]

    def encode(self, R_parent_joint: Float[Tensor, "*batch joint 3 3"]) -> Float[Tensor, "*batch feature"]:
        """Encode poses of `skeleton`: the left hand's view (its side, other side, middle), then the right hand's."""
        body, root = self.skeleton, R_parent_joint[..., 0, :, :]
        R_root = rotation.about_axis("z", -rotation.yaw_of(root)) @ root
        R = torch.cat([R_root[..., None, :, :], R_parent_joint[..., 1:, :, :]], -3)
        T = forward_kinematics(body, R, torch.zeros_like(R[..., 0, 0, :]))
        soles = site_positions(body, T, FOOT_PATCHES)
        floor = soles[..., 2].amin(-1)[..., None, None]
        chest, head = body.index("t8"), body.index("head")
        elbows, wrists, ankles = (
            body.indices(f"left_{joint}", f"right_{joint}") for joint in ("elbow", "wrist", "ankle")
        )
        palms, origin = site_positions(body, T, ("left_palm", "right_palm")), T.t[..., [chest], :]
        sides = [  # "*batch side 19"
            palms - origin,
            T.t[..., elbows, :] - origin,
            T.t[..., ankles, :],
            T.R[..., ankles, :, 0],
            rotation.rot6d_from_matrix(T.R[..., wrists, :, :]),
            palms[..., 2:] - floor,
        ]
        parts = [
            T.R[..., head, :, 0],
            R_root[..., 2],
            rotation.rot6d_from_matrix(T.R[..., chest, :, :]),
            -floor[..., 0],
        ]
        own, other = torch.cat(sides, -1).unbind(-2)
        middle = torch.cat(parts, -1)
        mirror = lambda x, signs: x * x.new_tensor(signs)  # noqa: E731
        flipped = mirror(other, _SIDE_SIGNS), mirror(own, _SIDE_SIGNS), mirror(middle, _MIDDLE_SIGNS)
        return torch.cat([own, other, middle, *flipped], -1)


PoseFeatures = SmplAngles | HandViews
FEATURES = {cls.__name__: cls for cls in (SmplAngles, HandViews)}


def retarget_skeleton(source: Skeleton, target: Skeleton) -> Skeleton:
    """Skeleton into which `in_skeleton` retargets a source's poses: `target` in the wearer's size, or `target`
    itself if the joints are the same."""
    return target if source.joint_names == target.joint_names else fit_offsets(source, target)


def in_skeleton(
    source: Skeleton, target: Skeleton, R_parent_joint: Float[Tensor, "time joint 3 3"]
) -> Float[Tensor, "time joint_t 3 3"]:
    """Joint rotations of a source skeleton retargeted to a `retarget_skeleton`; unchanged if both have the same joints."""
    if source.joint_names == target.joint_names:
        return R_parent_joint
    return retarget(source, target, R_parent_joint, torch.zeros_like(R_parent_joint[:, 0, 0]))[0]


def pose_frames(
    motion: Motion, skeleton: Skeleton, fps: float
) -> tuple[Float64[Tensor, "time_f"], Float[Tensor, "time_f joint 3 3"]]:
    """Timestamps and joint rotations of a motion, resampled to `fps` and retargeted to `skeleton` where necessary.
    Raises WearcapError for frames that are not finite."""
    bad = ~motion.R_parent_joint.isfinite().flatten(1).all(1) | ~motion.timestamps.isfinite()
    if bad.any():
        what = f"{int(bad.sum())} of {len(bad)} poses are not numbers, first frame {int(bad.nonzero()[0])}"
        raise WearcapError(what, expected="a pose in every frame", fix="Fill the gaps, or cut them out.")
    if not is_even(motion.timestamps, fps):
        motion = resampled(motion, fps)
    R = in_skeleton(motion.skeleton, retarget_skeleton(motion.skeleton, skeleton), motion.R_parent_joint)
    return motion.timestamps, R


def is_even(timestamps: Float64[Tensor, "time"], fps: float) -> bool:
    """Whether every time step is within 1 % of 1/`fps`."""
    return len(timestamps) < 2 or bool((timestamps.diff() * fps - 1).abs().max() < 0.01)
