"""Initialisation of HPS's optimisation: the suit's pose moved to the camera's path (thesis §4.2.5, eq. 4.13)."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.signal
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Localization
from wearcap.sensors.alignment import body_camera, inliers, robust_angle, yaw_between

YAWS, BRIDGES = ("tangent", "orientation"), ("line", "suit")
ANGLE_SCALE, DISTANCE_SCALE = 0.1, 0.15
"""Robust scales (rad, m) of the smoothing residuals."""
PATH_SPAN_S = 1.0
"""Duration (s) of the displacements, a metre or more: 5 cm of noise turn one by 4°, a hundred by 0.4°."""


@dataclass(frozen=True)
class InitializationSettings:
    """Settings of the initialisation; the thesis's values are marked."""

    yaw: str = "orientation"
    """"tangent": each frame's own direction of travel (thesis eq. 4.13). "orientation" (ours): the camera's
    orientation against the suit's head, smoothed, which also gives the heading of a standing wearer."""
    bridge: str = "suit"
    """Gaps without localisation: "line", straight to the next position (the thesis), or (ours) "suit": the suit's
    displacement, with the error at the far end spread over the gap."""
    tangent_s: float = 1 / 3
    """Time span of a tangent (thesis: 10 frames at 30 Hz)."""
    min_speed: float = 0.3
    """m/s over a tangent; slower frames are stationary."""
    yaw_smoothing_s: float = 10.0
    path_smoothing_s: float = 1.0
    """Standard deviation (as for yaw) of the smoothing of the difference between camera and suit path, for
    bridge="suit" only; 0: none (thesis)."""

    def __post_init__(self):
        for name, value, choices in (("yaw", self.yaw, YAWS), ("bridge", self.bridge, BRIDGES)):
            if value not in choices:
                raise WearcapError(f"{name}={value!r}", expected=f"one of {', '.join(choices)}")
        if self.bridge == "line" and self.path_smoothing_s:
            raise WearcapError(
                f"bridge='line' with path_smoothing_s={self.path_smoothing_s:g}",
                expected="path_smoothing_s=0: smoothing applies to the difference from the suit's path",
            )


@dataclass(frozen=True)
class Initialization:
    """Initial motion in the scene."""

    motion: Motion
    valid: Bool[Tensor, "time"]
    """Frames of the motion with an inlier camera position within a localisation step."""
    yaw_correction: Float[Tensor, "time"]
    """Angle (rad) about gravity by which each frame's root was turned."""


def initialize(
    suit_aligned: Motion,
    localization: Localization,
    R_head_cam: Float[Tensor, "3 3"],
    t_head_cam: Float[Tensor, "3"],
    settings: InitializationSettings | None = None,
) -> Initialization:
    """Turn the aligned suit's root to the camera's heading and translate it so that its worn camera is at the camera's.

    With "orientation" a yaw error of R_head_cam is estimated from the paths and corrected, so that
    `estimate_head_camera` with the returned motion's head gives a better R_head_cam.
    Outliers at 3 m/s are removed to convergence. Raises WearcapError when no frame is localised in the suit's time.
    """
    settings, suit, seen = settings or InitializationSettings(), suit_aligned, inliers(localization)
    seen &= (localization.timestamps >= suit.timestamps[0]) & (localization.timestamps <= suit.timestamps[-1])
    if not seen.any():
        raise WearcapError(
            "no localised frame in the suit's time",
            where="localization",
            expected="camera poses on the suit's clock",
            fix="Synchronise the clocks, or check the map.",
        )
    valid = _covered(suit, localization, seen)
    body = body_camera(suit, t_head_cam)
    camera = _interpolated(suit.timestamps, localization.timestamps[seen], localization.t_world_cam[seen])
    moved = _Paths(suit.timestamps, body.double(), camera, valid)
    if settings.yaw == "tangent":
        yaw = _tangent_yaw(moved, settings)
    else:
        yaw = _orientation_yaw(suit, localization, seen, R_head_cam, settings)
        yaw = yaw + _path_turn(moved, yaw, settings)
    if settings.bridge == "suit":
        camera = _bridged(moved, yaw, settings)
    turn = rotation.about_axis("z", yaw).to(body.dtype)
    R = suit.R_parent_joint.clone()
    R[:, 0] = turn @ R[:, 0]
    root = camera.to(body.dtype) - (turn @ (body - suit.t_world_root)[..., None])[..., 0]
    return Initialization(replace(suit, R_parent_joint=R, t_world_root=root), valid, yaw.to(body.dtype))


@dataclass(frozen=True)
class _Paths:
    """Paths of the head camera by the suit and by localisation, at the suit's timestamps."""

    timestamps: Float64[Tensor, "time"]
    body: Float64[Tensor, "time 3"]
    camera: Float64[Tensor, "time 3"]
    valid: Bool[Tensor, "time"]

    def steps(self, span_s: float) -> tuple[Tensor, Tensor, Tensor]:
        """Horizontal displacements during the next `span_s` by suit and camera (complex, m), and where they are valid
        from start to end."""
        ahead = torch.searchsorted(self.timestamps, self.timestamps + span_s - 1e-6).clamp(max=len(self.timestamps) - 1)
        body, camera = (torch.view_as_complex((p[ahead] - p)[:, :2].contiguous()) for p in (self.body, self.camera))
        lost = torch.cat([self.valid.new_zeros(1), ~self.valid]).cumsum(0)
        whole = (lost[ahead + 1] == lost[:-1]) & (self.timestamps[ahead] - self.timestamps > 0.9 * span_s)
        return body, camera, whole


def _tangent_yaw(paths: _Paths, settings: InitializationSettings) -> Float64[Tensor, "time"]:
    """Angle from the suit's to the camera's direction of travel (thesis eq. 4.13; the angle itself, where the printed
    exp(v × v) turns by its sine). Frames that stand or are lost take the last moving one's, the first ones the first's.
    """
    body, camera, whole = paths.steps(settings.tangent_s)
    least = settings.min_speed * settings.tangent_s
    moving = whole & (body.abs() > least) & (camera.abs() > least)
    if not moving.any():
        return torch.zeros(len(body), dtype=torch.float64)
    frame = torch.where(moving, torch.arange(len(body)), -1).cummax(0).values
    frame = torch.where(frame < 0, moving.nonzero()[0], frame)
    return (camera * body.conj()).angle()[frame]


def _orientation_yaw(
    suit: Motion, localization: Localization, seen: Tensor, R_head_cam: Tensor, settings: InitializationSettings
) -> Float64[Tensor, "time"]:
    """Angle about gravity from the suit's head to the head implied by the camera's orientation, robustly smoothed."""
    head, times = suit.joint("head"), localization.timestamps[seen]
    R_world_head = resample(Trajectory(suit.timestamps, head.R, head.t), times).R_world_body
    angle, certainty = yaw_between(R_world_head, localization.R_world_cam[seen].to(head.R.dtype) @ R_head_cam.mT)
    weight = (localization.confidence[seen] * certainty).double()
    pointer = torch.stack([angle.cos(), angle.sin()], -1).double()
    smooth = _robust_smooth(times, pointer, weight, settings.yaw_smoothing_s, ANGLE_SCALE)
    frames = torch.from_numpy(np.unwrap(torch.atan2(smooth[:, 1], smooth[:, 0]).numpy()))
    return _interpolated(suit.timestamps, times, frames[:, None])[:, 0]


def _path_turn(paths: _Paths, yaw: Tensor, settings: InitializationSettings) -> Float64[Tensor, ""]:
    """The constant angle by which the suit's path, turned by `yaw`, still differs from the camera's.

    Alignment with a nominal mount inherits the mount's yaw error; walking reveals it.
    """
    body, camera, whole = paths.steps(PATH_SPAN_S)
    turned = body * torch.polar(torch.ones_like(yaw), yaw)
    least = settings.min_speed * PATH_SPAN_S
    moving = whole & (body.abs() > least) & (camera.abs() > least)
    product = (camera * turned.conj())[moving]
    if not len(product):
        return torch.zeros((), dtype=torch.float64)
    return robust_angle(product.angle(), product.abs(), scale_rad=ANGLE_SCALE).double()


def _bridged(paths: _Paths, yaw: Tensor, settings: InitializationSettings) -> Float64[Tensor, "time 3"]:
    """The suit's path, turned step by step, plus the camera's difference from it, interpolated over gaps."""
    turn = rotation.about_axis("z", (yaw[1:] + yaw[:-1]) / 2)
    suit_path = (turn @ paths.body.diff(dim=0)[..., None])[..., 0].cumsum(0)
    suit_path = torch.cat([torch.zeros(1, 3, dtype=suit_path.dtype), suit_path])
    times, apart = paths.timestamps[paths.valid], (paths.camera - suit_path)[paths.valid]
    if settings.path_smoothing_s:
        ones = torch.ones(len(times), dtype=torch.float64)
        apart = _robust_smooth(times, apart, ones, settings.path_smoothing_s, DISTANCE_SCALE)
    return suit_path + _interpolated(paths.timestamps, times, apart)


def _covered(suit: Motion, localization: Localization, seen: Tensor) -> Bool[Tensor, "time"]:
    """Frames of the suit that have an inlier within one and a half steps of the localisation."""
    clock = localization.timestamps if len(seen) > 1 else suit.timestamps
    step = clock.diff().median().item()
    times = localization.timestamps[seen]
    after = torch.searchsorted(times, suit.timestamps.contiguous()).clamp(max=len(times) - 1)
    gap = torch.stack([times[after], times[(after - 1).clamp(min=0)]]) - suit.timestamps
    return gap.abs().amin(0) <= 1.5 * step


def _interpolated(
    at: Float64[Tensor, "time"], times: Float64[Tensor, "sample"], value: Float[Tensor, "sample axis"]
) -> Float64[Tensor, "time axis"]:
    """Linear interpolation; the end samples are repeated outside."""
    columns = [np.interp(at.numpy(), times.numpy(), column) for column in value.double().numpy().T]
    return torch.from_numpy(np.stack(columns, -1))


def _robust_smooth(
    times: Float64[Tensor, "sample"],
    value: Float64[Tensor, "sample axis"],
    weight: Float64[Tensor, "sample"],
    sigma_s: float,
    scale: float,
) -> Float64[Tensor, "sample axis"]:
    """Gaussian mean over time, reweighted so that samples `scale` away count a quarter and far ones hardly."""
    step = times.diff().median().item() if len(times) > 1 else 1.0
    cell = ((times - times[0]) / step).round().long()
    columns, w = value.numpy(), weight.numpy()
    reach = int(4 * sigma_s / step) + 1
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1)[:, None] * step / sigma_s) ** 2)
    for _ in range(6):
        grid = np.zeros((int(cell[-1]) + 1, columns.shape[1] + 1))
        np.add.at(grid, cell.numpy(), np.column_stack([w[:, None] * columns, w]))
        grid = scipy.signal.fftconvolve(grid, kernel, mode="same", axes=0)[cell.numpy()]
        smooth = grid[:, :-1] / grid[:, -1:]
        off = np.linalg.norm(columns - smooth, axis=1)
        w = weight.numpy() / (1 + (off / scale) ** 2) ** 2
    return torch.from_numpy(smooth)
