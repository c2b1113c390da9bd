"""Distributions of captures beside their truth, in the latent space of a network with random weights.

A random projection, too, tells motions apart: what is tested here is the gathering, not the training.
"""

import math
from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.data.motion_features import MotionFeatures
from wearcap.errors import WearcapError
from wearcap.evaluation import evaluate as evaluation
from wearcap.evaluation.evaluate import Realism
from wearcap.geometry import rotation
from wearcap.metrics.distribution import diversity, frechet_distance
from wearcap.metrics.scores import score
from wearcap.metrics.table import Row
from wearcap.models.motion_autoencoder import MotionAutoencoder
from wearcap.recording import Motion, Recording
from wearcap.runtime.system import CaptureInput
from wearcap_testing import recording_of, swaying_motion

FEATURES = MotionFeatures(xsens23())


@pytest.fixture
def gathering(monkeypatch) -> Realism:
    """Windows of 1.2 s, a fifth of a second apart, of which 600 are enough."""
    monkeypatch.setattr(evaluation, "MIN_WINDOWS", 600)
    torch.manual_seed(0)
    net = MotionAutoencoder(FEATURES.size, 24, (32, 32), latent=16)
    net.normalizer.set(torch.zeros(143), torch.cat([torch.ones(4), torch.full((66,), 0.5), torch.ones(73)]))
    return Realism(net, FEATURES, stride_s=0.2)


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [recording_of(swaying_motion(3720, seed), f"r{seed}") for seed in (0, 1)]


def gathered(gathering: Realism, recordings: list[Recording], spoil, method: str) -> float:
    for recording in recordings:
        gathering.add(spoil(recording.motion), recording, recording.name, 0, method)
    assert gathering.windows(method) == 610
    return gathering.scores(method)["fid"].mean


def frozen(joints: list[int]):
    """These joints stop; the head, from which the body hangs, goes on."""

    def spoil(motion: Motion) -> Motion:
        R = motion.R_parent_joint.clone()
        R[:, joints] = R[100, joints]
        return replace(motion, R_parent_joint=R)

    return spoil


def shuffled(motion: Motion) -> Motion:
    """Poses of one second in another order."""
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    frames = (torch.arange(0, len(motion), 60)[:, None] + order).flatten()
    R = torch.cat([motion.R_parent_joint[:, :1], motion.R_parent_joint[frames, 1:]], 1)
    return replace(motion, R_parent_joint=R)


def shaken(size: float):
    def spoil(motion: Motion) -> Motion:
        noise = torch.randn(len(motion), 23, 3, generator=torch.Generator().manual_seed(1))
        return replace(motion, R_parent_joint=motion.R_parent_joint @ rotation.exp(size * noise))

    return spoil


def test_the_truth_is_at_no_distance_and_as_diverse_as_itself(gathering, recordings):
    assert gathered(gathering, recordings, lambda motion: motion, "truth") == pytest.approx(0, abs=1e-6)
    scores = gathering.scores("truth")
    assert scores["diversity"].mean == pytest.approx(scores["truth_diversity"].mean, rel=1e-5)
    assert scores["truth_diversity"].mean > 0.1
    assert gathering.notice("truth") is None


def test_distance_grows_with_what_is_wrong(gathering, recordings):
    shakes = [gathered(gathering, recordings, shaken(size), f"{size}") for size in (0.02, 0.1, 0.3)]
    assert 0 < shakes[0] < shakes[1] < shakes[2]
    legs = xsens23().indices(*(f"{side}_{name}" for side in ("left", "right") for name in ("hip", "knee")))
    still = gathered(gathering, recordings, frozen(legs), "frozen legs")
    assert 1e-4 < still < gathered(gathering, recordings, frozen(list(range(1, 23))), "frozen")
    assert gathered(gathering, recordings, shuffled, "shuffled") > shakes[0]


def test_feet_that_slide_under_a_true_pose_are_seen(gathering, recordings):
    """In the features themselves: a capture's place comes from its head."""
    found = []
    for speed in (0.05, 0.3, 1.0):
        sets = []
        for recording in recordings:
            whole = FEATURES.movement(recording.motion)
            drift = torch.tensor([speed, 0.0, 0.0]) * torch.arange(len(whole.joints))[:, None, None] / 20
            sets.append([gathering._encode(m) for m in (whole._replace(joints=whole.joints + drift), whole)])
        sliding, true = (torch.cat(part) for part in zip(*sets))
        found.append(frechet_distance(sliding, true).item())
    assert 0 < found[0] < found[1] < found[2]


def test_seeds_and_methods_are_kept_apart(gathering, recordings):
    def scored(motion: Motion, source: CaptureInput, seed: int) -> Row:
        return score(motion, source.recording, source.recording.name, seed)

    measure = gathering.beside(scored, "ours")
    for seed in (0, 1):
        for recording in recordings:
            row = measure(shaken(0.05 * (1 + seed))(recording.motion), CaptureInput(recording), seed)
            assert isinstance(row, Row)
            assert "mpjpe_cm" in row.scores
    other = gathered(gathering, recordings, shaken(0.05), "other")
    scores = gathering.scores("ours")
    assert scores["fid"].seeds == 2
    assert scores["fid"].std > 0
    assert scores["truth_diversity"].std == 0
    assert gathering.scores("other")["fid"].std is None
    first, true = gathering._sets("ours", 0)
    assert frechet_distance(first, true).item() == pytest.approx(other, rel=1e-6)
    assert diversity(true).item() == pytest.approx(scores["truth_diversity"].mean)


def test_too_few_windows_say_so(gathering, recordings):
    gathering.add(recordings[0].motion, recordings[0], "r0", 0, "short")
    scores = gathering.scores("short")
    assert {"fid", "diversity", "truth_diversity"} == set(scores)
    assert all(math.isnan(summary.mean) for summary in scores.values())
    assert gathering.notice("short") == "short: 305 windows are too few for FID and Diversity (at least 600)"


def test_a_recording_shorter_than_a_window_adds_nothing(gathering):
    short = recording_of(swaying_motion(50), "short")
    gathering.add(short.motion, short, "short", 0, "m")
    assert gathering.windows("m") == 0


def test_without_truth_there_is_nothing_to_compare(gathering, recordings):
    with pytest.raises(WearcapError, match="no true motion"):
        gathering.add(recordings[0].motion, replace(recordings[0], motion=None), "r0", 0, "m")
