"""Simulated depth cameras: they stand where they can, see the person whole, and are as noisy as set."""

import numpy as np
import pytest
import torch

from benchmarks.tables import simulated_depth_rig as simulated
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import capsules, checker_floor
from wearcap.geometry.rigid import Rigid
from wearsim.places.world import World

KINECT = simulated.KINECT
DepthNoise = simulated.DepthNoise
approximate = simulated.approximate
look_at = simulated.look_at
place_rig = simulated.place_rig
simulate_rig = simulated.simulate_rig

CAMERA = KINECT.scaled(320, 288)
FLOOR = checker_floor(np.zeros(3), 4.0, 0.5, np.ones((2, 3)), np.ones(3))
ABOVE = look_at(np.array([[0.0, 0.01, 2.0]]), np.zeros(3))
QUIET = DepthNoise(0.0, 0.0, 0.0, flying_share=0.0, edge_dropout=0.0, dropout=0.0)


def test_without_noise_the_floor_lies_at_its_depth_in_whole_millimetres():
    rig = simulate_rig([FLOOR], [], ABOVE, np.random.default_rng(0), camera=CAMERA, noise=QUIET, stills=1)
    assert rig.depth_mm.shape == (1, 0, 288, 320)
    assert abs(int(rig.empty_mm[0, 0, 144, 160]) - 2000) <= 1


def test_the_noise_grows_with_depth_as_set():
    noise = DepthNoise(bias_m=0.0)
    rig = simulate_rig([FLOOR], [], ABOVE, np.random.default_rng(0), camera=CAMERA, noise=noise, stills=40)
    middle = rig.empty_mm[0, :, 134:154, 150:170].astype(float)
    middle[middle == 0] = np.nan
    assert np.nanstd(middle, axis=0).mean() == pytest.approx(1000 * (0.0015 + 0.0015 * 2.0), rel=0.05)
    assert np.isnan(middle).mean() == pytest.approx(noise.dropout, abs=0.002)


def test_edges_fly_and_drop_out():
    ball = capsules(*[np.array([[0.0, 0.0, 1.0]])] * 2, *[np.array([0.2])] * 2, np.ones((1, 3)), 32)
    rig = simulate_rig([FLOOR], [ball], ABOVE, np.random.default_rng(0), camera=CAMERA, stills=1)
    image = rig.depth_mm[0, 0].astype(float)
    between = (image > 1150) & (image < 1900)
    assert 20 < between.sum() < 600, "pixels in mid-air along the ball's outline"
    assert (image[100:200, 100:220] == 0).sum() > 20


def test_cameras_look_at_what_they_should_and_stand_upright():
    poses = look_at(np.array([[2.0, 1.0, 1.5], [-1.0, 0.5, 1.0]]), np.array([0.0, 0.0, 0.9]))
    seen = poses.inverse() @ torch.tensor([0.0, 0.0, 0.9], dtype=torch.float64).expand(2, 3)
    assert torch.allclose(seen[:, :2], torch.zeros(2, 2).double(), atol=1e-9)
    assert (seen[:, 2] > 0).all()
    assert (poses.R[:, 2, 1] < 0).all(), "y points down"
    assert torch.allclose(torch.linalg.det(poses.R), torch.ones(2).double())


def test_approximate_poses_are_as_far_off_as_asked():
    poses = look_at(np.array([[2.0, 1.0, 1.5], [-1.0, 0.5, 1.0]]), np.zeros(3))
    rough = approximate(poses, np.random.default_rng(0))
    assert torch.allclose((rough.t - poses.t).norm(dim=-1), torch.full((2,), 0.1).double(), atol=1e-9)
    assert torch.allclose(rotation.geodesic(rough.R, poses.R), torch.full((2,), np.deg2rad(3.0)).double(), atol=1e-4)


def test_the_rig_stands_on_free_floor_and_sees_from_feet_to_crown(stairs_flat: World):
    candidates = stairs_flat.sample_floor(np.random.default_rng(0), 400)
    spot = candidates[stairs_flat.navigation.clearance_at(candidates).argmax()]
    poses = place_rig(stairs_flat, spot)
    flat = poses.t.numpy() * [1, 1, 0] + [0, 0, spot[2]]
    assert (stairs_flat.navigation.clearance_at(flat) > 0.15).all()
    person = torch.from_numpy(spot) + torch.tensor([[0.0, 0.0, 0.02], [0.0, 0.0, 1.9]]).double()
    for number in range(3):
        _, valid = KINECT.project(poses[number].inverse() @ person)
        assert valid.all()
    turns = np.sort(np.arctan2(*(flat - spot)[:, 1::-1].T))
    assert np.allclose(np.diff(turns), 2 * np.pi / 3, atol=0.01)


def test_a_narrow_place_is_refused(stairs_flat: World):
    candidates = stairs_flat.sample_floor(np.random.default_rng(0), 400)
    corner = candidates[stairs_flat.navigation.clearance_at(candidates).argmin()]
    with pytest.raises(WearcapError, match="no room for 3 cameras"):
        place_rig(stairs_flat, corner)


def test_poses_come_back_with_the_images():
    rig = simulate_rig([FLOOR], [], ABOVE, np.random.default_rng(0), camera=CAMERA, stills=2)
    assert isinstance(rig.T_world_cam, Rigid)
    assert rig.camera == CAMERA
    assert rig.empty_mm.dtype == np.uint16
