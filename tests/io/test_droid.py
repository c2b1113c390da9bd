"""DROID-SLAM's reconstructions, written here as its demo saves them; hostile files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hostile import fuzz, mutated_bytes
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wearcap.errors import WearcapError
from wearcap.io.formats.droid import DroidPoints, read_droid

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def reconstruction(folder: Path, *, upsampled: bool = True, **changes) -> tuple[np.ndarray, Rotation]:
    """A camera that looks along the world's z at a wall 4 units away, steps sideways and turns a little.

    Returns positions and orientations of the camera in the world.
    """
    count = 6
    t = np.stack([0.1 * np.arange(count), np.zeros(count), 0.05 * np.arange(count)], 1)
    R = Rotation.from_rotvec(np.deg2rad(2) * np.arange(count)[:, None] * [[0, 1, 0]])
    width, height, focal = (WIDTH, HEIGHT, FOCAL) if upsampled else (WIDTH // 8, HEIGHT // 8, FOCAL / 8)
    rows, columns = np.mgrid[:height, :width]
    ray = np.stack([(columns - width / 2) / focal, (rows - height / 2) / focal, np.ones((height, width))], -1)
    forward = np.einsum("nij,hwj->nhwi", R.as_matrix(), ray)[..., 2]
    depth = (4.0 - t[:, 2, None, None]) / forward
    T_cam_world = R.inv()
    arrays = {
        "poses": np.concatenate([-T_cam_world.apply(t), T_cam_world.as_quat()], 1).astype(np.float32),
        "tstamps": np.array([0, 4, 8, 11, 15, 20], np.float32),
        "disps": (1 / depth).astype(np.float32),
        "intrinsics": np.tile([FOCAL / 8, FOCAL / 8, WIDTH / 16, HEIGHT / 16], (count, 1)).astype(np.float32),
        "images": np.zeros((count, 3, HEIGHT, WIDTH), np.uint8),
    } | changes
    folder.mkdir(exist_ok=True)
    for name, array in arrays.items():
        if array is not None:
            np.save(folder / f"{name}.npy", array)
    return t, R


@pytest.mark.parametrize("upsampled", [True, False])
def test_poses_are_turned_into_the_world(tmp_path, upsampled):
    t, R = reconstruction(tmp_path, upsampled=upsampled)
    track = read_droid(tmp_path, stamps_per_s=10.0)
    np.testing.assert_allclose(track.T_world_cam.t_world_body.numpy(), t, atol=1e-6)
    np.testing.assert_allclose(track.T_world_cam.R_world_body.numpy(), R.as_matrix(), atol=1e-6)
    assert track.T_world_cam.timestamps.tolist() == pytest.approx([0, 0.4, 0.8, 1.1, 1.5, 2.0])
    scale = 1 if upsampled else 8
    assert (track.camera.width, track.camera.fx, track.camera.cx) == (WIDTH // scale, FOCAL / scale, WIDTH / 2 / scale)


def test_points_lie_on_the_wall_and_know_when_they_were_seen(tmp_path):
    reconstruction(tmp_path)
    points = read_droid(tmp_path, 10.0).points
    assert len(points.points_world) > 500
    assert (points.points_world[:, 2] - 4).abs().max() < 1e-4
    assert 0 < points.confidence.min() <= points.confidence.max() <= 1
    assert set(points.first_seen.tolist()) <= set(np.float32([0, 4, 8, 11, 15, 20]) / 10.0)
    assert read_droid(tmp_path, 10.0, None).points is None


def test_what_no_neighbour_confirms_is_left_out(tmp_path):
    """A block of one keyframe at the wrong depth, and pixels far away."""
    reconstruction(tmp_path)
    disparity = np.load(tmp_path / "disps.npy")
    disparity[2, 16:32, 16:32] *= 1.5
    disparity[:, :8] = 1e-3
    reconstruction(tmp_path, disps=disparity)
    points = read_droid(tmp_path, 10.0, DroidPoints(stride=2)).points
    assert len(points.points_world) > 500
    assert (points.points_world[:, 2] - 4).abs().max() < 1e-4


FAULTS = {
    "no poses": ({"poses": None}, "poses.npy: no such file"),
    "wrong columns": ({"poses": np.zeros((6, 6))}, r"'poses' has shape \(6, 6\)"),
    "no keyframes": ({"poses": np.zeros((0, 7))}, "no keyframes"),
    "other count": ({"tstamps": np.arange(5.0)}, "'tstamps' has shape"),
    "nan": ({"poses": np.full((6, 7), np.nan)}, "NaN"),
    "no quaternion": ({"poses": np.ones((6, 7))}, "norm 2.0000"),
    "still stamps": ({"tstamps": np.zeros(6)}, "timestamps that rise"),
    "objects": ({"tstamps": np.array([None] * 6)}, "holds Python objects"),
    "text": ({"tstamps": np.array(["a"] * 6)}, "real numbers"),
    "disparities": ({"disps": np.ones((6, 48))}, r"shape \(6, 48\)"),
    "whole disparities": ({"disps": np.ones((6, 48, 64), int)}, "floats of shape"),
    "nan disparities": ({"disps": np.full((6, 48, 64), np.nan)}, "disparity is NaN"),
    "other camera": ({"intrinsics": np.ones((6, 4))}, "principal point"),
    "cameras": ({"intrinsics": np.arange(24.0).reshape(6, 4)}, "one camera"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_folder_is_named(tmp_path, fault):
    changes, message = FAULTS[fault]
    reconstruction(tmp_path, **changes)
    with pytest.raises(WearcapError, match=message):
        read_droid(tmp_path, 10.0)


def test_a_rate_of_zero_is_refused(tmp_path):
    reconstruction(tmp_path)
    with pytest.raises(WearcapError, match="stamps per second"):
        read_droid(tmp_path, 0.0)


@fuzz
@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("droid")
    reconstruction(folder)
    path = folder / f"{data.draw(st.sampled_from(['poses', 'tstamps', 'disps', 'intrinsics']))}.npy"
    path.write_bytes(data.draw(mutated_bytes(path.read_bytes())))
    try:
        track = read_droid(folder, 10.0, DroidPoints(stride=8))
    except WearcapError:
        return
    assert torch.isfinite(track.T_world_cam.t_world_body).all()
    assert torch.isfinite(track.points.points_world).all()
