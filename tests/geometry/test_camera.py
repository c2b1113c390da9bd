"""Cameras: known values, round trips, gradients, valid masks, resized images."""

import math

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera

ARIA = (-0.0257, 0.1005, -0.0711, 0.0176, 0.0018, -0.0007, 0.0008, -0.0002, 0.0006, -0.0001, -0.0009, 0.0002)
OCAM = (1.0005, -0.0014, 0.0015, 0.001, -0.12, 0.02, -0.01, 0.002, 0.0, 0.001, 0.0, 0.0, 0.0)
CAMERAS = {
    "pinhole": Camera("pinhole", 640, 480, 500.0, 510.0, 320.0, 240.0),
    # the head camera of the HPS data set
    "opencv": Camera("opencv", 1920, 1080, 871.80, 885.58, 961.54, 550.69, (-0.2546, 0.0804, 1.458e-4, -1.397e-5)),
    "opencv5": Camera("opencv", 640, 480, 450.0, 450.0, 318.0, 243.0, (-0.3, 0.12, 1e-3, -2e-3, -0.02)),
    "fisheye": Camera("fisheye", 640, 480, 190.0, 191.0, 317.0, 239.0, (0.02, -0.01, 0.004, -0.0005)),
    "fisheye624": Camera("fisheye624", 640, 480, 241.0, 241.0, 317.0, 236.0, ARIA),
    "ocam": Camera("ocam", 640, 480, 276.0, 276.0, 318.6, 242.9, OCAM),
}  # fmt: skip


@pytest.fixture(params=CAMERAS, ids=str)
def camera(request) -> Camera:
    return CAMERAS[request.param]


def pixel_grid(camera: Camera, margin: float = 0.0) -> torch.Tensor:
    x = torch.linspace(margin, camera.width - 1 - margin, 13, dtype=torch.float64)
    y = torch.linspace(margin, camera.height - 1 - margin, 11, dtype=torch.float64)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def test_pixels_to_rays_and_back(camera):
    pixels = pixel_grid(camera)
    rays = camera.unproject(pixels)
    found = rays.isfinite().all(-1)
    assert found.double().mean() > 0.95
    assert torch.allclose(rays[found].norm(dim=-1), torch.ones(int(found.sum()), dtype=torch.float64))
    again, valid = camera.project(3.7 * rays[found])
    assert valid.all()
    assert torch.allclose(again, pixels[found], atol=1e-6)


def test_points_to_pixels_and_back(camera):
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    pixels, valid = camera.project(points)
    assert pixels.isfinite().all()
    assert 20 < valid.sum() < 450
    rays = camera.unproject(pixels[valid])
    direction = torch.nn.functional.normalize(points[valid], dim=-1)
    assert torch.allclose(rays, direction, atol=1e-8)


def test_float32_is_good_to_a_hundredth_of_a_pixel(camera):
    pixels = pixel_grid(camera).float()
    rays = camera.unproject(pixels)
    found = rays.isfinite().all(-1)
    assert found.float().mean() > 0.95
    assert (camera.project(rays[found])[0] - pixels[found]).abs().max() < 0.02


def test_derivatives(camera):
    points = torch.tensor([[0.0, 0.0, 2.0], [0.3, -0.2, 1.0], [-0.5, 0.4, 1.5]], dtype=torch.float64)
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: camera.project(p)[0], points, atol=1e-4)
    centre = [camera.cx, camera.cy]
    pixels = torch.tensor([centre, [camera.cx + 40, camera.cy - 60]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(camera.unproject, pixels, eps=1e-4, atol=1e-6)


def test_opencv_formula():
    camera = CAMERAS["opencv5"]
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = 0.31, -0.22
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (
        camera.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + camera.cx,
        camera.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + camera.cy,
    )
    pixels, _ = camera.project(torch.tensor([2 * x, 2 * y, 2.0], dtype=torch.float64))
    assert pixels.tolist() == pytest.approx(expected, abs=1e-9)


def test_fisheye_formula():
    camera = CAMERAS["fisheye"]
    theta, phi = 0.8, 2.1
    k1, k2, k3, k4 = camera.distortion
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    point = torch.tensor(
        [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)], dtype=torch.float64
    )
    expected = (camera.fx * bent * math.cos(phi) + camera.cx, camera.fy * bent * math.sin(phi) + camera.cy)
    assert camera.project(5 * point)[0].tolist() == pytest.approx(expected, abs=1e-9)


def test_fisheye624_formula():
    camera = CAMERAS["fisheye624"]
    k, (p0, p1), (s0, s1, s2, s3) = ARIA[:6], ARIA[6:8], ARIA[8:]
    x, y, z = 0.5, -0.3, 0.9
    r = math.hypot(x / z, y / z)
    theta = math.atan(r)
    gain = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k))) / r
    u, v = gain * x / z, gain * y / z
    r2 = u * u + v * v
    expected = (
        camera.fx * (u + p0 * (2 * u * u + r2) + 2 * p1 * u * v + s0 * r2 + s1 * r2**2) + camera.cx,
        camera.fy * (v + p1 * (2 * v * v + r2) + 2 * p0 * u * v + s2 * r2 + s3 * r2**2) + camera.cy,
    )
    assert camera.project(torch.tensor([x, y, z], dtype=torch.float64))[0].tolist() == pytest.approx(expected)


def test_ocam_formula():
    camera = CAMERAS["ocam"]
    theta, phi = 0.9, 2.1
    bent = theta + sum(k * theta ** (i + 2) for i, k in enumerate(OCAM[3:]))
    down, right = bent * math.sin(phi), bent * math.cos(phi)
    c, d, e = OCAM[:3]
    expected = (276.0 * (e * down + right) + camera.cx, 276.0 * (c * down + d * right) + camera.cy)
    point = torch.tensor(
        [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)], dtype=torch.float64
    )
    assert camera.project(5 * point)[0].tolist() == pytest.approx(expected, abs=1e-9)


def test_what_cannot_be_seen_is_not_valid():
    points = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [9, 0, 1]])
    assert CAMERAS["pinhole"].project(points)[1].tolist() == [True, False, False, False]
    # barrel distortion folds far points back into the image: they must not be valid
    pixels, valid = CAMERAS["opencv5"].project(torch.tensor([[2.2, 0.3, 1.0]]))
    assert 0 < pixels[0, 0] < 640
    assert not valid.any()
    # a fisheye sees beside and a little behind itself
    wide = Camera("fisheye", 1000, 1000, 250.0, 250.0, 500.0, 500.0, (0.0, 0.0, 0.0, 0.0))
    points = torch.tensor([[1.0, 0, 0.0], [1.0, 0, -0.2], [0.0, 0, -1.0]])
    assert wide.project(points)[1].tolist() == [True, True, False]


def test_pixels_beyond_the_lens_have_no_ray():
    camera = Camera("opencv", 4000, 480, 450.0, 450.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))
    rays = camera.unproject(torch.tensor([[330.0, 240.0], [3500.0, 240.0]]))
    assert rays[0].isfinite().all()
    assert rays[1].isnan().all()


def test_scaled_image(camera):
    half = camera.scaled(camera.width // 2, camera.height // 2)
    corner = torch.tensor([-0.5, -0.5], dtype=torch.float64)  # an image's corner stays its corner
    middle = torch.tensor([camera.width / 2 - 0.5, camera.height / 2 - 0.5], dtype=torch.float64)
    ray = camera.unproject(middle)
    assert torch.allclose(half.project(ray)[0], (middle + 0.5) / 2 - 0.5, atol=1e-9)
    if camera.model == "pinhole":
        assert torch.allclose(half.project(camera.unproject(corner))[0], corner, atol=1e-9)
    double = half.scaled(camera.width, camera.height)
    assert (double.fx, double.fy, double.cx, double.cy) == pytest.approx((camera.fx, camera.fy, camera.cx, camera.cy))


def test_field_of_view():
    camera = Camera.pinhole(640, 480, 60.0)
    top = camera.unproject(torch.tensor([319.5, -0.5], dtype=torch.float64))
    assert math.degrees(math.acos(top[2].item())) == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("equidistant", ()), ("opencv", (0.1,)), ("pinhole", (0.1,)), ("fisheye624", (0.0,) * 4)],
)
def test_bad_cameras_are_refused(model, coefficients):
    with pytest.raises(WearcapError):
        Camera(model, 640, 480, 500.0, 500.0, 320.0, 240.0, coefficients)


def test_zero_focal_length_is_refused():
    with pytest.raises(WearcapError, match="positive"):
        Camera("pinhole", 640, 480, 0.0, 500.0, 320.0, 240.0)
