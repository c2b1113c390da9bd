"""Project Aria's VRS recordings: calibration, inertial sensors, images (needs the extra: `pip install "wearcap[aria]"`).

Timestamps are the device's clock, the one that MPS trajectories carry. Frames as in io/devices/aria_mps.py.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from PIL import Image
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE
from wearcap.io.formats.bounded import file_size
from wearcap.io.formats.video import write_frames
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
    """Factory calibration stored in a recording."""

    T_aria_cpf: Rigid
    """Central pupil frame in the device frame; pass it to `read_mps` or `head_stream` in place of the nominal one."""
    T_aria_sensor: dict[str, Rigid]
    """Poses of cameras (OpenCV axes) and IMUs in the device frame by label: "camera-rgb", "camera-slam-left", "imu-right" …"""
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
        {label: _rigid(pose) for label, pose in poses.items() if pose is not None},
        device.get_device_subtype(),
    )


def read_imus(path: str | Path, T_head_device: Rigid | None = None) -> dict[str, ImuStream]:
    """Rectified accelerometer and gyroscope streams by label ("imu-left", "imu-right"), worn on the head joint.

    `T_head_device` is the pose of the glasses on the head joint; by default the assumed one of io/devices/aria_mps.py. Samples that
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
            torch.tensor([sample.capture_timestamp_ns * 1e-9 for sample in samples], dtype=torch.float64),
            "head",
            acc_imu=torch.tensor(acc, dtype=torch.float32).reshape(-1, 3),
            gyro_imu=torch.tensor(gyro, dtype=torch.float32).reshape(-1, 3),
            R_joint_imu=R_head_aria @ device.T_aria_sensor[label].R,
        )
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
    view = _UprightView(path, label, size, focal)
    (Path(folder) / label).mkdir(parents=True, exist_ok=True)
    times, names = view.times(), []
    for i in range(len(times)):
        names.append(f"{label}/{i:06d}.jpg")
        with atomic_path(Path(folder) / names[-1]) as temporary:
            Image.fromarray(view.picture(i)).save(temporary, quality=92)
    return replace(view.stream(times, T_head_device), image_files=tuple(names))


def extract_video(
    path: str | Path,
    file: Path,
    *,
    between: tuple[float, float] | None = None,
    label: str = "camera-rgb",
    size: int = 256,
    focal: float = 140.0,
    T_head_device: Rigid | None = None,
) -> CameraStream:
    """As `extract_images`, but into one MP4, which the stream names by its folder's name and its own.

    `between` keeps the frames from one device time to another (s). Raises WearcapError as `extract_images` does, and
    when fewer than two frames are left.
    """
    view = _UprightView(path, label, size, focal, finer=4)
    times = view.times()
    first, stop = 0, len(times)
    if between is not None:
        first, stop = np.searchsorted(times.numpy(), between).tolist()
    if stop - first < 2:
        raise WearcapError(
            f"{stop - first} pictures of {label!r} in the time that is wanted",
            where=path,
            expected="a recording of the same time",
        )
    fps = 1 / times[first:stop].diff().median().item()
    write_frames(file, (view.picture(i) for i in range(first, stop)), fps)
    return replace(view.stream(times[first:stop], T_head_device), video=f"{file.parent.name}/{file.name}")


class _UprightView:
    """A camera's pictures, undistorted to a square pinhole and turned upright: Aria's sensors are mounted on their side."""

    def __init__(self, path: str | Path, label: str, size: int, focal: float, finer: int = 1):
        """`finer`: pictures are drawn so many times larger and then averaged, against aliasing where they are small."""
        self.provider, self.device, self.label, self.size = _open(path), read_device(path), label, size
        self.source = self.provider.get_stream_id_from_label(label)
        if self.source is None or label not in self.device.T_aria_sensor:
            raise WearcapError(
                f"no camera {label!r}", where=path, expected=f"one of {', '.join(self.device.T_aria_sensor)}"
            )
        self.original = self.provider.get_device_calibration().get_camera_calib(label)
        self.pinhole, self._drawn = (
            aria_calibration.get_linear_camera_calibration(
                size * scale, size * scale, focal * scale, label, self.original.get_transform_device_camera()
            )
            for scale in (1, finer)
        )
        self._finer = finer

    def times(self) -> Float64[Tensor, "time"]:
        """Capture time of each picture (s, the device's clock)."""
        stamps = self.provider.get_timestamps_ns(self.source, TimeDomain.DEVICE_TIME)
        return torch.tensor(stamps, dtype=torch.int64).double() * 1e-9

    def picture(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        image, _ = self.provider.get_image_data_by_index(self.source, index)
        flat = aria_calibration.distort_by_calibration(image.to_numpy_array(), self._drawn, self.original)
        upright = Image.fromarray(np.ascontiguousarray(np.rot90(flat, -1))).convert("RGB")
        return np.asarray(upright.reduce(self._finer))

    def stream(self, times: Float64[Tensor, "time"], T_head_device: Rigid | None) -> CameraStream:
        """The upright camera on the head joint, without pictures."""
        upright = aria_calibration.rotate_camera_calib_cw90deg(self.pinhole)
        T_device_aria = Rigid(R_CPF_DEVICE.T, torch.zeros(3)) @ self.device.T_aria_cpf.inverse()
        T_head_cam = (T_head_device or T_HEAD_DEVICE) @ T_device_aria @ _rigid(upright.get_transform_device_camera())
        (fx, fy), (cx, cy) = upright.get_focal_lengths(), upright.get_principal_point()
        camera = Camera("pinhole", self.size, self.size, float(fx), float(fy), float(cx), float(cy))
        return CameraStream(times, camera, T_head_cam.R, T_head_cam.t)


def timecode_offset_s(path: str | Path) -> float:
    """Device clock minus time code (s) at the recording's start: what Nymeria's suit timestamps need added.

    Raises WearcapError as `read_device` does, and for a recording without time code.
    """
    provider = _open(path)
    device_ns = provider.get_first_time_ns_all_streams(TimeDomain.DEVICE_TIME)
    if not provider.supports_time_domain(provider.get_all_streams()[0], TimeDomain.TIME_CODE):
        raise WearcapError("carries no time code", where=path, expected="a recording made with one, as Nymeria's")
    return (device_ns - provider.convert_from_device_time_to_timecode_ns(device_ns)) * 1e-9


def _open(path: str | Path):
    """Data provider of projectaria-tools. Raises WearcapError that names what is missing."""
    if data_provider is None:
        raise WearcapError(
            "reading VRS recordings needs projectaria-tools",
            where=path,
            fix='Install it with `pip install "wearcap[aria]"` (about 1 GB).',
        )
    file_size(path)
    provider = data_provider.create_vrs_data_provider(str(path))
    if provider is None:
        raise WearcapError("not a readable VRS recording", where=path, expected="a complete .vrs file of Aria glasses")
    return provider


def _rigid(pose) -> Rigid:
    """A Sophus SE3 as a Rigid."""
    return Rigid.from_matrix(torch.tensor(pose.to_matrix(), dtype=torch.float32))
