"""The suit's errors reproduce the figures that its settings are named after."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearsim.sensors.suit import (
    SUITS,
    BodyErrors,
    ContactErrors,
    PathErrors,
    SegmentErrors,
    SuitNoise,
    estimated_skeleton,
    suit_motion,
)

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


def test_a_perfect_suit_reports_the_truth():
    motion = walk(30)
    suit = worn(motion, NONE)
    torch.testing.assert_close(suit.t_world_root, motion.t_world_root, atol=1e-5, rtol=0)
    torch.testing.assert_close(suit.R_parent_joint, motion.R_parent_joint)
    assert torch.equal(suit.contact_prob, steps(len(motion)).float())


@pytest.mark.parametrize("length_m", [70.0, 380.0])
def test_the_heading_drifts_and_walked_distance_does_not(length_m):
    motion = walk(length_m)
    noise = replace(NONE, path=PathErrors(heading_bias_deg_per_min=0.0, steel_deg=0.0))
    suits = [worn(motion, noise, seed) for seed in range(60)]
    minutes = float(motion.timestamps[-1]) / 60
    # The end's deviation to the side under a random walk of the heading: length · σ √(t / 3).
    sideways = length_m * np.deg2rad(noise.path.heading_walk_deg_per_sqrt_min) * np.sqrt(minutes / 3)
    off = torch.stack([(suit.t_world_root - motion.t_world_root)[-1, 1] for suit in suits])
    assert off.square().mean().sqrt() == pytest.approx(sideways, rel=0.25)
    walked = torch.stack([suit.t_world_root[:, :2].diff(dim=0).norm(dim=-1).sum() for suit in suits])
    assert ((walked / motion.t_world_root[-1, 0] - 1).square().mean().sqrt()) < 0.005


def test_steel_turns_the_heading_where_it_is_and_not_elsewhere():
    motion = walk(300.0)
    there_and_back = replace(motion, t_world_root=torch.cat([motion.t_world_root, motion.t_world_root.flip(0)])[::2])
    noise = replace(NONE, path=replace(NONE.path, steel_deg=4.0, steel_s=0.1))
    heading = rotation.log(worn(there_and_back, noise).R_parent_joint[:, 0])[:, 2].rad2deg()
    assert 2.0 < heading.std() < 6.0
    assert np.corrcoef(heading, heading.flip(0))[0, 1] > 0.9, "the same place disturbs alike on the way back"


def test_who_stands_does_not_drift():
    motion = walk(30)
    standing = replace(motion, t_world_root=motion.t_world_root[:1].expand(len(motion), 3).clone())
    suit = worn(standing, SuitNoise())
    torch.testing.assert_close(suit.t_world_root[:, :2], standing.t_world_root[:, :2])


def test_orientations_are_off_by_three_to_five_degrees_and_slowly():
    motion = walk(300)
    suit = worn(motion, replace(SuitNoise(), path=NONE.path))
    off = rotation.geodesic(motion.T_world_joint.R, suit.T_world_joint.R).rad2deg()
    assert 3.0 < off.square().mean().sqrt() < 5.0
    assert off.mean(0).min() > 0.5, "every segment"
    assert off.diff(dim=0).abs().mean() * FPS < 4.0, "degrees per second"


def test_the_suits_body_is_not_the_wearers():
    true = xsens23()
    found = [estimated_skeleton(true, BodyErrors(), np.random.default_rng(seed)) for seed in range(30)]
    share = torch.stack([skeleton.t_parent_joint.norm(dim=-1) / true.t_parent_joint.norm(dim=-1) for skeleton in found])
    share = share[:, true.t_parent_joint.norm(dim=-1) > 0.05]
    assert 0.02 < share.std() < 0.04
    stature = torch.tensor([skeleton.stature - true.stature for skeleton in found])
    assert 0.005 < stature.std() < 0.02
    left, right = found[0].indices("left_knee", "right_knee")
    torch.testing.assert_close(found[0].t_parent_joint[left].norm(), found[0].t_parent_joint[right].norm())


def test_the_feet_stay_at_the_wearers_height_on_another_body():
    skeleton = xsens23()
    time = torch.arange(600, dtype=torch.float64) / 60.0
    root = torch.zeros(600, 3)
    root[:, 2] = skeleton.root_height
    motion = Motion(time, skeleton, torch.eye(3).repeat(600, len(skeleton), 1, 1), root)
    noise = replace(SuitNoise(), path=replace(PathErrors(), height_m=0.0, height_drift_m=0.0))
    suit = suit_motion(motion, torch.ones(600, 4, dtype=torch.bool), noise, np.random.default_rng(0))
    low = [site_positions(m.skeleton, m.T_world_joint, FOOT_PATCHES)[..., 2].amin(-1) for m in (motion, suit)]
    torch.testing.assert_close(*low, atol=1e-4, rtol=0)
    high = suit_motion(motion, torch.ones(600, 4, dtype=torch.bool), SuitNoise(), np.random.default_rng(0))
    assert (high.t_world_root - suit.t_world_root)[:, 2].abs().mean() > 0.002


def test_presets_by_name():
    drift = [
        np.mean(
            [float((worn(walk(70), SUITS[name], s).t_world_root - walk(70).t_world_root)[-1].norm()) for s in range(8)]
        )
        for name in ("ideal", "typical", "poor")
    ]
    assert drift == sorted(drift)
    assert SuitNoise.preset("typical") == SuitNoise()
    with pytest.raises(WearcapError, match="ideal, typical, poor"):
        SuitNoise.preset("perfect")


def test_contacts_come_late_and_some_are_wrong():
    truth = steps(6000)
    time = torch.arange(6000, dtype=torch.float64) / 240.0
    motion = Motion(time, STICK, torch.eye(3).repeat(6000, 2, 1, 1), torch.zeros(6000, 3))
    late, wrong = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        flags = suit_motion(motion, truth, SuitNoise(contacts=ContactErrors(wrong=(0.0, 0.0))), rng).contact_prob > 0.5
        late.append((flags != truth).float().sum() / (truth[1:] != truth[:-1]).sum() / 240.0)
        still = SuitNoise(contacts=ContactErrors(delay_s=(0.0, 0.0)))
        flags = suit_motion(motion, truth, still, np.random.default_rng(seed)).contact_prob > 0.5
        wrong.append((flags != truth).float().mean())
    assert min(late) > 0.008
    assert max(late) < 0.042
    assert min(wrong) > 0.012
    assert max(wrong) < 0.06
    assert sum(wrong) / len(wrong) == pytest.approx(0.035, abs=0.008)
