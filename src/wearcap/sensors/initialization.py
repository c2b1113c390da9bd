"""Where HPS's optimisation starts: the suit's pose carried along the camera's path (thesis §4.2.5, eq. 4.13)."""

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
"""Rad and m from which on a sample is doubted."""
PATH_SPAN_S = 1.0
"""A metre or more of way: 5 cm of noise turn it by 4°, a hundred such by 0.4°."""


@dataclass(frozen=True)
class InitializationSettings:
    """How the start is made; the values of the documents are named as such."""

    yaw: str = "orientation"
    """"tangent": each frame's own direction of travel (thesis eq. 4.13). "orientation" (ours): the camera's
    orientation against the suit's head, smoothed, which tells the heading of who stands too."""
    bridge: str = "suit"
    """Where no camera is localised: "line" straight to the next (the document's) or (ours) "suit": as the suit
    moved, with the error that shows at the far end spread over the gap."""
    tangent_s: float = 1 / 3
    """Document: 10 frames at 30 Hz."""
    min_speed: float = 0.3
    """m/s over a tangent; slower frames are stationary."""
    yaw_smoothing_s: float = 10.0
    path_smoothing_s: float = 1.0
    """Standard deviation (as for yaw) of the smoothing of the camera's path less the suit's, for bridge="suit" alone;
    0: none (document)."""

    def __post_init__(self):
        for name, value, choices in (("yaw", self.yaw, YAWS), ("bridge", self.bridge, BRIDGES)):
            if value not in choices:
                raise WearcapError(f"{name}={value!r}", expected=f"one of {', '.join(choices)}")
        if self.bridge == "line" and self.path_smoothing_s:
            raise WearcapError(f"bridge='line' with path_smoothing_s={self.path_smoothing_s:g}",
                               expected="path_smoothing_s=0: what is smoothed is the way beside the suit's")  # fmt: skip


@dataclass(frozen=True)
class Initialization:
    """The start: a motion in the scene, and how it came about."""

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
    """Turn the aligned suit's root to the camera's heading and place it so that its camera sits at the camera's.

    "orientation" takes R_head_cam's yaw as relative: what remains of it shows on the way and is corrected, so that
    `estimate_head_camera` with the head of the motion returned gives the better R_head_cam.
    Outliers at 3 m/s are removed to convergence. Raises WearcapError when no frame is localised in the suit's time.
    """
    settings, suit, seen = settings or InitializationSettings(), suit_aligned, inliers(localization)
    seen &= (localization.timestamps >= suit.timestamps[0]) & (localization.timestamps <= suit.timestamps[-1])
    if not seen.any():
        raise WearcapError("no localised frame in the suit's time", where="localization",
                           expected="camera poses on the suit's clock", fix="Synchronise the clocks, or check the map.")  # fmt: skip
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
    """The head camera's way by the suit and by localisation, at the suit's timestamps."""

    timestamps: Float64[Tensor, "time"]
    body: Float64[Tensor, "time 3"]
    camera: Float64[Tensor, "time 3"]
    valid: Bool[Tensor, "time"]

    def steps(self, span_s: float) -> tuple[Tensor, Tensor, Tensor]:
        """Horizontal ways during the next `span_s` by suit and camera (complex, m), and where they are whole: valid
        from one end to the other."""
        ahead = torch.searchsorted(self.timestamps, self.timestamps + span_s - 1e-6).clamp(
            max=len(self.timestamps) - 1
        )
        body, camera = (
            torch.view_as_complex((p[ahead] - p)[:, :2].contiguous()) for p in (self.body, self.camera)
        )
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
    suit: Motion,
    localization: Localization,
    seen: Tensor,
    R_head_cam: Tensor,
    settings: InitializationSettings,
) -> Float64[Tensor, "time"]:
    """Angle about gravity from the suit's head to the one that the camera's orientation tells, smoothed robustly."""
    head, times = suit.joint("head"), localization.timestamps[seen]
    R_world_head = resample(Trajectory(suit.timestamps, head.R, head.t), times).R_world_body
    angle, certainty = yaw_between(
        R_world_head, localization.R_world_cam[seen].to(head.R.dtype) @ R_head_cam.mT
    )
    weight = (localization.confidence[seen] * certainty).double()
    pointer = torch.stack([angle.cos(), angle.sin()], -1).double()
    smooth = _robust_smooth(times, pointer, weight, settings.yaw_smoothing_s, ANGLE_SCALE)
    frames = torch.from_numpy(np.unwrap(torch.atan2(smooth[:, 1], smooth[:, 0]).numpy()))
    return _interpolated(suit.timestamps, times, frames[:, None])[:, 0]


def _path_turn(paths: _Paths, yaw: Tensor, settings: InitializationSettings) -> Float64[Tensor, ""]:
    """The constant angle by which the suit's way, turned by `yaw`, still differs from the camera's.

    Alignment by a nominal mount is wrong by that mount's error in yaw; who walks shows it.
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
    """The suit's way, turned step by step, plus what the camera's differs from it: interpolated where it is lost."""
    turn = rotation.about_axis("z", (yaw[1:] + yaw[:-1]) / 2)
    way = (turn @ paths.body.diff(dim=0)[..., None])[..., 0].cumsum(0)
    way = torch.cat([torch.zeros(1, 3, dtype=way.dtype), way])
    times, apart = paths.timestamps[paths.valid], (paths.camera - way)[paths.valid]
    if settings.path_smoothing_s:
        ones = torch.ones(len(times), dtype=torch.float64)
        apart = _robust_smooth(times, apart, ones, settings.path_smoothing_s, DISTANCE_SCALE)
    return way + _interpolated(paths.timestamps, times, apart)


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
    """Linear between samples, held beyond them."""
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
