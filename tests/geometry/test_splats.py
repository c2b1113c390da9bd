"""Splatting: the compiled projection against Camera's own, blocks against the whole cloud, discs by hand."""

import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import raster, rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import SplatCloud, _view_planes, lens_numbers
from wearcap.geometry.rigid import Rigid

CAMERAS = [
    Camera("pinhole", 64, 48, 40.0, 42.0, 30.0, 25.0),
    Camera("opencv", 64, 48, 40.0, 42.0, 30.0, 25.0, (-0.2, 0.03, 0.01, -0.02)),
    Camera("opencv", 64, 48, 40.0, 42.0, 30.0, 25.0, (-0.2, 0.03, 0.01, -0.02, 0.004)),
    Camera("fisheye", 64, 64, 20.0, 21.0, 30.0, 33.0, (0.01, -0.02, 0.003, -0.001)),
    Camera("fisheye624", 64, 64, 20.0, 21.0, 30.0, 33.0,
           (0.01, -0.02, 0.003, -0.001, 1e-4, 1e-5, 0.003, -0.002, 0.001, 0.002, -0.001, 0.003)),
    Camera("ocam", 64, 64, 20.0, 20.0, 30.0, 33.0, (1.01, 0.02, -0.01, 0.01, -0.02, *(0.001,) * 8)),
]  # fmt: skip
POSE = Rigid(rotation.exp(torch.tensor([0.3, -1.1, 0.7])), torch.tensor([0.4, -0.2, 0.3]))


def cloud_around(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32) * 3


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"{camera.model}-{len(camera.distortion)}")
def test_the_compiled_projection_is_the_cameras(camera):
    points = cloud_around(3000).astype(np.float64)
    pixels, valid = camera.project(torch.from_numpy(points))
    lens = lens_numbers(camera)
    found = np.array([raster._project_point(*point, lens) for point in points])
    inside = (found[:, 2] > 0) & (found[:, 0] >= -0.5) & (found[:, 0] < camera.width - 0.5)
    inside &= (found[:, 1] >= -0.5) & (found[:, 1] < camera.height - 0.5)
    assert 100 < valid.sum() < 2900
    np.testing.assert_array_equal(inside, valid.numpy())
    np.testing.assert_allclose(found[inside, :2], pixels[valid].numpy(), atol=1e-9)
    depth = np.linalg.norm(points, axis=1) if camera.is_fisheye else points[:, 2]
    np.testing.assert_allclose(1 / found[inside, 2], depth[inside])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"{camera.model}-{len(camera.distortion)}")
def test_blocks_that_are_passed_over_hold_nothing_in_view(camera):
    points = cloud_around(20000)
    index, depth = SplatCloud.build(points, block=16).draw(camera, POSE, 0.03)
    whole, whole_depth = SplatCloud.build(points, block=len(points)).draw(camera, POSE, 0.03)
    np.testing.assert_array_equal(index, whole)
    np.testing.assert_array_equal(depth, whole_depth)
    assert (index >= 0).mean() > 0.2


def test_the_number_in_a_pixel_is_that_of_the_nearest_point_there():
    camera = CAMERAS[1]
    points = cloud_around(5000)
    index, depth = SplatCloud.build(points).draw(camera, POSE, 1e-6)
    cam = POSE.inverse() @ torch.from_numpy(points)
    pixels, valid = camera.project(cam.double())
    cell = torch.where(valid[:, None], pixels.round().long(), -1)
    expected = np.full(index.shape, -1)
    for number in torch.argsort(cam[:, 2], descending=True).tolist():
        if valid[number] and cam[number, 2] > 0.02:
            expected[cell[number, 1], cell[number, 0]] = number
    np.testing.assert_array_equal(index, expected)
    seen = index >= 0
    np.testing.assert_allclose(depth[seen], cam[index[seen], 2].numpy(), rtol=1e-5)
    assert np.isinf(depth[~seen]).all()


def test_blocks_behind_and_beside_are_not_projected():
    camera = CAMERAS[0]
    assert len(_view_planes(camera)) == 4
    assert not len(_view_planes(CAMERAS[3]))  # sees more than a half-space
    cloud = SplatCloud.build(cloud_around(20000), block=64)
    pose = np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
    picture = np.full((48, 64), -np.inf, np.float32), np.full((48, 64), -1, np.int32)
    projected = raster.draw_splats(
        (cloud.points, cloud.first, cloud.centers, cloud.radii),
        pose,
        _view_planes(camera),
        lens_numbers(camera),
        0.01,
        True,
        0,
        *picture,
    )
    assert projected < 0.45 * 20000


def test_a_cloud_must_have_finite_points():
    with pytest.raises(WearcapError, match="without points"):
        SplatCloud.build(np.zeros((0, 3), np.float32))
    with pytest.raises(WearcapError, match="NaN"):
        SplatCloud.build(np.full((3, 3), np.nan, np.float32))
    one = SplatCloud.build(np.array([[0, 0, 2]], np.float32))
    index, _ = one.draw(CAMERAS[0], Rigid.identity(), 0.1)
    assert (index == 0).sum() == pytest.approx(np.pi * (0.1 * 41 / 2) ** 2, abs=4)
