import importlib.util
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from data_prep import aria_vrs
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.devices.aria_mps import nominal_T_aria_cpf
from wearcap.io.formats.video import read_frames

needs_aria = pytest.mark.skipif(
    importlib.util.find_spec("projectaria_tools") is None, reason='needs the extra: pip install "wearcap[aria]"'
)


def test_without_the_extra_the_message_names_how_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(aria_vrs, "data_provider", None)
    for read in (aria_vrs.read_device, lambda path: aria_vrs.extract_video(path, tmp_path / "a.mp4")):
        with pytest.raises(WearcapError, match=r'pip install "wearcap\[aria\]"'):
            read(tmp_path / "a.vrs")


class Pose:
    """A sensor's pose, as the library's SE3 gives it."""

    def __init__(self, R=None, t=(0.0, 0.0, 0.0)):
        self.R, self.t = np.eye(3) if R is None else R, t

    def to_matrix(self):
        return np.block([[self.R, np.array(self.t)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


class Calibration:
    """A camera: the sensor itself, a pinhole, or a pinhole turned upright."""

    def __init__(self, size=64, focal=35.0, pose=Pose()):
        self.size, self.focal, self.pose = size, focal, pose

    def get_transform_device_camera(self):
        return self.pose

    def get_focal_lengths(self):
        return self.focal, self.focal

    def get_principal_point(self):
        return (self.size - 1) / 2, (self.size - 1) / 2


class Recorder:
    """Stands in for projectaria-tools: a device with one camera on its side, whose n-th picture shows n above a dark foot."""

    def __init__(self, frames: int = 12, start_ns: int = 5_000_000_000):
        self.stamps = [start_ns + 33_333_333 * i for i in range(frames)]

    def create_vrs_data_provider(self, path):
        return self

    def get_device_calibration(self):
        return self

    def get_camera_labels(self):
        return ["camera-rgb"]

    def get_imu_labels(self):
        return []

    def get_transform_device_sensor(self, label):
        return Pose()

    def get_transform_device_cpf(self):
        T = nominal_T_aria_cpf()
        return Pose(T.R.double().numpy(), T.t.tolist())

    def get_camera_calib(self, label):
        return Calibration()

    def get_stream_id_from_label(self, label):
        return label if label == "camera-rgb" else None

    def get_timestamps_ns(self, stream, domain):
        return self.stamps

    def get_image_data_by_index(self, stream, index):
        lying = np.full((64, 64, 3), 20 * index + 10, np.uint8)
        lying[:, 48:] = 0  # the scene's foot is at the sensor's right
        return SimpleNamespace(to_numpy_array=lambda: lying), None

    def get_linear_camera_calibration(self, width, height, focal, label, pose):
        return Calibration(width, focal, pose)

    def distort_by_calibration(self, picture, wanted, source):
        return picture.repeat(wanted.size // 64, 0).repeat(wanted.size // 64, 1)

    def rotate_camera_calib_cw90deg(self, pinhole):
        return pinhole


@pytest.fixture
def recorder(monkeypatch, tmp_path) -> Recorder:
    fake = Recorder()
    for name in ("data_provider", "aria_calibration"):
        monkeypatch.setattr(aria_vrs, name, fake, raising=False)
    monkeypatch.setattr(aria_vrs, "TimeDomain", SimpleNamespace(DEVICE_TIME=0), raising=False)
    (tmp_path / "a.vrs").write_bytes(b"a stand-in is read instead")
    return fake


def test_a_video_holds_the_pictures_of_the_time_that_is_wanted(recorder, tmp_path):
    stream = aria_vrs.extract_video(
        tmp_path / "a.vrs", tmp_path / "videos" / "a.mp4", between=(5.03, 5.17), size=64, focal=35.0
    )
    assert stream.video == "videos/a.mp4"
    assert stream.timestamps.tolist() == pytest.approx([5.033333, 5.066667, 5.1, 5.133333, 5.166667], abs=1e-5)
    assert (stream.camera.width, stream.camera.fx, stream.camera.cx) == (64, 35.0, 31.5)
    pictures = [picture for _, picture in read_frames(tmp_path / stream.video)]
    assert [round(picture[:40].mean() / 20 - 0.5) for picture in pictures] == [1, 2, 3, 4, 5]
    assert all(picture[52:].mean() < 8 for picture in pictures), "turned upright, the foot is below"
    with pytest.raises(WearcapError, match=r"0 pictures of 'camera-rgb' in the time"):
        aria_vrs.extract_video(tmp_path / "a.vrs", tmp_path / "b.mp4", between=(50.0, 60.0), size=64)
    assert not (tmp_path / "b.mp4").exists()
    with pytest.raises(WearcapError, match=r"no camera 'camera-x'.*camera-rgb"):
        aria_vrs.extract_video(tmp_path / "a.vrs", tmp_path / "b.mp4", label="camera-x")


@needs_aria
def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.vrs").write_bytes(b"no recording")
    with pytest.raises(WearcapError, match="not a readable VRS"):
        aria_vrs.read_device(tmp_path / "a.vrs")
    with pytest.raises(WearcapError, match="no such file"):
        aria_vrs.read_device(tmp_path / "b.vrs")


@needs_aria
@pytest.mark.real
def test_real_calibration_is_the_nominal_one(real_data):
    """The pupil frame is CAD: our nominal pose is within 3 mm and 0.01° of what two real devices carry."""
    for file in ("aria_adt_sample/raw/video.vrs", "aria_everyday_sample/recording.vrs"):
        T_aria_cpf, _ = aria_vrs.read_device(real_data / file)
        assert rotation.geodesic(T_aria_cpf.R, nominal_T_aria_cpf().R) < 2e-4
        assert (T_aria_cpf.t - nominal_T_aria_cpf().t).norm() < 0.003


@needs_aria
@pytest.mark.real
def test_real_images_are_upright(real_data, tmp_path):
    path = real_data / "aria_adt_sample" / "raw" / "video.vrs"
    stream = aria_vrs.extract_video(path, tmp_path / "head.mp4", size=256, focal=140.0)
    assert [picture.shape for _, picture in read_frames(tmp_path / "head.mp4")] == [(256, 256, 3)] * 3
    meta = json.loads((real_data / "aria_adt_sample" / "extracted" / "meta.json").read_text())
    assert stream.timestamps[0].item() == pytest.approx(meta["frames"][0]["timestamp_ns"] * 1e-9, abs=1e-6)
    assert stream.R_head_cam[0, 2] > 0.9, "looks ahead"
    assert stream.R_head_cam[2, 1] < -0.9, "the image's y axis points down the head"
    assert torch.linalg.det(stream.R_head_cam) == pytest.approx(1.0, abs=1e-4)
