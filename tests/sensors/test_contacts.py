"""Derived foot contacts against the simulated wearer's truth, and on planted motions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.sensors.contacts import contacts_from_motion
from wearsim.people.wearer import simulate_motion
from wearsim.recordings.simulate import person_of, world_of
from wearsim.sensors.suit import SuitNoise, suit_motion


@pytest.fixture(scope="module")
def walked():
    rng = np.random.default_rng(0)
    return simulate_motion(world_of("val", 0), person_of("val", 0), rng, 40.0, 60.0, ["walk", "stand", "walk"])


def precision_recall(found, truth):
    hit = (found & truth).sum().item()
    return hit / found.sum().item(), hit / truth.sum().item()


def test_contacts_of_a_worn_suits_pose(walked):
    suit = suit_motion(walked.motion, walked.contact, SuitNoise(), np.random.default_rng(1))
    precision, recall = precision_recall(contacts_from_motion(suit), walked.contact)
    assert precision > 0.86
    assert recall > 0.97


def sliding(speed):
    """A T-pose that slides along with these speeds (m/s), one per frame, at 100 Hz."""
    skeleton = xsens23()
    displacement = torch.tensor(speed).cumsum(0) / 100
    R = torch.eye(3).repeat(len(displacement), len(skeleton), 1, 1)
    root = torch.stack([displacement, 0 * displacement, 0 * displacement + skeleton.root_height], -1)
    return Motion(torch.arange(len(displacement), dtype=torch.float64) / 100, skeleton, R, root)


def test_hysteresis_ignores_hesitation_and_short_moments():
    speed = [1.0] * 50 + [0.05] * 30 + [0.13] * 30 + [0.05] * 20 + [0.13] * 20 + [1.0] * 20 + [0.13] * 20
    speed += [0.02] * 3 + [1.0] * 20 + [0.0] * 30 + [1.0] * 3 + [0.0] * 30
    found = contacts_from_motion(sliding(speed))[:, 0].float()
    change = found.diff().nonzero()[:, 0] + 1
    assert found[0] == 0
    assert (change - torch.tensor([50, 150, 213])).abs().max() <= 1
    assert found[-1] == 1


def test_a_foot_held_high_does_not_stand():
    motion = sliding([0.0] * 50)
    R = motion.R_parent_joint.clone()
    R[:, motion.skeleton.index("left_hip")] = rotation.about_axis("y", torch.tensor(-1.5))
    found = contacts_from_motion(replace(motion, R_parent_joint=R))
    assert found.all(0).tolist() == [False, False, True, True]
    assert not found[:, :2].any()


def test_what_lacks_is_named():
    motion = sliding([0.0] * 20)
    bare = replace(motion, skeleton=replace(motion.skeleton, sites={}))
    with pytest.raises(WearcapError, match="has no 'left_heel'"):
        contacts_from_motion(bare)
