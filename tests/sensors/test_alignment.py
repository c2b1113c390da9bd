"""Planted rotations about gravity and planted mounts come back, outliers or not."""

import math

import pytest
import torch
from localized_walk import LEVEL, MOUNT, PERFECT, LocalizationNoise, localized, strolling_motion, turned

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Localization
from wearcap.sensors.initialization import _robust_angle, align_suit, estimate_head_camera, yaw_between

NOISY = LocalizationNoise(outages_s=((0.0, 1.5),))


def test_the_yaw_is_the_nearest_of_all():
    random = torch.Generator().manual_seed(0)
    R_a, R_b = rotation.exp(2 * torch.randn(2, 50, 3, generator=random, dtype=torch.float64))
    angle, certainty = yaw_between(R_a, R_b)
    every = torch.linspace(-math.pi, math.pi, 7201, dtype=torch.float64)
    distance = rotation.geodesic(rotation.about_axis("z", every)[:, None] @ R_a, R_b.expand(7201, -1, -1, -1))
    best = every[distance.argmin(0)]
    sure = certainty > 0.05
    assert rotation.wrap_angle(angle - best)[sure].abs().max() < math.radians(0.1)
    plain = rotation.about_axis("z", torch.tensor(0.7, dtype=torch.float64)) @ R_a
    torch.testing.assert_close(yaw_between(R_a, plain)[0], torch.full((50,), 0.7, dtype=torch.float64))


@pytest.mark.parametrize("angle_deg", [0.0, 75.0, 179.9, -120.0])
@pytest.mark.parametrize("noise", [PERFECT, NOISY])
def test_a_planted_rotation_is_recovered(angle_deg, noise):
    """Within 0.1° exactly; noise of 1.5° over some 250 frames leaves less than 0.2°."""
    motion = strolling_motion(40.0)
    suit = turned(motion, -math.radians(angle_deg), (3.0, -7.0, 0.4))
    aligned, angle = align_suit(suit, localized(motion, noise), MOUNT)
    off = rotation.wrap_angle(angle - math.radians(angle_deg)).abs().rad2deg()
    assert off < (0.01 if noise is PERFECT else 0.2)
    limit = 1e-3 if noise is PERFECT else 0.05
    assert (aligned.t_world_root - motion.t_world_root)[:600].norm(dim=-1).max() < limit
    torch.testing.assert_close(
        aligned.R_parent_joint[:, 0], rotation.about_axis("z", angle) @ suit.R_parent_joint[:, 0]
    )


def test_half_of_the_noise_does_not_bias():
    """Ten people: the mean error is far below the single one."""
    off = []
    for seed in range(10):
        motion = strolling_motion(20.0, seed)
        found = localized(motion, LocalizationNoise(), seed)
        off.append(align_suit(turned(motion, -1.0), found, MOUNT)[1] - 1.0)
    off = torch.stack(off).rad2deg()
    assert off.abs().max() < 0.25
    assert off.mean().abs() < 0.1


def test_a_wrong_first_frame_does_not_matter():
    motion = strolling_motion(20.0)
    found = localized(motion, PERFECT)
    found.R_world_cam[0] = rotation.exp(torch.tensor([0.5, 1.0, 2.0])) @ found.R_world_cam[0]
    found.t_world_cam[0] += 30.0
    aligned, angle = align_suit(turned(motion, -1.0), found, MOUNT)
    assert (angle - 1.0).abs().rad2deg() < 0.01
    assert (aligned.t_world_root - motion.t_world_root).norm(dim=-1).max() < 1e-3


def test_angles_round_the_circle():
    angle = torch.cat([torch.tensor([3.13, -3.13, 3.14, -3.135]), torch.full((3,), 1.0)])
    assert rotation.wrap_angle(_robust_angle(angle, torch.ones(7)) - math.pi).abs() < 0.02
    heavy = torch.tensor([0.01] * 4 + [1.0] * 3)
    assert _robust_angle(angle, heavy) == pytest.approx(1.0, abs=0.01)


def test_the_mount_is_recovered_despite_outliers():
    motion = strolling_motion(30.0)
    worn = Rigid(MOUNT.R @ rotation.exp(torch.tensor([0.05, -0.04, 0.08])), MOUNT.t)
    found = localized(motion, LocalizationNoise(outlier_share=0.3), mount=worn)
    R_world_head = motion.joint("head").R[::2][: len(found.timestamps)]
    R_head_cam = estimate_head_camera(R_world_head, found.R_world_cam, found.confidence)
    assert rotation.geodesic(R_head_cam, worn.R).rad2deg() < 0.2
    assert rotation.geodesic(R_head_cam, LEVEL).rad2deg() > 10
    single = estimate_head_camera(R_world_head[:1], R_world_head[:1] @ worn.R, torch.ones(1))
    torch.testing.assert_close(single, worn.R, atol=1e-5, rtol=0)


def test_nothing_localised_is_refused():
    motion = strolling_motion(5.0)
    found = localized(motion, LocalizationNoise(outages_s=((0.0, 99.0),)))
    with pytest.raises(WearcapError, match="none of 149 frames is localised"):
        align_suit(motion, found, MOUNT)
    late = localized(motion, PERFECT)
    late = Localization(late.timestamps + 100, late.R_world_cam, late.t_world_cam, late.confidence)
    with pytest.raises(WearcapError, match="Synchronise"):
        align_suit(motion, late, MOUNT)
    with pytest.raises(WearcapError, match="no localised frame"):
        estimate_head_camera(motion.joint("head").R[:149], found.R_world_cam, found.confidence)
