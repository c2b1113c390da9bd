import importlib.util
import json

import pytest
import torch
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io import aria_vrs
from wearcap.io.aria_mps import nominal_T_aria_cpf

needs_aria = pytest.mark.skipif(
    importlib.util.find_spec("projectaria_tools") is None,
    reason='needs the extra: pip install "wearcap[aria]"',
)


def test_without_the_extra_the_message_says_how_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(aria_vrs, "data_provider", None)
    for read in (aria_vrs.read_device, aria_vrs.read_imus, aria_vrs.timecode_offset_s):
        with pytest.raises(WearcapError, match=r'pip install "wearcap\[aria\]"'):
            read(tmp_path / "a.vrs")


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
    sizes = set()
    for file in ("aria_adt_sample/raw/video.vrs", "aria_everyday_sample/recording.vrs"):
        device = aria_vrs.read_device(real_data / file)
        sizes.add(device.subtype)
        assert rotation.geodesic(device.T_aria_cpf.R, nominal_T_aria_cpf().R) < 2e-4
        assert (device.T_aria_cpf.t - nominal_T_aria_cpf().t).norm() < 0.003
    assert sizes == {"DVT-S", "DVT-L"}


@needs_aria
@pytest.mark.real
def test_real_imus_feel_gravity_upwards(real_data):
    """Both sensors of a worn device: 9.8 m/s², up in head axes, the same in both."""
    streams = aria_vrs.read_imus(real_data / "aria_adt_sample" / "raw" / "video.vrs")
    assert set(streams) == {"imu-left", "imu-right"}
    ups = {}
    for label, imu in streams.items():
        assert imu.acc_imu is not None
        assert imu.R_joint_imu is not None
        ups[label] = imu.acc_imu.mean(0) @ imu.R_joint_imu.T
        assert ups[label].norm() == pytest.approx(9.81, abs=0.4)
        assert ups[label][2] > 7, "the wearer looks down at a bowl, not further than 45°"
    assert (ups["imu-left"] - ups["imu-right"]).norm() < 0.4


@needs_aria
@pytest.mark.real
def test_real_images_are_upright(real_data, tmp_path):
    path = real_data / "aria_adt_sample" / "raw" / "video.vrs"
    stream = aria_vrs.extract_images(path, tmp_path, size=256, focal=140.0)
    assert stream.image_files == ("camera-rgb/000000.jpg", "camera-rgb/000001.jpg", "camera-rgb/000002.jpg")
    assert Image.open(tmp_path / stream.image_files[0]).size == (256, 256)
    meta = json.loads((real_data / "aria_adt_sample" / "extracted" / "meta.json").read_text())
    assert stream.timestamps[0].item() == pytest.approx(meta["frames"][0]["timestamp_ns"] * 1e-9, abs=1e-6)
    assert stream.R_head_cam[0, 2] > 0.9, "looks ahead"
    assert stream.R_head_cam[2, 1] < -0.9, "the image's y axis points down the head"
    assert torch.linalg.det(stream.R_head_cam) == pytest.approx(1.0, abs=1e-4)
