"""Project Aria's VRS recordings: calibration and the head's video (needs the extra: `pip install "wearcap[aria]"`).

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
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE
from wearcap.io.formats.bounded import file_size
from wearcap.io.formats.video import write_frames
from wearcap.recording import CameraStream

try:
    from projectaria_tools.core import calibration as aria_calibration
    from projectaria_tools.core import data_provider
    from projectaria_tools.core.sensor_data import TimeDomain
except ImportError:
    data_provider = None


@dataclass(frozen=True)
class _AriaDevice:
    """Factory calibration stored in a recording."""

    T_aria_cpf: Rigid
    """Central pupil frame in the device frame; pass it to `read_mps` or `head_stream` in place of the nominal one."""
    T_aria_sensor: dict[str, Rigid]
    """Poses of cameras (OpenCV axes) and IMUs in the device frame by label: "camera-rgb", "camera-slam-left", "imu-right" …"""
    subtype: str
    """"DVT-S" or "DVT-L": the size of the glasses."""


def read_device(path: str | Path) -> _AriaDevice:
    """Calibration of a VRS recording. Raises WearcapError when the extra is missing or the file is no VRS."""
    device = _open(path).get_device_calibration()
    if device is None:
        raise WearcapError("holds no calibration", where=path, expected="a recording of Aria glasses")
    labels = [*device.get_camera_labels(), *device.get_imu_labels()]
    poses = {label: device.get_transform_device_sensor(label) for label in labels}
    return _AriaDevice(
        _rigid(device.get_transform_device_cpf()),
        {label: _rigid(pose) for label, pose in poses.items() if pose is not None},
        device.get_device_subtype(),
    )


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
    """Write a camera's pictures, undistorted to a pinhole of `size` × `size` px and `focal` px and turned upright, as an MP4.

    The stream names it by its folder's name and its own. `between` keeps the frames from one device time to another
    (s). Raises WearcapError as `read_device` does, for a camera that the recording lacks, and when fewer than two
    frames are left.
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
