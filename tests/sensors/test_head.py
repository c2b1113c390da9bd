"""Head devices: exact without noise, with noise as far off as the settings say."""

import numpy as np
import pytest
import torch

from wearcap.geometry import rotation
from wearcap.sensors.simulated import SlamNoise, head_stream, heading_walk, smooth_noise
from wearcap_testing import swaying_motion

SEAT = torch.tensor([0.09, 0.0, 0.08])


def test_without_noise_the_device_is_where_the_head_carries_it():
    motion = swaying_motion(200)
    stream = head_stream(motion, SEAT)
    head = motion.joint("head")
    torch.testing.assert_close(stream.t_world_device, head.t + (head.R @ SEAT), atol=1e-5, rtol=0)
    torch.testing.assert_close(stream.T_world_head.t, head.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(stream.R_world_device, head.R)


def test_jitter_is_as_large_as_asked():
    motion = swaying_motion(20_000)
    exact = head_stream(motion, SEAT)
    stream = head_stream(motion, SEAT, SlamNoise(), np.random.default_rng(0))
    off = stream.t_world_device - exact.t_world_device
    assert off.std(0).mean() == pytest.approx(0.0015, rel=0.15)
    turned = rotation.log(exact.R_world_device.transpose(-1, -2) @ stream.R_world_device).rad2deg()
    assert turned.std(0).mean() == pytest.approx(0.12, rel=0.15)
    assert off.diff(dim=0).abs().mean() < 0.0005, "smooth from frame to frame"


def test_drift_grows_with_the_path_travelled():
    motion = swaying_motion(7200)
    path_length = motion.joint("head").t.diff(dim=0).norm(dim=-1).sum()
    noise = SlamNoise(jitter_m=0.0, jitter_deg=0.0, drift_share=0.02)
    exact = head_stream(motion, SEAT).t_world_device
    ends = torch.stack(
        [head_stream(motion, SEAT, noise, np.random.default_rng(s)).t_world_device[-1] - exact[-1] for s in range(60)]
    )
    assert ends.std(0).mean() == pytest.approx(0.02 * path_length.sqrt().item(), rel=0.2)


def test_drift_is_no_jitter():
    motion = swaying_motion(1200)
    exact = head_stream(motion, SEAT).t_world_device
    noise = SlamNoise(jitter_m=0.0, jitter_deg=0.0, drift_share=0.02, yaw_drift_deg_per_sqrt_min=1.0)
    off = head_stream(motion, SEAT, noise, np.random.default_rng(0)).t_world_device - exact
    assert off[-1].norm() > 0.005
    assert (off.diff(n=3, dim=0).norm(dim=-1) * 60**3).mean() < 1.0


def test_heading_drifts_about_the_start():
    motion = swaying_motion(3600)
    noise = SlamNoise(jitter_m=0.0, jitter_deg=0.0, yaw_drift_deg_per_sqrt_min=2.0)
    exact = head_stream(motion, SEAT)
    yaw = []
    for seed in range(60):
        stream = head_stream(motion, SEAT, noise, np.random.default_rng(seed))
        torch.testing.assert_close(stream.t_world_device[0], exact.t_world_device[0])
        torch.testing.assert_close(stream.t_world_device[:, 2], exact.t_world_device[:, 2])
        yaw.append(rotation.yaw_of(stream.R_world_device[-1] @ exact.R_world_device[-1].T).rad2deg())
    assert torch.stack(yaw).std() == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize("period_s", [0.0, 0.5, 4.0])
def test_smooth_noise_has_unit_deviation_and_the_asked_pace(period_s):
    noise = smooth_noise(np.random.default_rng(1), 40_000, 4, period_s, 60.0)
    assert noise.std() == pytest.approx(1.0, abs=0.06)
    if period_s:
        lag = round(period_s * 60)
        assert (noise[:-lag] * noise[lag:]).mean().abs() < 0.15
        assert (noise[:-1] * noise[1:]).mean() > 0.95


def test_a_heading_walk_starts_at_zero_and_spreads_with_the_root_of_time():
    walks = [heading_walk(np.random.default_rng(seed), 601, 2.0, 60.0) for seed in range(400)]
    yaw_deg = rotation.yaw_of(torch.stack(walks, 1)).rad2deg()
    assert (yaw_deg[0] == 0).all()
    assert yaw_deg[600].std() == pytest.approx(2.0 * (10 / 60) ** 0.5, rel=0.1)
    assert yaw_deg[150].std() == pytest.approx(2.0 * (2.5 / 60) ** 0.5, rel=0.1)
