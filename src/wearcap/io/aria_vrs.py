"""Project Aria's VRS recordings: calibration, inertial sensors, images (needs the extra: `pip install "wearcap[aria]"`).

Timestamps are the device's clock, the one that MPS trajectories carry. Frames as in io/aria_mps.py.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE
from wearcap.recording import CameraStream, ImuStream

try:
    from projectaria_tools.core import calibration as aria_calibration
    from projectaria_tools.core import data_provider
    from projectaria_tools.core.sensor_data import TimeDomain
except ImportError:
    data_provider = None

IMU_LABELS = ("imu-left", "imu-right")


@dataclass(frozen=True)
class AriaDevice:
    """A recording's own calibration."""

    T_aria_cpf: Rigid
    """Central pupil frame in the device frame; give it to `read_mps` or `head_stream` in place of the nominal one."""
    T_aria_sensor: dict[str, Rigid]
    """Poses of cameras (OpenCV axes) and IMUs by label: "camera-rgb", "camera-slam-left", "imu-right" …"""
    subtype: str
    """"DVT-S" or "DVT-L": the size of the glasses."""


def read_device(path: str | Path) -> AriaDevice:
    """Calibration of a VRS recording. Raises WearcapError when the extra is missing or the file is no VRS."""
    device = _open(path).get_device_calibration()
    if device is None:
        raise WearcapError("holds no calibration", where=path, expected="a recording of Aria glasses")
    labels = [*device.get_camera_labels(), *device.get_imu_labels()]
    poses = {label: device.get_transform_device_sensor(label) for label in labels}
    return AriaDevice(
        _rigid(device.get_transform_device_cpf()),
        {label: _rigid(pose) for label, pose in poses.items() if pose is not None}, device.get_device_subtype(),
    )  # fmt: skip


def read_imus(path: str | Path, T_head_device: Rigid | None = None) -> dict[str, ImuStream]:
    """Rectified accelerometer and gyroscope streams by label ("imu-left", "imu-right"), worn on the head joint.

    `T_head_device` is the glasses' seat on the head joint; by default the assumed one of io/aria_mps.py. Samples that
    the device marks invalid are left out. Raises WearcapError as `read_device` does.
    """
    provider, device = _open(path), read_device(path)
    R_head_aria = (T_head_device or T_HEAD_DEVICE).R @ R_CPF_DEVICE.T @ device.T_aria_cpf.R.T
    streams = {}
    for label in IMU_LABELS:
        stream = provider.get_stream_id_from_label(label)
        if stream is None or not provider.get_num_data(stream):
            continue
        rectify = provider.get_device_calibration().get_imu_calib(label)
        samples = [provider.get_imu_data_by_index(stream, i) for i in range(provider.get_num_data(stream))]
        samples = [sample for sample in samples if sample.accel_valid and sample.gyro_valid]
        acc = np.array([rectify.raw_to_rectified_accel(np.array(sample.accel_msec2)) for sample in samples])
        gyro = np.array([rectify.raw_to_rectified_gyro(np.array(sample.gyro_radsec)) for sample in samples])
        streams[label] = ImuStream(
            torch.tensor([sample.capture_timestamp_ns * 1e-9 for sample in samples], dtype=torch.float64), "head",
            acc_imu=torch.tensor(acc, dtype=torch.float32).reshape(-1, 3),
            gyro_imu=torch.tensor(gyro, dtype=torch.float32).reshape(-1, 3),
            R_joint_imu=R_head_aria @ device.T_aria_sensor[label].R,
        )  # fmt: skip
    return streams


def extract_images(
    path: str | Path,
    folder: str | Path,
    *,
    label: str = "camera-rgb",
    size: int = 1024,
    focal: float = 560.0,
    T_head_device: Rigid | None = None,
) -> CameraStream:
    """Write a camera's images, undistorted to a pinhole of `size` × `size` px and `focal` px and turned upright, as JPEGs.

    Files are named `<label>/<index>.jpg` under `folder`, and so in the stream. Raises WearcapError as `read_device`
    does, and for a camera that the recording lacks.
    """
    provider, device = _open(path), read_device(path)
    stream = provider.get_stream_id_from_label(label)
    if stream is None or label not in device.T_aria_sensor:
        raise WearcapError(
            f"no camera {label!r}", where=path, expected=f"one of {', '.join(device.T_aria_sensor)}"
        )
    original = provider.get_device_calibration().get_camera_calib(label)
    pinhole = aria_calibration.get_linear_camera_calibration(
        size, size, focal, label, original.get_transform_device_camera()
    )
    upright = aria_calibration.rotate_camera_calib_cw90deg(pinhole)
    (Path(folder) / label).mkdir(parents=True, exist_ok=True)
    times, names = [], []
    for i in range(provider.get_num_data(stream)):
        image, record = provider.get_image_data_by_index(stream, i)
        flat = aria_calibration.distort_by_calibration(image.to_numpy_array(), pinhole, original)
        names.append(f"{label}/{i:06d}.jpg")
        times.append(record.capture_timestamp_ns * 1e-9)
        with atomic_path(Path(folder) / names[-1]) as temporary:
            Image.fromarray(np.ascontiguousarray(np.rot90(flat, -1))).save(temporary, quality=92)
    T_head_aria = (
        (T_head_device or T_HEAD_DEVICE) @ Rigid(R_CPF_DEVICE.T, torch.zeros(3)) @ device.T_aria_cpf.inverse()
    )
    T_head_cam = T_head_aria @ _rigid(upright.get_transform_device_camera())
    (fx, fy), (cx, cy) = upright.get_focal_lengths(), upright.get_principal_point()
    camera = Camera("pinhole", size, size, float(fx), float(fy), float(cx), float(cy))
    return CameraStream(
        torch.tensor(times, dtype=torch.float64), camera, T_head_cam.R, T_head_cam.t, tuple(names)
    )


def timecode_offset_s(path: str | Path) -> float:
    """Device clock minus time code (s) at the recording's start: what Nymeria's suit timestamps need added.

    Raises WearcapError as `read_device` does, and for a recording without time code.
    """
    provider = _open(path)
    device_ns = provider.get_first_time_ns_all_streams(TimeDomain.DEVICE_TIME)
    if not provider.supports_time_domain(provider.get_all_streams()[0], TimeDomain.TIME_CODE):
        raise WearcapError("carries no time code", where=path)
    return (device_ns - provider.convert_from_device_time_to_timecode_ns(device_ns)) * 1e-9


def _open(path: str | Path):
    """A data provider of projectaria-tools, or a WearcapError that says what is missing."""
    if data_provider is None:
        raise WearcapError("reading VRS recordings needs projectaria-tools", where=path,
                           fix='Install it with `pip install "wearcap[aria]"` (about 1 GB).')  # fmt: skip
    if not Path(path).is_file():
        raise WearcapError("no such file", where=path)
    provider = data_provider.create_vrs_data_provider(str(path))
    if provider is None:
        raise WearcapError(
            "not a readable VRS recording", where=path, expected="a complete .vrs file of Aria glasses"
        )
    return provider


def _rigid(pose) -> Rigid:
    """A Sophus SE3 as ours."""
    return Rigid.from_matrix(torch.tensor(pose.to_matrix(), dtype=torch.float32))
