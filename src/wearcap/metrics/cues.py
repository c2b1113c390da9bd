"""Comparison of a captured motion with keypoints tracked by another system (Aria Digital Twin's body joints)."""

from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate
from wearcap.metrics.position import joint_error_cm
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Cue


def cue_errors_cm(motion: Motion, cues: Mapping[str, Cue]) -> dict[str, Float[Tensor, "_"]]:
    """Distance (cm) of the motion's joints from 3D keypoints of the same name, at the keypoints' times.

    Both must share clock and world. Keypoints of confidence 0, outside the motion's time span, or of joints that the
    skeleton lacks are ignored. Raises WearcapError if none is left.
    """
    errors = {}
    joints = motion.T_world_joint.t
    for name, cue in cues.items():
        if name not in motion.skeleton or cue.points.shape[-1] != 3:
            continue
        usable = (cue.timestamps >= motion.timestamps[0]) & (cue.timestamps <= motion.timestamps[-1])
        usable &= (cue.confidence > 0) & cue.points.isfinite().all(-1)
        if usable.any():
            at = interpolate(motion.timestamps, joints[:, motion.skeleton.index(name)], cue.timestamps[usable])
            errors[name] = joint_error_cm(at, cue.points[usable])
    if not errors:
        raise WearcapError(
            "no keypoint to compare this motion with", expected="3D cues named like its joints, on its clock"
        )
    return errors
