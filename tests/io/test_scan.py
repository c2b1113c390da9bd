"""Scans: what a dense metric cloud is, and what is refused."""

import numpy as np
import pytest

from wearcap.errors import WearcapError
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.io.formats.scene_folder import read_scan


def room(spacing_m: float = 0.03, side_m: float = 6.0) -> np.ndarray:
    """Floor and one wall, evenly sampled."""
    ticks = np.arange(0, side_m, spacing_m)
    a, b = (axis.ravel() for axis in np.meshgrid(ticks, ticks))
    floor, wall = np.stack([a, b, 0 * a], 1), np.stack([a, 0 * a, b * 0.4], 1)
    return np.concatenate([floor, wall]).astype(np.float32)


def test_a_scan_comes_back(tmp_path):
    points = room()
    colors = np.random.default_rng(0).integers(0, 255, points.shape, dtype=np.uint8)
    write_ply(Ply(points, colors), tmp_path / "a.ply")
    scan = read_scan(tmp_path / "a.ply")
    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_array_equal(scan.colors, colors)


@pytest.mark.parametrize("spacing_m", [0.005, 0.03, 0.2])
def test_density_alone_tells_millimetres(spacing_m, tmp_path):
    points = room(spacing_m, 2.0 if spacing_m < 0.01 else 10.0)
    write_ply(Ply(points), tmp_path / "a.ply")
    assert len(read_scan(tmp_path / "a.ply").points) == len(points)
    write_ply(Ply(points * 1000), tmp_path / "a.ply")
    with pytest.raises(WearcapError, match="millimetres"):
        read_scan(tmp_path / "a.ply")


def test_extent_alone_tells_millimetres(tmp_path):
    points = np.random.default_rng(0).uniform(0, [9000, 9000, 2500], (500, 3)).astype(np.float32)
    write_ply(Ply(points), tmp_path / "a.ply")
    with pytest.raises(WearcapError, match="millimetres"):
        read_scan(tmp_path / "a.ply")


def test_a_sparse_or_tiny_cloud_is_no_fault(tmp_path):
    write_ply(Ply(np.eye(3, dtype=np.float32) * 30), tmp_path / "a.ply")
    assert len(read_scan(tmp_path / "a.ply").points) == 3


@pytest.mark.parametrize(
    ("points", "name", "message"),
    [
        (room()[:0], "a.ply", "no points"),
        (room() * 1000, "a.ply", "metres_per_unit=0.001"),
        (room(), "a.obj", "a .ply or .pcd file"),
    ],
)
def test_refusals(points, name, message, tmp_path):
    write_ply(Ply(points.astype(np.float32)), tmp_path / name)
    with pytest.raises(WearcapError, match=message):
        read_scan(tmp_path / name)


def test_millimetres_are_read_where_the_unit_is_given(tmp_path):
    write_ply(Ply((room() * 1000).astype(np.float32)), tmp_path / "a.ply")
    np.testing.assert_allclose(read_scan(tmp_path / "a.ply", metres_per_unit=0.001).points, room(), atol=1e-4)


def test_a_sparse_scan_is_read_where_its_unit_is_given(tmp_path):
    sparse = np.random.default_rng(0).uniform(0, [300, 300, 20], (2000, 3)).astype(np.float32)
    write_ply(Ply(sparse), tmp_path / "a.ply")
    with pytest.raises(WearcapError, match="1 for one that is sparse"):
        read_scan(tmp_path / "a.ply")
    assert len(read_scan(tmp_path / "a.ply", metres_per_unit=1).points) == 2000
