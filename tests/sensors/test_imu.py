"""Inertial sensors: equal to the analytic answer on known motions; noise as the settings say."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.sensors.imu import GRAVITY, ImuNoise, acceleration, angular_rate, mean_filter, synthesize_imu
from wearcap_testing import swaying_motion

FPS = 60.0
NONE = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def carousel(frames: int = 601, rate: float = 0.8, radius: float = 1.5) -> Motion:
    """A T-pose whose pelvis goes round a circle, turning with it."""
    skeleton = xsens23()
    time = torch.arange(frames, dtype=torch.float64) / FPS
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    R[:, 0] = rotation.about_axis("z", (rate * time).float())
    angle = rate * time
    root = torch.stack([radius * angle.cos(), radius * angle.sin(), 0 * angle + 1.0], -1).float()
    return Motion(time, skeleton, R, root)


def test_going_round_measures_the_centripetal_acceleration_and_the_rate():
    rate, radius = 0.8, 1.5
    stream = synthesize_imu(carousel(rate=rate, radius=radius), "pelvis")
    inner = slice(10, -10)
    expected = torch.tensor([-(rate**2) * radius, 0.0, GRAVITY]).expand(581, 3)
    # (2 / h²)(1 − cos ωh) against ω²: below 0.03 % at h = 4 / 60 s; single precision costs the rest.
    torch.testing.assert_close(stream.acc_imu[inner], expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(stream.gyro_imu, torch.tensor([0.0, 0.0, rate]).expand(601, 3), atol=2e-4, rtol=0)
    torch.testing.assert_close(
        (stream.R_world_imu @ stream.acc_imu[..., None])[..., 0],
        stream.acc_world + torch.tensor([0.0, 0.0, GRAVITY]),
        atol=1e-5,
        rtol=0,
    )


def test_a_mounting_turns_what_is_measured():
    motion = swaying_motion(120)
    mounted = rotation.about_axis("x", torch.tensor(math.pi / 2))
    plain, turned = (synthesize_imu(motion, "left_wrist", R_joint_imu=R) for R in (None, mounted))
    torch.testing.assert_close(turned.acc_imu, plain.acc_imu @ mounted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(turned.gyro_imu, plain.gyro_imu @ mounted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(turned.acc_world, plain.acc_world)


def test_acceleration_of_a_parabola_is_exact_also_at_the_ends():
    time = torch.arange(30, dtype=torch.float64)[:, None] / FPS
    fall = torch.tensor([[1.0, -2.0, -9.81]], dtype=torch.float64)
    torch.testing.assert_close(acceleration(0.5 * fall * time**2, FPS), fall.expand(30, 3), atol=1e-9, rtol=0)
    assert (acceleration(time[:8].expand(-1, 3), FPS) == 0).all(), "nine frames at least"


def test_mean_filter_keeps_constants_and_divides_white_noise():
    assert (mean_filter(torch.full((20, 2), 3.0)) == 3.0).all()
    noise = torch.randn(50_000, 1, generator=torch.Generator().manual_seed(0))
    assert mean_filter(noise).std() == pytest.approx(7**-0.5, rel=0.03)


def test_one_frame_has_no_rate():
    assert (angular_rate(torch.eye(3)[None], FPS) == 0).all()


def still(frames: int) -> Motion:
    return carousel(frames, rate=0.0)


def test_zero_noise_changes_nothing():
    motion = swaying_motion(200)
    exact, same = (synthesize_imu(motion, "head", noise=n, rng=np.random.default_rng(0)) for n in (None, NONE))
    for name in ("R_world_imu", "acc_world", "acc_imu", "gyro_imu"):
        torch.testing.assert_close(getattr(same, name), getattr(exact, name), atol=1e-4, rtol=1e-4)


def test_white_noise_and_bias_are_as_large_as_asked():
    noise = replace(NONE, acc_noise=0.04, acc_bias=0.02, gyro_noise_deg_s=0.3)
    biases = []
    for seed in range(60):
        stream = synthesize_imu(still(2000), "head", noise=noise, rng=np.random.default_rng(seed))
        biases.append(stream.acc_imu.mean(0) - torch.tensor([0.0, 0.0, GRAVITY]))
    assert stream.acc_imu.std(0).mean() == pytest.approx(0.04, rel=0.05)
    assert stream.gyro_imu.std(0).mean().rad2deg() == pytest.approx(0.3, rel=0.05)
    assert torch.stack(biases).std() == pytest.approx(0.02, rel=0.15)


def test_attitude_and_heading_errors_are_as_large_as_asked():
    motion = still(36_000)
    exact = synthesize_imu(motion, "head")
    stream = synthesize_imu(motion, "head", noise=replace(NONE, attitude_deg=1.5), rng=np.random.default_rng(0))
    off = rotation.geodesic(exact.R_world_imu, stream.R_world_imu).rad2deg()
    assert off.square().mean().sqrt() == pytest.approx(1.5, rel=0.2)
    ends = []
    for seed in range(60):
        noise = replace(NONE, heading_walk_deg_per_sqrt_min=1.0)
        stream = synthesize_imu(still(3600), "head", noise=noise, rng=np.random.default_rng(seed))
        ends.append(rotation.yaw_of(stream.R_world_imu[-1]).rad2deg())
    assert torch.stack(ends).std() == pytest.approx(1.0, rel=0.25)


def test_a_strap_gives_under_acceleration_alone():
    noise = replace(NONE, play_deg=4.0)
    largest = []
    for seed in range(20):
        resting = synthesize_imu(still(60), "head", noise=noise, rng=np.random.default_rng(seed))
        turned = rotation.geodesic(resting.R_world_imu, synthesize_imu(still(60), "head").R_world_imu)
        assert turned.max() < 1e-3
        motion = carousel(rate=3.0)
        moved = synthesize_imu(motion, "left_wrist", noise=noise, rng=np.random.default_rng(seed))
        largest.append(rotation.geodesic(moved.R_world_imu, motion.joint("left_wrist").R).rad2deg().max().item())
    assert max(largest) < 4.01
    assert np.mean(largest) > 1.5


def test_calibration_leaves_a_heading_that_stays():
    noise = replace(NONE, heading_deg=2.0)
    yaw = []
    for seed in range(100):
        stream = synthesize_imu(still(60), "head", noise=noise, rng=np.random.default_rng(seed))
        each = rotation.yaw_of(stream.R_world_imu).rad2deg()
        assert each.std() < 1e-3
        yaw.append(each[0])
    assert torch.stack(yaw).std() == pytest.approx(2.0, rel=0.2)


def test_a_clock_that_is_off_shifts_the_signal():
    motion = swaying_motion(600)
    exact = synthesize_imu(motion, "left_wrist")
    stream = synthesize_imu(motion, "left_wrist", noise=replace(NONE, clock_offset_s=0.3), rng=np.random.default_rng(4))
    assert torch.equal(stream.timestamps, exact.timestamps)
    lags = range(-20, 21)
    error = [(stream.gyro_imu[50:-50] - exact.gyro_imu.roll(k, 0)[50:-50]).square().mean() for k in lags]
    best = int(torch.stack(error).argmin())
    assert 0 < abs(lags[best]) <= 18, "up to 0.3 s"
    assert error[best] < 0.02 * error[20]


def test_noise_without_a_generator_is_refused():
    with pytest.raises(AssertionError, match="generator"):
        synthesize_imu(still(20), "head", noise=NONE)
