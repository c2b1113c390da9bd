"""Simulated depth cameras: they stand where they can, see the person whole, and are as noisy as set."""

import numpy as np
import pytest
import torch

from benchmarks.tables.depth_rig import (
    KINECT,
    REGISTERED_DEG,
    REGISTERED_M,
    look_at,
    person_clouds,
    place_rig,
    registered,
    voxel_downsample,
)
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import capsules, checker_floor
from wearsim.places.world import World

CAMERA = KINECT.scaled(320, 288)
FLOOR = checker_floor(np.zeros(3), 4.0, 0.5, np.ones((2, 3)), np.ones(3))
AROUND = look_at(np.array([[2.0, 0.0, 1.2], [-1.0, 1.7, 1.2], [-1.0, -1.7, 1.2]]), np.array([0.0, 0.0, 1.0]))


def test_the_cloud_of_a_ball_lies_on_it_from_all_sides():
    ball = capsules(*[np.array([[0.0, 0.0, 1.0]])] * 2, *[np.array([0.2])] * 2, np.ones((1, 3)), 32)
    (cloud,) = person_clouds([FLOOR], [ball], AROUND, AROUND, np.random.default_rng(0), CAMERA)
    off = np.linalg.norm(cloud - [0.0, 0.0, 1.0], axis=1) - 0.2
    assert len(cloud) > 3000
    assert abs(np.median(off)) < 0.006
    assert 0.002 < off.std() < 0.012, "the noise at two metres"
    assert (np.abs(cloud[:, :2]).max(0) > 0.18).all()


def test_a_wall_hides_the_ball():
    ball, wall = (
        capsules(*[np.array([[x, 0.0, 1.0]])] * 2, *[np.array([r])] * 2, np.ones((1, 3)), 32)
        for x, r in ((0.0, 0.2), (1.0, 0.6))
    )
    first = AROUND[:1]
    (cloud,) = person_clouds([FLOOR, wall], [ball], first, first, np.random.default_rng(0), CAMERA)
    assert not len(cloud)


def test_cameras_look_at_what_they_should_and_stand_upright():
    poses = look_at(np.array([[2.0, 1.0, 1.5], [-1.0, 0.5, 1.0]]), np.array([0.0, 0.0, 0.9]))
    seen = poses.inverse() @ torch.tensor([0.0, 0.0, 0.9], dtype=torch.float64).expand(2, 3)
    assert torch.allclose(seen[:, :2], torch.zeros(2, 2).double(), atol=1e-9)
    assert (seen[:, 2] > 0).all()
    assert (poses.R[:, 2, 1] < 0).all(), "y points down"
    assert torch.allclose(torch.linalg.det(poses.R), torch.ones(2).double())


def test_registered_poses_are_as_far_off_as_set():
    off = registered(AROUND, np.random.default_rng(0))
    assert torch.allclose((off.t - AROUND.t).norm(dim=-1), torch.full((3,), REGISTERED_M).double(), atol=1e-9)
    assert torch.allclose(
        rotation.geodesic(off.R, AROUND.R), torch.full((3,), np.deg2rad(REGISTERED_DEG)).double(), atol=1e-5
    )


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


def test_voxels():
    points = torch.tensor([[0.01, 0, 0], [0.03, 0, 0], [-0.01, 0, 0], [5, 5, 5]])
    centres, voxel = voxel_downsample(points, 0.05)
    assert len(centres) == 3
    assert voxel[0] == voxel[1]
    assert torch.allclose(centres[voxel[0]], torch.tensor([0.02, 0, 0]))
    assert torch.allclose(centres[voxel[3]], points[3])
