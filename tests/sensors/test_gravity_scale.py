"""Scale and vertical without a board: from a sensor on the head, and from the floor."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

import calibration_session as simulated
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import ImuStream
from wearcap.sensors.camera_alignment import SlamAlignment
from wearcap.sensors.monocular_slam import by_floor, by_head_imu

CalibrationSession = simulated.CalibrationSession
STANDING = simulated.STANDING
SEEDS = range(4)


@lru_cache
def walked(seed: int) -> CalibrationSession:
    return simulated.simulate_calibration(seed, camera_fps=30.0, walk_s=120.0)


def tilt_deg(found: SlamAlignment, made: CalibrationSession) -> float:
    cos = (found.R_world_slam[2] @ made.planted.R_world_slam[2]).item()
    return math.degrees(math.acos(min(cos, 1.0)))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sensor_on_the_head_tells_scale_and_vertical(seed):
    made = walked(seed)
    found = by_head_imu(made.slam, made.head_imu)
    assert found.scale == pytest.approx(made.planted.scale, rel=0.005)
    assert tilt_deg(found, made) < 0.1
    assert 0.0005 < (found.scale_std or 0) < 0.004
    assert 0.002 < (found.gravity_std_deg or 0) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_the_floor_tells_scale_and_vertical(seed):
    made = walked(seed)
    found = by_floor(made.slam, made.points_slam, STANDING, made.measured.standing_m)
    assert found.scale == pytest.approx(made.planted.scale, rel=0.005)
    assert tilt_deg(found, made) < 0.2
    # 5 mm of 1.6 m is 0.3 %
    assert 0.002 < (found.scale_std or 0) < 0.006
    assert 0.002 < (found.gravity_std_deg or 0) < 0.1


@pytest.fixture(scope="module")
def exact() -> CalibrationSession:
    silent = simulated.SessionNoise(acc_noise=0.0, acc_bias=0.0, jitter_m=0.0, jitter_deg=0.0)
    return simulated.simulate_calibration(9, silent, walk_s=15.0)


def test_without_noise_the_filter_is_the_same_on_both_sides(exact):
    found = by_head_imu(exact.slam, exact.head_imu)
    assert found.scale == pytest.approx(exact.planted.scale, rel=1.5e-3)
    assert tilt_deg(found, exact) < 0.02


def test_a_bias_and_wild_samples_are_borne(exact):
    force = exact.head_imu.acc_imu.clone()
    force += torch.tensor([0.03, -0.02, 0.03])
    force[100::1500] += 60.0
    found = by_head_imu(exact.slam, replace(exact.head_imu, acc_imu=force))
    assert found.scale == pytest.approx(exact.planted.scale, rel=0.01)
    assert tilt_deg(found, exact) < 0.4


def test_where_the_sensor_sits_is_taken_into_account(exact):
    R_cam_imu = rotation.exp(torch.tensor([0.5, -1.0, 0.7]))
    turned = replace(exact.head_imu, acc_imu=exact.head_imu.acc_imu @ R_cam_imu)
    found, plain = (
        by_head_imu(exact.slam, turned, Rigid(R_cam_imu, torch.zeros(3))),
        by_head_imu(exact.slam, exact.head_imu),
    )
    assert found.scale == pytest.approx(plain.scale, rel=1e-5)
    with pytest.raises(WearcapError, match="gravity of|uncertain"):
        by_head_imu(exact.slam, turned)


def test_what_tells_no_scale_is_refused(exact):
    imu, slam = exact.head_imu, exact.slam
    with pytest.raises(WearcapError, match="gravity of 1.00 m/s².*Check the unit"):
        by_head_imu(slam, replace(imu, acc_imu=imu.acc_imu / 9.81))
    with pytest.raises(WearcapError, match="share 0.0 s"):
        by_head_imu(slam, replace(imu, timestamps=imu.timestamps + 1e4))
    with pytest.raises(WearcapError, match="without acc_imu"):
        by_head_imu(slam, replace(imu, acc_imu=None))
    lost = slam[(slam.timestamps < 70) | (slam.timestamps > 72)]
    with pytest.raises(WearcapError, match="lost at"):
        by_head_imu(lost, imu)
    still = slam.timestamps < 40
    parked = replace(slam[still], t_world_body=0 * slam[still].t_world_body)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.001, parked.t_world_body.shape)).float()
    force = (parked.R_world_body.mT @ torch.tensor([0.0, 0.0, 9.81])[:, None])[..., 0]
    with pytest.raises(WearcapError, match="uncertain by .*Walk with turns"):
        by_head_imu(replace(parked, t_world_body=noise), ImuStream(parked.timestamps, "head", acc_imu=force))


def test_no_floor_is_reported(exact):
    with pytest.raises(WearcapError, match="0 of 0 points below the path.*Look at the floor"):
        by_floor(exact.slam, exact.points_slam[:0], STANDING, 1.6)
    cloud = 10 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(WearcapError, match="lie on one plane"):
        by_floor(exact.slam, cloud, STANDING, 1.6)
    with pytest.raises(WearcapError, match="a standing height of 160 m"):
        by_floor(exact.slam, exact.points_slam, STANDING, 160)
