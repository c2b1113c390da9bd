"""Keypoints of another system beside a motion: planted distances come back, what cannot be compared is left out."""

from dataclasses import replace

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.metrics.scores import cue_errors_cm
from wearcap.recording import Cue
from wearcap_testing import swaying_motion


def cues_of(motion, names, shift) -> dict[str, Cue]:
    """Keypoints 5 cm off the joints, between the motion's frames."""
    times = (motion.timestamps[1:] + motion.timestamps[:-1]) / 2
    joints = motion.T_world_joint.t
    middle = (joints[1:] + joints[:-1]) / 2 + torch.tensor(shift)
    return {name: Cue(times, name, middle[:, motion.skeleton.index(name)], torch.ones(len(times))) for name in names}


def test_planted_distances_come_back_at_the_keypoints_times():
    motion = swaying_motion(60)
    cues = cues_of(motion, ("head", "left_wrist"), (0.03, 0.0, -0.04))
    errors = cue_errors_cm(motion, cues)
    assert set(errors) == {"head", "left_wrist"}
    assert all(error.shape == (59,) and (error - 5).abs().max() < 1e-3 for error in errors.values())


def test_what_cannot_be_compared_is_left_out():
    motion = swaying_motion(60)
    cues = cues_of(motion, ("head", "left_wrist", "right_wrist"), (0.05, 0.0, 0.0))
    head = cues["head"]
    sure = head.confidence.clone()
    sure[:10] = 0
    points = head.points.clone()
    points[:11] = float("nan")
    cues["head"] = replace(head, confidence=sure, points=points)
    cues["left_wrist"] = replace(cues["left_wrist"], timestamps=cues["left_wrist"].timestamps + 100)
    cues["right_wrist"] = replace(cues["right_wrist"], points=cues["right_wrist"].points[:, :2])
    cues["tail"] = head
    errors = cue_errors_cm(motion, cues)
    assert {name: len(error) for name, error in errors.items()} == {"head": 48}
    for useless in ({}, {"tail": head}, {"left_wrist": cues["left_wrist"]}):
        with pytest.raises(WearcapError, match="no keypoint to compare"):
            cue_errors_cm(motion, useless)
