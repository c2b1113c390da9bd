"""Project Aria's VRS recordings: calibration and the head's video (needs the extra: `pip install "wearcap[aria]"`).

Timestamps are the device's clock, the one that MPS trajectories carry. Frames as in io/devices/aria_mps.py.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from wearcap.boundary.opening import file_size
from wearcap.errors import WearcapError
from wearcap.extras import missing
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE
from wearcap.io.formats.video import write_frames
from wearcap.recording import CameraStream

try:
    from projectaria_tools.core import calibration as aria_calibration
    from projectaria_tools.core import data_provider
    from projectaria_tools.core.sensor_data import TimeDomain
except ImportError:
    data_provider = None


_FINER = 4
"""Factor by which pictures are drawn larger and then averaged, against aliasing."""


def read_device(path: str | Path) -> tuple[Rigid, dict[str, Rigid]]:
    """Factory calibration of a VRS recording. Raises WearcapError when the extra is missing or the file is no VRS.

    Gives the central pupil frame in the device frame (pass it to `read_mps` or `head_stream` in place of the nominal
    one), and there the poses of cameras (OpenCV axes) and IMUs by label: "camera-rgb", "imu-right" …
    """
    device = _open(path).get_device_calibration()
    if device is None:
        raise WearcapError("holds no calibration", path, "a recording of Aria glasses")
    labels = [*device.get_camera_labels(), *device.get_imu_labels()]
    poses = {label: device.get_transform_device_sensor(label) for label in labels}
    T_aria_sensor = {label: _rigid(pose) for label, pose in poses.items() if pose is not None}
    return _rigid(device.get_transform_device_cpf()), T_aria_sensor


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
    provider, (T_aria_cpf, T_aria_sensor) = _open(path), read_device(path)
    source = provider.get_stream_id_from_label(label)
    if source is None or label not in T_aria_sensor:
        raise WearcapError(f"no camera {label!r}", path, f"one of {', '.join(T_aria_sensor)}")
    original = provider.get_device_calibration().get_camera_calib(label)
    pose = original.get_transform_device_camera()
    pinhole, drawn = (
        aria_calibration.get_linear_camera_calibration(size * scale, size * scale, focal * scale, label, pose)
        for scale in (1, _FINER)
    )

    def picture(index: int) -> UInt8[np.ndarray, "height width 3"]:
        image, _ = provider.get_image_data_by_index(source, index)
        flat = aria_calibration.distort_by_calibration(image.to_numpy_array(), drawn, original)
        # Aria's sensors are mounted on their side.
        upright = Image.fromarray(np.ascontiguousarray(np.rot90(flat, -1))).convert("RGB")
        return np.asarray(upright.reduce(_FINER))

    stamps = provider.get_timestamps_ns(source, TimeDomain.DEVICE_TIME)
    times = torch.tensor(stamps, dtype=torch.int64).double() * 1e-9
    first, stop = 0, len(times)
    if between is not None:
        first, stop = np.searchsorted(times.numpy(), between).tolist()
    if stop - first < 2:
        what = f"{stop - first} pictures of {label!r} in the time that is wanted"
        raise WearcapError(what, path, "a recording of the same time")
    fps = 1 / times[first:stop].diff().median().item()
    write_frames(file, (picture(i) for i in range(first, stop)), fps)
    upright = aria_calibration.rotate_camera_calib_cw90deg(pinhole)
    T_device_aria = Rigid(R_CPF_DEVICE.T, torch.zeros(3)) @ T_aria_cpf.inverse()
    T_head_cam = (T_head_device or T_HEAD_DEVICE) @ T_device_aria @ _rigid(upright.get_transform_device_camera())
    (fx, fy), (cx, cy) = upright.get_focal_lengths(), upright.get_principal_point()
    camera = Camera("pinhole", size, size, float(fx), float(fy), float(cx), float(cy))
    name = f"{file.parent.name}/{file.name}"
    return CameraStream(times[first:stop], camera, T_head_cam.R, T_head_cam.t, video=name)


def _open(path: str | Path):
    """Data provider of projectaria-tools. Raises WearcapError that names what is missing."""
    if data_provider is None:
        raise missing("projectaria_tools", "reading VRS recordings (the package has about 1 GB)")
    file_size(path)
    provider = data_provider.create_vrs_data_provider(str(path))
    if provider is None:
        raise WearcapError("not a readable VRS recording", path, "a complete .vrs file of Aria glasses")
    return provider


def _rigid(pose) -> Rigid:
    """A Sophus SE3 as a Rigid."""
    return Rigid.from_matrix(torch.tensor(pose.to_matrix(), dtype=torch.float32))
