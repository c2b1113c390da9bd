"""Contact prediction: any rate and skeleton, whole and frame by frame."""

import math
from dataclasses import replace

import pytest
import torch

from contact_motion import bending
from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeleton import xsens23
from wearcap.body.skeletons import smpl24
from wearcap.errors import WearcapError
from wearcap.recording import Motion
from wearcap.recording.timing import resampled
from wearcap.systems.ireplica.contact_prediction import ContactDetector, ContactPredictor
from wearcap.systems.ireplica.contact_sequence import ContactSequence
from wearcap.systems.ireplica.contact_transformer import ContactTransformer
from wearcap.systems.ireplica.features import HandViews, SmplAngles


@pytest.fixture(scope="module")
def ours() -> ContactPredictor:
    torch.manual_seed(0)
    features = HandViews()
    net = ContactSequence(features.size)
    net.normalize_on(features.encode(bending(600)[0].R_parent_joint)[None])
    net.temperature.copy_(torch.tensor([1.5, 0.8]))
    return ContactPredictor(ContactDetector(net, features, ("sliding", "hinged")))


@pytest.fixture(scope="module")
def published() -> ContactPredictor:
    torch.manual_seed(1)
    features = SmplAngles()
    nets = [ContactTransformer(features.size) for _ in range(2)]
    return ContactPredictor(
        *(ContactDetector(net, features, (name,)) for net, name in zip(nets, ("sliding", "hinged")))
    )


def test_every_frame_gets_a_probability(ours, published):
    motion = bending(250)[0]
    for predictor in (ours, published):
        prob = predictor(motion)
        assert set(prob) == {"sliding", "hinged"} == set(predictor.classes)
        for value in prob.values():
            assert value.shape == (250, 2)
            assert ((value > 0) & (value < 1)).all()
            assert value.std() > 0


def test_long_motions_in_passes_are_those_in_one(ours, published, monkeypatch):
    motion = bending(150)[0]
    for predictor in (ours, published):
        whole = predictor(motion)
        for detector in predictor.detectors:
            monkeypatch.setattr(type(detector.net), "frames_per_pass", 37)
        for name, value in predictor(motion).items():
            torch.testing.assert_close(value, whole[name], atol=1e-6, rtol=0)


def test_frame_by_frame_is_the_whole_thirty_frames_later(ours, published):
    for predictor, frames, skeleton in ((ours, 130, xsens23()), (published, 70, smpl24()), (ours, 12, xsens23())):
        motion = bending(frames, skeleton=skeleton)[0]
        whole, stream = predictor(motion), predictor.stream(motion.skeleton)
        answers = [stream.push(R) for R in motion.R_parent_joint]
        assert all(answer is None for answer in answers[:30])
        answers = [answer for answer in answers if answer is not None]
        assert len(answers) == max(0, frames - 30)
        answers += stream.finish()
        for name, value in whole.items():
            streamed = torch.stack([answer[name] for answer in answers])
            torch.testing.assert_close(streamed, value, atol=1e-5, rtol=0)


@pytest.mark.parametrize("fps", [30.0, 50.0, 120.0])
def test_rates_make_little_difference(ours, fps):
    motion = resampled(bending(700)[0], 120.0) if fps == 120 else bending(700)[0]
    other = resampled(motion, fps)
    prob, reference = ours(other)["sliding"], ours(bending(700)[0])["sliding"]
    assert len(prob) == len(other)
    at = (other.timestamps * 60).round().long().clamp(max=699)
    assert (prob - reference[at]).abs().mean() < 0.02


def test_other_skeletons_are_understood(ours):
    motion = bending(120)[0]
    smpl = fit_offsets(motion.skeleton, smpl24())
    R, t = retarget(motion.skeleton, smpl, motion.R_parent_joint, motion.t_world_root)
    prob = ours(Motion(motion.timestamps, smpl, R, t))
    assert (prob["hinged"] - ours(motion)["hinged"]).abs().mean() < 0.05


def test_short_and_empty_motions(ours):
    assert ours(bending(5)[0])["sliding"].shape == (5, 2)
    assert ours(bending(1)[0])["sliding"].shape == (1, 2)
    assert ours(bending(60)[0].sliced(0, 0))["sliding"].shape == (0, 2)
    assert ours.stream(bending(1)[0].skeleton).finish() == []


def test_what_is_not_a_number_is_named(ours):
    motion = bending(60)[0]
    broken = motion.R_parent_joint.clone()
    broken[7] = math.nan
    with pytest.raises(WearcapError, match="first frame 7"):
        ours(replace(motion, R_parent_joint=broken))
    stream = ours.stream(motion.skeleton)
    for R in broken[:7]:
        stream.push(R)
    with pytest.raises(WearcapError, match="the pose of frame 7 is not a number"):
        stream.push(broken[7])


def test_two_networks_for_one_class_are_refused(ours):
    with pytest.raises(WearcapError, match="one network for each class"):
        ContactPredictor(*ours.detectors, *ours.detectors)
