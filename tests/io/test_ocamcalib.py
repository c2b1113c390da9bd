"""OCamCalib's lenses in NavVis' XML: against the direct polynomial, row and column kept apart, damage named."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from ocam_files import lens, xml_of

from hostile import fuzz, mutated
from wearcap.errors import WearcapError
from wearcap.io.formats.ocamcalib import OCamModel, read_sensor_frame


def direct_rays(model: OCamModel, pixels: np.ndarray) -> np.ndarray:
    """Scaramuzza's image-to-world map, in OpenCV's axes."""
    c, d, e = model.affine
    offset = np.stack([pixels[:, 1] - model.row, pixels[:, 0] - model.column])
    u, v = np.linalg.inv([[c, d], [e, 1.0]]) @ offset
    w = np.polynomial.polynomial.polyval(np.hypot(u, v), model.pol)
    rays = np.stack([v, u, -w], 1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def pixel_grid(model: OCamModel) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, model.width - 1, 25), np.linspace(0, model.height - 1, 19))
    return np.stack([x.ravel(), y.ravel()], 1)


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_the_camera_sees_along_the_direct_polynomial(scale):
    model = lens(scale)
    camera, pixels = model.camera(), pixel_grid(model)
    rays = camera.unproject(torch.from_numpy(pixels)).numpy()
    off_px = np.linalg.norm(rays - direct_rays(model, pixels), axis=1) * camera.fx
    assert off_px.max() < 0.01
    again, valid = camera.project(torch.from_numpy(direct_rays(model, pixels)))
    assert valid.all()
    assert np.abs(again.numpy() - pixels).max() < 0.01


def test_its_inverse_polynomial_agrees(tmp_path):
    """world2cam as OCamCalib evaluates it, against `project`."""
    model = lens()
    points = np.random.default_rng(0).normal(size=(200, 3)) * (1, 1, 0.3) + (0, 0, 0.5)
    u, v, w = points[:, 1], points[:, 0], -points[:, 2]
    across = np.hypot(u, v)
    rho = np.polynomial.polynomial.polyval(np.arctan(w / across), model.invpol)
    c, d, e = model.affine
    row = (c * u + d * v) / across * rho + model.row
    column = (e * u + v) / across * rho + model.column
    pixels, valid = model.camera().project(torch.from_numpy(points))
    assert valid.sum() > 50
    error = np.abs(pixels.numpy() - np.stack([column, row], 1))[valid.numpy()]
    assert error.max() < 0.1


def test_the_lenses_of_an_xml(tmp_path):
    models = {"cam0": lens(), "cam1": replace(lens(), row=1709.98)}
    (tmp_path / "sensor_frame.xml").write_text(xml_of(models))
    assert read_sensor_frame(tmp_path / "sensor_frame.xml") == models


def test_a_smaller_picture_of_the_same_lens():
    small, large = lens(0.25).camera(), lens().camera()
    ray = torch.tensor([0.4, -0.3, 0.8], dtype=torch.float64)
    scaled = large.scaled(small.width, small.height)
    assert torch.allclose(scaled.project(ray)[0], small.project(ray)[0], atol=0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row": 2289.0, "column": 4600.0}, "is outside the image"),
        ({"pol": (1983.0, 0.0, 2e-4)}, "begins with 1983"),
        ({"pol": (-1983.0, 0.0, -2e-2)}, "turns back"),
        ({"invpol": tuple(reversed(lens().invpol))}, "two polynomials differ"),
        ({"affine": (0.0, 0.0, 0.0)}, "affine parameters"),
        ({"width": 0}, "image of 0x"),
    ],
)
def test_a_model_of_no_lens_is_refused(change, message):
    with pytest.raises(WearcapError, match=message):
        replace(lens(), **change).camera()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[: len(text) // 2], "broken XML"),
        (lambda text: text.replace("<cx>", "<cz>").replace("</cx>", "</cz>"), "no cx"),
        (lambda text: text.replace("<Width>4592", "<Width>wide"), "Width .'wide' is no finite number"),
        (lambda text: text.replace("cam2world", "camtoworld"), "cam2world with 0"),
        (lambda text: text.replace("CameraModel", "Camera"), "no cameras"),
        (lambda text: text.replace("<SensorFrame>", '<!DOCTYPE x [<!ENTITY a "b">]><SensorFrame>'), "document type"),
        (lambda text: text.replace("cam1", "cam0"), "twice"),
    ],
)
def test_damaged_xml_is_named(damage, message, tmp_path):
    (tmp_path / "sensor_frame.xml").write_text(damage(xml_of({"cam0": lens(), "cam1": lens()})))
    with pytest.raises(WearcapError, match=message):
        read_sensor_frame(tmp_path / "sensor_frame.xml")


@fuzz
@given(damaged=mutated(xml_of({"cam0": lens()})))
def test_fuzzed_xml(damaged, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "sensor_frame.xml"
    path.write_text(damaged)
    with contextlib.suppress(WearcapError):
        [model.camera() for model in read_sensor_frame(path).values()]
