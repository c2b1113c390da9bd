"""A rig's folder: written, read back, and refused where it is damaged."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.depth_rig import read_depth, read_depth_rig, read_depths, write_depth, write_depth_rig

LENS = Camera("pinhole", 16, 12, 12.0, 12.0, 7.5, 5.5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = np.random.default_rng(0).integers(800, 4000, (2, 3, 12, 16)).astype(np.uint16)
    pose = Rigid(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))
    write_depth_rig(
        tmp_path,
        {"k0": (LENS, pose), "k1": (LENS, pose)},
        {"k0": images[0, :1], "k1": images[1, :1]},
        {"k0": images[0], "k1": images[1]},
        np.array([0.0, 1 / 30, 2 / 30]),
    )
    return tmp_path


def test_what_was_written_is_read(folder: Path):
    rig = read_depth_rig(folder)
    images = np.random.default_rng(0).integers(800, 4000, (2, 3, 12, 16)).astype(np.uint16)
    assert [camera.name for camera in rig.cameras] == ["k0", "k1"]
    assert np.allclose(rig.timestamps, [0, 1 / 30, 2 / 30], atol=1e-6)
    for camera, expected in zip(rig.cameras, images):
        assert np.array_equal(read_depths(camera.depth, camera.camera), expected)
        assert np.array_equal(read_depths(camera.empty, camera.camera), expected[:1])
        assert torch.equal(camera.T_world_cam.t, torch.tensor([1.0, 2.0, 3.0]))
    assert read_depths((), LENS).shape == (0, 12, 16)


def test_a_folder_that_no_system_can_have_is_named(folder: Path):
    path = folder / "photos.json"
    path.write_text(path.read_text().replace('"k1"', f'"{"k" * 70_000}"'))
    with pytest.raises(WearcapError, match="File name too long"):
        read_depth_rig(folder)


def test_a_camera_without_empty_frames_or_with_frames_missing_is_named(folder: Path):
    (folder / "k1" / "depth" / "000001.png").unlink()
    with pytest.raises(WearcapError, match="k1.*2 depth images for 3 times"):
        read_depth_rig(folder)
    (folder / "k0" / "empty" / "000000.png").unlink()
    with pytest.raises(WearcapError, match="k0.*no images of the empty scene"):
        read_depth_rig(folder)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.full((12, 16), 100, np.uint8), "mode L"),
        (np.full((12, 16, 3), 100, np.uint8), "mode RGB"),
        (np.full((10, 16), 1500, np.uint16), "16x10 pixels"),
        (np.full((12, 16), 2, np.uint16), "middle depth is 2"),
        (np.full((12, 16), 65000, np.uint16), "middle depth is 65000"),
    ],
)
def test_images_that_are_no_depth_of_this_camera_are_refused(tmp_path: Path, image: np.ndarray, message: str):
    Image.fromarray(image).save(tmp_path / "depth.png")
    with pytest.raises(WearcapError, match=message):
        read_depth(tmp_path / "depth.png", LENS)


def test_damaged_files_are_refused(tmp_path: Path):
    write_depth(tmp_path / "depth.png", np.full((12, 16), 1500, np.uint16))
    content = (tmp_path / "depth.png").read_bytes()
    for cut in (0, 10, len(content) // 2):
        (tmp_path / "cut.png").write_bytes(content[:cut])
        with pytest.raises(WearcapError):
            read_depth(tmp_path / "cut.png", LENS)
    with pytest.raises(WearcapError):
        read_depth(tmp_path / "missing.png", LENS)


@pytest.mark.parametrize("text", ["0.0\nfast\n0.2\n", "0.0\n0.0\n0.1\n", "0.0\nnan\n0.1\n"])
def test_bad_times_are_refused(folder: Path, text: str):
    (folder / "timestamps.txt").write_text(text)
    with pytest.raises(WearcapError, match="timestamps.txt"):
        read_depth_rig(folder)
