"""Scores of one capture against its recording's ground truth."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate, nearest_frames
from wearcap.metrics.position import joint_error_cm, mpjpe_cm, root_error_cm
from wearcap.metrics.table import Row, evaluate_motion
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Cue
from wearcap.recording.timing import at_times
from wearcap.tracking.anchor import anchored_to_head


def score(motion: Motion, recording: Recording, name: str, seed: int) -> Row:
    """All metrics of one capture at its own frames against its recording's ground truth.

    The capture is anchored to the true head, except for `world_root_cm` and `world_mpjpe_cm`, which are measured in the
    world without alignment.
    """
    anchored, truth, contact = comparable(motion, recording, name)
    scores = evaluate_motion(anchored, truth, contact)
    joints, joints_true = motion.T_world_joint.t, truth.T_world_joint.t
    scores["world_root_cm"] = root_error_cm(joints[:, 0], joints_true[:, 0]).item()
    scores["world_mpjpe_cm"] = mpjpe_cm(joints, joints_true).item()
    return Row(name, seed, len(truth), scores)


def score_in_world(motion: Motion, recording: Recording, name: str, seed: int) -> Row:
    """All metrics of one capture in the world, without anchoring or alignment (MocapEvery §4.1); adds `r_mpjpe_cm`
    (root-relative, r.MPJPE) and `right_hand_pe_cm`."""
    truth, contact = truth_at(motion, recording, name)
    scores = evaluate_motion(motion, truth, contact)
    joints, joints_true = motion.T_world_joint.t, truth.T_world_joint.t
    scores["r_mpjpe_cm"] = mpjpe_cm(joints - joints[:, :1], joints_true - joints_true[:, :1]).item()
    hand = truth.skeleton.index("right_wrist")
    scores["right_hand_pe_cm"] = mpjpe_cm(joints[:, [hand]], joints_true[:, [hand]]).item()
    return Row(name, seed, len(truth), scores)


def comparable(
    motion: Motion, recording: Recording, name: str
) -> tuple[Motion, Motion, Bool[Tensor, "time patch"] | None]:
    """The capture anchored to the true head; true motion and foot contact at its frames. Raises as `truth_at`."""
    truth, contact = truth_at(motion, recording, name)
    return anchored_to_head(motion, truth.joint("head")), truth, contact


def truth_at(motion: Motion, recording: Recording, name: str) -> tuple[Motion, Bool[Tensor, "time patch"] | None]:
    """The true motion at the capture's frames, and true foot contact. Raises WearcapError without a true motion."""
    truth, contact = recording.motion, None if recording.contacts is None else recording.contacts.feet
    if truth is None:
        raise WearcapError("no true motion to compare with", where=name, expected="a recording with `motion`")
    same = len(motion) == len(truth) and torch.allclose(motion.timestamps, truth.timestamps, rtol=0, atol=1e-6)
    ends = truth.timestamps[[0, -1]] if len(truth) > 1 and len(motion) > 1 and not same else None
    if ends is not None and motion.timestamps[0] >= ends[0] - 1e-6 and motion.timestamps[-1] <= ends[1] + 1e-6:
        frame = nearest_frames(truth.timestamps, motion.timestamps)
        truth, contact = at_times(truth, motion.timestamps), None if contact is None else contact[frame]
    return truth, contact


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
        expected = "3D cues named like its joints, on its clock"
        raise WearcapError("no keypoint to compare this motion with", expected=expected)
    return errors
