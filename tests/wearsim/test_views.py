"""Photographs of simulated worlds: geometry agrees with the renderer, texture does not alias, walls are blank."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.render import render
from wearcap.geometry.rigid import Rigid
from wearsim.places.site import build_site
from wearsim.rendering import texture_kernels as kernels
from wearsim.rendering.views import Development, Scenery, exposed, render_view
from wearsim.sensors.slam import R_DEVICE_CAM

PINHOLE = Camera("pinhole", 160, 96, 75.0, 75.0, 79.5, 47.5)
HEAD = Camera("opencv", 160, 96, 75.0, 76.0, 80.0, 47.0, (-0.08, 0.02, 0.001, -0.0005))
FISHEYE = Camera("fisheye", 128, 128, 52.0, 52.0, 63.5, 63.5, (0.02, -0.004, 0.0, 0.0))


@pytest.fixture(scope="module")
def scenery() -> Scenery:
    return Scenery.of(build_site(np.random.default_rng(0), "site", scale=0.6))


def pose(scenery: Scenery, yaw: float, pitch: float = 0.1, shift=(0.0, 0.0)) -> Rigid:
    x, y, z = scenery.world.places.spots[0].position
    turn = rotation.about_axis("z", torch.tensor(yaw)) @ rotation.about_axis("y", torch.tensor(pitch))
    return Rigid(turn @ R_DEVICE_CAM, torch.tensor([x + shift[0], y + shift[1], z + 1.65]))


@pytest.mark.parametrize("camera", [PINHOLE, HEAD, FISHEYE], ids=lambda camera: camera.model)
def test_depth_is_the_renderers(scenery, camera):
    T = pose(scenery, 0.7)
    ours = exposed(scenery, camera, T)[1]
    grid = torch.stack(torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy"), -1)
    rays = camera.unproject(grid.double())
    pinhole = render(PINHOLE, T, [scenery.world.mesh]).depth
    points = torch.from_numpy(ours).double()[..., None] * rays
    pixels, valid = PINHOLE.project(points.nan_to_num(0.0, 0.0, 0.0))
    shown = valid.numpy() & np.isfinite(ours)
    assert shown.mean() > 0.2
    column, row = pixels.round().long().numpy()[shown].T
    gap = points.numpy()[shown][:, 2] / pinhole[row, column]
    assert np.median(np.abs(gap - 1)) < 0.01
    assert (np.abs(gap - 1) < 0.05).mean() > 0.93, "but for outlines"


def test_a_pixel_has_the_colour_of_the_point_that_it_shows(scenery):
    T = pose(scenery, 2.0)
    picture, depth = render_view(scenery, HEAD, T), exposed(scenery, HEAD, T)[1]
    row, column = 60, 90
    point = T @ (HEAD.unproject(torch.tensor([float(column), float(row)])) * float(depth[row, column]))
    vertices = scenery.world.mesh.vertices[scenery.world.mesh.faces].astype(np.float64)
    normal = scenery.paint.frames[:, 9:12]
    away = np.abs(((point.numpy() - vertices[:, 0]) * normal).sum(1))
    face = int(render(PINHOLE, T, [scenery.world.mesh]).index[row, column])
    assert away[face] < 0.01
    ray = point - T.t
    slope = abs(float(ray.numpy() @ normal[face]) / float(ray.norm()))
    footprint = np.array([float(ray.norm()) / 75.5 / np.sqrt(max(0.12, slope))])
    color = scenery.paint.colors_of(point.double().numpy()[None], np.array([face]), footprint)[0]
    assert np.abs(color.astype(int) - picture[row, column]).max() <= 6


def test_a_small_picture_is_the_mean_of_a_large_one(scenery):
    T = pose(scenery, -1.0)
    small = render_view(scenery, PINHOLE, T).astype(float)
    large = render_view(scenery, PINHOLE.scaled(4 * PINHOLE.width, 4 * PINHOLE.height), T).astype(float)
    averaged = large.reshape(PINHOLE.height, 4, PINHOLE.width, 4, 3).mean((1, 3))
    assert np.abs(small - averaged).mean() < 9.0
    assert np.abs((small - averaged).mean((0, 1))).max() < 4.0


def test_walls_are_blank_and_prints_are_not(scenery):
    faces, rng = (scenery.world.mesh.vertices[scenery.world.mesh.faces].astype(np.float64), np.random.default_rng(0))
    spread = {}
    for material in (kernels.PLASTER, kernels.POSTER, kernels.BOOKS, kernels.BRICK):
        face = rng.choice(np.flatnonzero(scenery.paint.materials == material), 400)
        weights = rng.dirichlet(np.ones(3), (400, 12))
        points = np.einsum("fsc,fcx->fsx", weights, faces[face]).reshape(-1, 3)
        colors = scenery.paint.colors_of(points, np.repeat(face, 12), np.full(len(points), 0.005))
        spread[material] = colors.reshape(400, 12, 3).astype(float).std(1).mean(-1)
    assert np.median(spread[kernels.PLASTER]) < 6
    assert all(np.median(spread[kind]) > 15 for kind in (kernels.POSTER, kernels.BOOKS, kernels.BRICK))


def test_the_same_place_looks_the_same_and_others_do_not(scenery):
    again = Scenery.of(build_site(np.random.default_rng(0), "site", scale=0.6))
    other = Scenery.of(build_site(np.random.default_rng(0), "elsewhere", scale=0.6))
    T = pose(scenery, 0.0)
    picture = render_view(scenery, HEAD, T)
    np.testing.assert_array_equal(picture, render_view(again, HEAD, T))
    assert np.abs(picture.astype(float) - render_view(other, HEAD, T)).mean() > 3


def test_blur_averages_and_development_spoils(scenery):
    one, two = pose(scenery, 0.0), pose(scenery, 0.05)
    both = Rigid(torch.stack([one.R, two.R]), torch.stack([one.t, two.t]))
    mean = (render_view(scenery, HEAD, one).astype(float) + render_view(scenery, HEAD, two)) / 2
    assert np.abs(render_view(scenery, HEAD, both) - mean).max() <= 1.5
    clean = render_view(scenery, HEAD, one).astype(float)
    rng = np.random.default_rng(0)
    noisy = render_view(scenery, HEAD, one, Development(noise=4.0), rng).astype(float)
    inner = (clean > 30) & (clean < 225)
    assert (noisy - clean)[inner].std() == pytest.approx(4.0, rel=0.1)
    assert render_view(scenery, HEAD, one, Development(contrast=0.1)).std() < 0.15 * clean.std()
    dark = render_view(scenery, HEAD, one, Development(exposure=0.5, vignetting=0.6)).astype(float)
    assert dark[48, 80].mean() == pytest.approx(0.5 * clean[48, 80].mean(), rel=0.1)
    assert dark[:5, :5].mean() < 0.35 * clean[:5, :5].mean()


def test_a_lens_that_sees_sidewards_wants_a_fisheye_model(scenery):
    wide = replace(PINHOLE, fx=1.0, fy=1.0)
    with pytest.raises(WearcapError, match="sidewards"):
        render_view(scenery, wide, pose(scenery, 0.0))
