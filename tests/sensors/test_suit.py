"""The suit's errors reproduce the figures that its settings are named after."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.skeleton import Skeleton
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.sensors.suit import SuitNoise, suit_motion

NONE = SuitNoise(
    SegmentErrors(0.0, 0.0, 6.0, 0.0),
    PathErrors(0.0, 0.0, 0.0, scale=0.0, step_scale=0.0, height_m=0.0, height_drift_m=0.0),
    BodyErrors(0.0, 0.0),
    ContactErrors((0.0, 0.0), (0.0, 0.0)),
)
FPS = 10.0
STICK = Skeleton("stick", ("pelvis", "head"), (-1, 0), torch.tensor([[0.0, 0.0, 0.9], [0.0, 0.0, 0.6]]))


def walk(length_m: float) -> Motion:
    """Straight on at 1.3 m/s upright."""
    time = torch.arange(round(length_m / 1.3 * FPS), dtype=torch.float64) / FPS
    root = torch.stack([1.3 * time, 0 * time, 0 * time + 0.9], -1).float()
    return Motion(time, STICK, torch.eye(3).repeat(len(time), 2, 1, 1), root)


def steps(frames: int) -> torch.Tensor:
    """Alternating contacts of a second each."""
    left = (torch.arange(frames) // int(FPS)) % 2 == 0
    return torch.stack([left, left, ~left, ~left], 1)


def worn(motion: Motion, noise: SuitNoise, seed: int = 0) -> Motion:
    return suit_motion(motion, steps(len(motion)), noise, np.random.default_rng(seed))


def test_a_perfect_suit_tells_the_truth():
    motion = walk(30)
    suit = worn(motion, NONE)
    torch.testing.assert_close(suit.t_world_root, motion.t_world_root, atol=1e-5, rtol=0)
    torch.testing.assert_close(suit.R_parent_joint, motion.R_parent_joint)
    assert torch.equal(suit.contact_prob, steps(len(motion)).float())


@pytest.mark.parametrize(("length_m", "expected_m"), [(70.0, 0.5), (380.0, 1.1)])
def test_drift_after_a_walk(length_m, expected_m):
    motion = walk(length_m)
    poses = replace(SuitNoise(), fixed_deg=0.0, slow_deg=0.0)
    off = [(worn(motion, poses, seed).t_world_root - motion.t_world_root)[-1, :2].norm() for seed in range(60)]
    assert torch.stack(off).square().mean().sqrt() == pytest.approx(expected_m, rel=0.25)


def test_who_stands_does_not_drift():
    motion = walk(30)
    standing = replace(motion, t_world_root=motion.t_world_root[:1].expand(len(motion), 3).clone())
    suit = worn(standing, SuitNoise())
    torch.testing.assert_close(suit.t_world_root[:, :2], standing.t_world_root[:, :2])


def test_orientations_are_off_by_one_to_three_degrees_and_slowly():
    motion = walk(300)
    suit = worn(motion, SuitNoise())
    off = rotation.geodesic(motion.T_world_joint.R, suit.T_world_joint.R).rad2deg()
    assert 1.0 < off.square().mean().sqrt() < 3.0
    assert off.mean(0).min() > 0.3, "every segment"
    assert off.diff(dim=0).abs().mean() * FPS < 3.0, "degrees per second"


def test_contacts_come_late_and_some_are_wrong():
    truth = steps(6000)
    time = torch.arange(6000, dtype=torch.float64) / 240.0
    motion = Motion(time, STICK, torch.eye(3).repeat(6000, 2, 1, 1), torch.zeros(6000, 3))
    late, wrong = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        flags = suit_motion(motion, truth, replace(SuitNoise(), contact_wrong=(0.0, 0.0)), rng).contact_prob > 0.5
        late.append((flags != truth).float().sum() / (truth[1:] != truth[:-1]).sum() / 240.0)
        still = replace(SuitNoise(), contact_delay_s=(0.0, 0.0))
        flags = suit_motion(motion, truth, still, np.random.default_rng(seed)).contact_prob > 0.5
        wrong.append((flags != truth).float().mean())
    assert min(late) > 0.008
    assert max(late) < 0.042
    assert min(wrong) > 0.012
    assert max(wrong) < 0.06
    assert sum(wrong) / len(wrong) == pytest.approx(0.035, abs=0.008)
