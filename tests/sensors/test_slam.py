"""Semi-dense points: on surfaces, seen from where they are reported to have been seen, nothing through walls."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from boxes import BOX_FACES, box_corners
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.recording import HeadStream
from wearsim.sensors.slam import CAMERA, R_DEVICE_CAM, SlamPoints, keyframes, semidense_points, textured_points

EXACT = SlamPoints(noise_at_2m=0.0, outliers=0.0)


def boxes(*spans) -> Mesh:
    """One mesh of axis-aligned boxes, each ((x, y, z) low, (x, y, z) high)."""
    vertices = [box_corners(low, high) for low, high in spans]
    faces = np.concatenate([BOX_FACES + 8 * k for k in range(len(spans))]).astype(np.int32)
    return Mesh(np.concatenate(vertices), faces, np.array([0.5, 0.5, 0.5], np.float32))


WALL, SHELF, HIDDEN = ((2, -4, 0), (2.1, 4, 3)), ((1.5, -1, 1), (1.7, 1, 2)), ((3, -4, 0), (3.1, 4, 3))


def looking(yaws: torch.Tensor, x: torch.Tensor | None = None) -> HeadStream:
    """A head at 1.6 m that turns about the vertical."""
    count = len(yaws)
    t = torch.stack([torch.zeros(count) if x is None else x, torch.zeros(count), torch.full((count,), 1.6)], -1)
    time = torch.arange(count, dtype=torch.float64) / 60
    return HeadStream(time, rotation.about_axis("z", yaws), t, torch.eye(3), torch.zeros(3))


@pytest.fixture(scope="module")
def mesh():
    return boxes(WALL, SHELF, HIDDEN)


def texture(*by_box: float) -> np.ndarray:
    return np.repeat(np.array(by_box, np.float64), 12)


def to_surface(points, mesh):
    """Distance of each point to the nearest box (m)."""
    low = torch.from_numpy(mesh.vertices.reshape(-1, 8, 3).min(1))
    high = torch.from_numpy(mesh.vertices.reshape(-1, 8, 3).max(1))
    outside = torch.maximum(low - points[:, None], points[:, None] - high).clamp(min=0).norm(dim=-1)
    inside = torch.minimum(points[:, None] - low, high - points[:, None]).amin(-1).clamp(min=0)
    return (outside + inside).amin(1)


def test_points_lie_on_textured_surfaces_and_never_behind_the_wall(mesh):
    head = looking(torch.linspace(-0.6, 0.6, 120))
    cloud = semidense_points(mesh, texture(30, 200, 100), head, np.random.default_rng(0), EXACT)
    points = cloud.points_world
    assert len(points) > 300
    assert to_surface(points, mesh).max() < 1e-4
    assert points[:, 0].max() < 2.05, "the wall hides what is behind it"
    assert (points[:, 0] < 1.71).any()
    shadow = (points[:, 0] > 1.9) & (points[:, 1].abs() < 1.0) & ((points[:, 2] - 1.55).abs() < 0.3)
    assert shadow.float().mean() < 0.01, "nor is there anything in the shelf's shadow"


def test_each_point_was_in_sight_when_it_was_first_seen(mesh):
    head = looking(torch.linspace(-2.0, 2.0, 240))
    cloud = semidense_points(mesh, texture(30, 200, 100), head, np.random.default_rng(0), EXACT)
    frame = (cloud.first_seen * 60).round().long()
    ray = (head.R_world_device[frame] @ R_DEVICE_CAM).transpose(-1, -2) @ (
        cloud.points_world - head.t_world_device[frame]
    )[..., None]
    pixels, valid = CAMERA.project(ray[..., 0])
    assert valid.all()
    assert ((pixels > -0.6) & (pixels < torch.tensor([CAMERA.width, CAMERA.height]) - 0.4)).all()
    assert (cloud.first_seen.diff() >= 0).all()
    assert cloud.first_seen.unique().numel() > 5
    assert set(frame.tolist()) <= set(keyframes(head, EXACT))


def test_who_looks_away_sees_nothing(mesh):
    head = looking(torch.full((60,), float(np.pi)))
    assert len(semidense_points(mesh, texture(30, 200, 100), head, np.random.default_rng(0)).points_world) == 0


def test_depth_noise_grows_with_the_square_of_distance():
    wall = boxes(((2, -9, -9), (2.1, 9, 9)))
    settings = SlamPoints(outliers=0.0)
    deviation = {}
    for distance in (2.0, 4.0):
        head = looking(torch.zeros(2), torch.full((2,), 2.0 - distance))
        cloud = semidense_points(wall, texture(300), head, np.random.default_rng(0), settings)
        ray = cloud.points_world - head.t_world_device[0]
        length = ray.norm(dim=-1)
        true = distance / (ray[:, 0] / length)
        central = true < 1.1 * distance
        deviation[distance] = (length - true)[central].std().item()
    assert deviation[2.0] == pytest.approx(0.0105, rel=0.1)
    assert deviation[4.0] / deviation[2.0] == pytest.approx(4.0, rel=0.1)


def test_outliers_are_as_many_as_asked():
    wall = boxes(((2, -9, -9), (2.1, 9, 9)))
    settings = replace(EXACT, outliers=0.2)
    cloud = semidense_points(wall, texture(300), looking(torch.zeros(2)), np.random.default_rng(0), settings)
    off = to_surface(cloud.points_world, wall) > 0.005
    assert off.float().mean() == pytest.approx(0.2, abs=0.04)


def test_confidence_is_that_of_the_depth():
    wall = boxes(((2, -9, -9), (2.1, 9, 9)))
    cloud = semidense_points(wall, texture(300), looking(torch.zeros(2)), np.random.default_rng(0))
    distance = cloud.points_world.sub(torch.tensor([0.0, 0.0, 1.6])).norm(dim=-1)
    near, far = cloud.confidence[distance < 2.3], cloud.confidence[distance > 3.2]
    assert near.mean() > 0.7 > 0.5 > far.mean()


def test_texture_decides_the_density(mesh):
    points, normals = textured_points(mesh, texture(0, 100, 0), np.random.default_rng(0), 10_000)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    centre = np.array([1.6, 0.0, 1.5])
    assert ((points - centre) * normals).sum(1).min() > 0, "outwards"
    area = 2 * (0.2 * 2 + 0.2 * 1 + 2 * 1)
    assert len(points) == pytest.approx(100 * area, rel=0.15)
    assert points[:, 0].max() < 1.71
    assert len(textured_points(mesh, texture(500, 500, 500), np.random.default_rng(0), 1000)[0]) < 1150


def test_keyframes_are_bounded():
    spinning = looking(torch.linspace(0, 400, 4000))
    assert 20 <= len(keyframes(spinning, SlamPoints(max_keyframes=30))) <= 30
    assert keyframes(looking(torch.zeros(100)), SlamPoints()) == [0]
