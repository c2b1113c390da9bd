"""The software renderer against what can be computed by hand."""

import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.mesh import Mesh, capsules, checker_floor, merged
from wearcap.geometry.render import Light, Splats, _orthographic_map, render
from wearcap.geometry.rigid import Rigid

CAMERA = Camera.pinhole(96, 72, 60.0)
EYE = Rigid.identity()
RED, BLUE = np.array([1, 0, 0], np.float32), np.array([0, 0, 1], np.float32)


def square(depth: float, half: float, color: np.ndarray = RED, x: float = 0.0) -> Mesh:
    """A square across the optical axis of a camera at the origin."""
    corners = [[x - half, -half, depth], [x + half, -half, depth], [x + half, half, depth], [x - half, half, depth]]
    return Mesh(np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32), color)


def ball(center: tuple[float, float, float], radius: float, segments: int = 96) -> Mesh:
    point, size = np.array([center]), np.array([radius])
    return capsules(point, point, size, size, BLUE[None], segments)


def looking_down(height: float) -> Rigid:
    """A camera above the origin, its picture's top towards +x."""
    return Rigid(torch.tensor([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), torch.tensor([0.0, 0.0, height]))


def pixel_rays(camera: Camera) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)


def test_depth_of_a_slanted_plane_is_exact():
    # z = 3 + 0.5 x + 0.25 y, larger than the picture and with corners behind the camera
    xy = np.array([[-20, -20], [20, -20], [20, 20], [-20, 20]], float)
    plane = np.concatenate([xy, (3 + xy @ [0.5, 0.25])[:, None]], 1).astype(np.float32)
    frame = render(CAMERA, EYE, [Mesh(plane, np.array([[0, 1, 2], [0, 2, 3]], np.int32), RED)])
    expected = 3 / (1 - pixel_rays(CAMERA)[..., :2] @ [0.5, 0.25])
    np.testing.assert_allclose(frame.depth, expected, rtol=2e-6)
    assert set(np.unique(frame.index)) == {0, 1}


def test_depth_of_a_sphere_seen_by_a_moved_camera():
    center, radius = np.array([0.3, -0.2, 3.0]), 0.8
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    pose = Rigid(turn, torch.tensor([4.0, 5.0, -6.0], dtype=torch.float64))
    world = (pose @ torch.from_numpy(center)).tolist()
    frame = render(CAMERA, pose, [ball((world[0], world[1], world[2]), radius)])
    rays = pixel_rays(CAMERA)
    a, b = (rays**2).sum(-1), rays @ center
    inside = b**2 - a * (center @ center - radius**2)
    expected = (b - np.sqrt(np.maximum(inside, 0))) / a
    clearly = inside > 0.3  # away from the rim, where depth has no slope to speak of
    np.testing.assert_allclose(frame.depth[clearly], expected[clearly], atol=2e-3)
    assert np.isinf(frame.depth[inside < -0.05]).all()
    assert (frame.index[inside < -0.05] == -1).all()


def test_fisheye_depth_runs_along_the_ray():
    camera = Camera("fisheye", 80, 80, 30.0, 30.0, 39.5, 39.5, (0.0,) * 4)
    frame = render(camera, EYE, [ball((0.0, 0.0, 0.0), 2.0)])
    seen = np.isfinite(frame.depth)
    assert seen.mean() > 0.9  # it looks beyond 90° off its axis, too
    np.testing.assert_allclose(frame.depth[seen], 2.0, atol=4e-3)


def test_the_nearest_wins_in_any_order_and_the_index_names_its_face():
    far, near = square(4.0, 2.0), square(2.0, 0.3, BLUE)
    for meshes, near_faces, far_faces in (([far, near], {2, 3}, {0, 1}), ([near, far], {0, 1}, {2, 3})):
        frame = render(CAMERA, EYE, meshes)
        assert frame.index[36, 48] in near_faces
        assert frame.index[36, 20] in far_faces
        assert frame.depth[36, 48] == pytest.approx(2.0)
        assert frame.color[36, 48].argmax() == 2
        assert frame.color[36, 20].argmax() == 0


def test_crossing_triangles_hide_one_another_per_pixel():
    left_near = Mesh(
        np.array([[-1, -1, 2], [1, -1, 4], [1, 1, 4], [-1, 1, 2]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32), BLUE,
    )  # fmt: skip
    frame = render(CAMERA, EYE, [square(3.0, 2.0), left_near])
    assert frame.color[36, 40].argmax() == 2
    assert frame.color[36, 56].argmax() == 0


def test_neighbouring_triangles_leave_no_gap():
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 20), np.linspace(-3, 3, 20)), -1).reshape(-1, 2)
    vertices = np.concatenate([grid, 2 + 0.3 * random.random((400, 1))], 1).astype(np.float32)
    cell = (20 * np.arange(19)[:, None] + np.arange(19)).ravel()
    faces = np.concatenate([np.stack([cell, cell + 1, cell + 21], -1), np.stack([cell, cell + 21, cell + 20], -1)])
    assert (render(CAMERA, EYE, [Mesh(vertices, faces.astype(np.int32), RED)]).index >= 0).all()


def test_splats_have_their_radius_order_and_numbers():
    points = np.array([[0, 0, 2], [0, 0, 3], [0.6, 0, 3]], np.float32)
    wall = square(2.5, 0.2)
    frame = render(CAMERA, EYE, [wall], [Splats(points, BLUE, radius=4.0)])
    assert frame.point_index[36, 48] == 0
    assert not (frame.point_index == 1).any()  # hidden by the wall and the first
    assert (frame.point_index == 2).sum() == pytest.approx(np.pi * 16, abs=6)
    assert (frame.point_index[frame.index < frame.face_count] == -1).all()
    metric = render(CAMERA, EYE, [], [Splats(points[2:], BLUE, radius=0.3, metric=True)])
    assert (metric.index == 0).sum() == pytest.approx(np.pi * (0.3 * CAMERA.fx / 3) ** 2, rel=0.1)
    tiny = render(CAMERA, EYE, [], [Splats(points[2:], BLUE, radius=0.01)])
    assert (tiny.index == 0).sum() == 1


def test_nothing_behind_the_camera_is_drawn():
    behind = np.array([[0, 0, -1]], np.float32)
    frame = render(CAMERA, EYE, [square(-1.0, 5.0)], [Splats(behind, BLUE, radius=9.0)])
    assert (frame.index == -1).all()
    assert (frame.color == 255).all()


def test_supersampling_smooths_edges_and_keeps_the_picture():
    mesh = [square(2.0, 0.5)]
    plain, fine = render(CAMERA, EYE, mesh), render(CAMERA, EYE, mesh, supersample=3)
    assert plain.color.shape == fine.color.shape
    assert len(np.unique(fine.color.reshape(-1, 3), axis=0)) > len(np.unique(plain.color.reshape(-1, 3), axis=0))
    assert np.abs(plain.color.astype(float) - fine.color).mean() < 2


def test_shadows_fall_away_from_the_light_and_darken_where_things_touch():
    white = np.ones((2, 3), np.float32)
    floor = checker_floor(np.zeros(3), 3.0, 0.5, white, white[0])
    camera, above = Camera.pinhole(121, 121, 60.0), looking_down(4.0)

    def brightness(height: float, at: tuple[float, float]) -> float:
        light = Light(to_light=(1.0, 0.0, 1.0), shadow_center=(0.0, 0.0, 0.0))
        frame = render(camera, above, [floor, ball((0.0, 0.0, height), 0.2)], light=light)
        pixels, _ = camera.project(above.inverse() @ torch.tensor([*at, 0.0]))
        column, row = pixels.round().int().tolist()
        return float(frame.color[row, column].mean())

    lit = brightness(1.0, (1.0, 0.0))
    assert brightness(1.0, (-1.0, 0.0)) < 0.8 * lit  # a light from +x at 45° throws it to x = -1
    assert brightness(0.2, (0.18, 0.0)) < 0.9 * lit  # beside the touching point, on the lit side
    assert brightness(0.2, (-1.0, 0.0)) == pytest.approx(lit, rel=0.02)


def test_orthographic_map_holds_heights():
    height, axes = _orthographic_map([ball((0.5, 0.0, 1.0), 0.25)], (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 1.0, 200)
    assert height.max() == pytest.approx(1.25, abs=1e-3)
    place = axes @ [0.5, 0.0, 1.25, 1.0]
    column, row = (place[:2] * 100).astype(int)
    assert height[row, column] == pytest.approx(1.25, abs=1e-3)
    assert np.isinf(height).mean() == pytest.approx(1 - np.pi * 0.25**2 / 4, abs=0.01)


def test_solids_are_closed_and_face_outwards():
    start, end = np.array([[0.0, 0, 0], [1, 1, 1]]), np.array([[0.0, 0, 1], [1, 1, 1]])
    mesh = capsules(start, end, np.array([0.1, 0.2]), np.array([0.1, 0.2]), np.stack([RED, BLUE]), 64)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    assert volume == pytest.approx(np.pi * 0.01 * (1 + 0.4 / 3) + np.pi * 4 / 3 * 0.008, rel=0.01)
    both = merged([mesh, mesh])
    assert both.faces.max() == len(both.vertices) - 1
    with pytest.raises(WearcapError, match="colours"):
        Mesh(mesh.vertices, mesh.faces, np.zeros((5, 3), np.float32))
