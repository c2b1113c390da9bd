"""The suit in the scene: alignment of its world (thesis eq. 4.14, 4.15), the camera's mount (eq. 4.3), and HPS's
initialisation, the suit's pose moved to the camera's path (§4.2.5, eq. 4.13).
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError, require_choice
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, nearest_frames, outlier_mask, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Localization
from wearcap.sensors.path_fusion import CameraSamples, DriftPrior, columns_at, fuse_paths

MAX_SPEED = 3.0
"""m/s between localised positions beyond which one of them is wrong (thesis §4.2.5)."""
PATHS = ("tangent", "fused")
TILT_SCALE, TURN_SCALE = 0.05, 0.05
"""Robust scales (rad) of the direction of gravity, and of the suit's heading."""
MOST_TILT_DEG = 5.0
"""Tilt beyond which a map is taken as level."""
FIRST_S = 10.0
"""Time of localised frames over which the suit's heading is aligned."""


def align_suit(
    suit: Motion, localization: Localization, mount: Rigid, tilt: bool = False
) -> tuple[Motion, Float[Tensor, ""]]:
    """Move a suit's motion into the scene by a rotation about gravity and a translation: (motion, angle in rad).

    With `tilt` (ours) the motion is first tilted to gravity's direction in the map (`gravity_in_map`); the thesis
    takes the map as level.

    The angle is that of eq. 4.14, estimated robustly over the first `FIRST_S` seconds of localised frames instead of
    frame 0, which may be an outlier; it turns root orientation and path of all frames (eq. 4.15). The translation moves
    the worn camera to its localised positions. `mount` is the camera's nominal pose in head axes, T_head_cam. Clocks
    must agree already. Raises WearcapError when no localised frame lies within the suit's time.
    """
    if tilt:
        up = gravity_in_map(suit, localization).float()
        R_map_suit = rotation.exp(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), up))
        suit = suit.moved(Rigid(R_map_suit, suit.t_world_root[0] - R_map_suit @ suit.t_world_root[0]))
    inside = _inliers_during(suit, localization)
    step = localization.timestamps.diff().median().item() if len(inside) > 1 else FIRST_S
    early = inside & (inside.cumsum(0) <= max(round(FIRST_S / step), 1))
    if not early.any():
        raise WearcapError(
            f"none of {len(inside)} frames is localised between {suit.timestamps[0]:.1f} s and "
            f"{suit.timestamps[-1]:.1f} s",
            where="localization",
            expected="camera poses on the suit's clock",
            fix="Synchronise the clocks, or check the map.",
        )
    times, weight = localization.timestamps[early], localization.confidence[early]
    head = _head_at(suit, times)
    T_world_cam = Rigid(localization.R_world_cam[early], localization.t_world_cam[early]).to(head.t.dtype)
    angle, certainty = yaw_between(head.R, T_world_cam.R @ mount.R.mT)
    turn = _robust_angle(angle, weight * certainty)
    R_scene_suit = rotation.about_axis("z", turn)
    worn: Tensor = head @ mount.t  # pyright: ignore[reportAssignmentType]
    move = _weighted_median(T_world_cam.t - worn @ R_scene_suit.mT, weight)
    return suit.moved(Rigid(R_scene_suit, move)), turn


def gravity_in_map(suit: Motion, localization: Localization) -> Float64[Tensor, "3"]:
    """Direction (unit vector, map axes) that the suit's sensors measure as up, where a map is not level.

    Independent of the heading, which may drift: seen from the camera, up is R_world_cam^T n by the map and
    R_head_cam^T R_world_head^T e_z by the suit. n and the mount R_head_cam are found in turn by weighted means (Wahba's
    problem) whose weights fall with the angle between both. A wearer who looks into different directions separates the
    two; beyond `MOST_TILT_DEG` the map is taken as level.
    """
    level = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    seen = _inliers_during(suit, localization)
    if not seen.any():
        return level
    R_world_head = _head_at(suit, localization.timestamps[seen]).R
    R_cam, up_head = localization.R_world_cam[seen].double(), R_world_head.double()[:, 2]
    up, weight = level, localization.confidence[seen].double()
    w = weight
    for _ in range(30):
        up_cam = (R_cam.mT @ up[:, None])[..., 0]
        both = torch.einsum("t,ti,tj->ij", w, up_head, up_cam)
        mount = rotation.nearest_rotation(both)
        by_suit = (R_cam @ (mount.mT @ up_head[..., None]))[..., 0]
        up = torch.nn.functional.normalize((w[:, None] * by_suit).sum(0), dim=0)
        off = torch.linalg.cross(by_suit, up.expand_as(by_suit)).norm(dim=-1)
        w = weight / (1 + (off / TILT_SCALE) ** 2) ** 2
    return up if up[2] > np.cos(np.deg2rad(MOST_TILT_DEG)) else level


def inliers(localization: Localization) -> Bool[Tensor, "time"]:
    """Localised frames (confidence above 0) within 3 m/s of their inlier neighbours."""
    found = (localization.confidence > 0) & localization.R_world_cam.isfinite().all(-1).all(-1)
    position = torch.where(found[:, None], localization.t_world_cam, torch.nan)
    return outlier_mask(Trajectory(localization.timestamps, localization.R_world_cam, position), MAX_SPEED)


def _inliers_during(suit: Motion, localization: Localization) -> Bool[Tensor, "time"]:
    """The inliers within the suit's time."""
    times = localization.timestamps
    return inliers(localization) & (times >= suit.timestamps[0]) & (times <= suit.timestamps[-1])


def _head_at(suit: Motion, times: Float64[Tensor, "sample"]) -> Rigid:
    """Poses of the head at other times."""
    head = suit.joint("head")
    return resample(Trajectory(suit.timestamps, head.R, head.t), times).T_world_body


def yaw_between(
    R_a: Float[Tensor, "*batch 3 3"], R_b: Float[Tensor, "*batch 3 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Angle (rad) about gravity that brings R_a nearest to R_b, and how well it is determined (0…1).

    The geodesic distance of Rz(x) R_a and R_b (eq. 4.14) is smallest where trace(Rz(x) R_a R_b^T) is largest; with
    Q = R_b R_a^T that is (Q00 + Q11) cos x + (Q10 - Q01) sin x + Q22.
    """
    Q = R_b @ R_a.mT
    cos, sin = Q[..., 0, 0] + Q[..., 1, 1], Q[..., 1, 0] - Q[..., 0, 1]
    return torch.atan2(sin, cos), torch.hypot(sin, cos) / 2


def _robust_angle(angle: Float[Tensor, "sample"], weight: Float[Tensor, "sample"]) -> Float[Tensor, ""]:
    """Centre (rad) of angles on the circle: the sample with the least weighted sum of distances to all others, then
    reweighted means in which an angle `TURN_SCALE` away counts a quarter, and far ones hardly."""
    # A subset of candidates suffices for the initial estimate.
    candidates = angle[:: max(len(angle) // 300, 1)]
    distance = rotation.wrap_angle(candidates[:, None] - angle).abs()
    centre = candidates[(distance @ weight).argmin()]
    for _ in range(30):
        off = rotation.wrap_angle(angle - centre)
        w = weight / (1 + (off / TURN_SCALE) ** 2) ** 2
        centre = rotation.wrap_angle(centre + (w * off).sum() / w.sum())
    return centre


def _weighted_median(value: Float[Tensor, "sample 3"], weight: Float[Tensor, "sample"]) -> Float[Tensor, "3"]:
    ordered, order = value.sort(dim=0)
    share = weight[order].cumsum(0)
    return ordered.gather(0, (share < share[-1:] / 2).sum(0, keepdim=True))[0]


def estimate_head_camera(
    R_world_head: Float[Tensor, "time 3 3"], R_world_cam: Float[Tensor, "time 3 3"], confidence: Float[Tensor, "time"]
) -> Float[Tensor, "3 3"]:
    """R_head_cam from the aligned suit's head and the localised camera (HPS paper eq. 4, thesis eq. 4.3).

    Over all frames with confidence instead of frame 0: the rotation with the least weighted sum of geodesic
    distances (Weiszfeld steps on the chordal mean). A heading that drifts meanwhile enters as a turn of the mount:
    give frames from before the drift or with the heading corrected. Raises WearcapError without a frame.
    """
    good = (confidence > 0) & R_world_cam.isfinite().all(-1).all(-1)
    if not good.any():
        raise WearcapError("no localised frame", expected="at least one, to estimate the camera's mount on the head")
    R, weight = R_world_head[good].mT @ R_world_cam[good], confidence[good]
    median = torch.stack([_weighted_median(R[:, :, column], weight) for column in range(3)], -1)
    centre = rotation.nearest_rotation(median)
    for _ in range(20):
        w = weight / rotation.geodesic(R, centre.expand_as(R)).clamp(min=0.005)
        centre = rotation.nearest_rotation((w[:, None, None] * R).sum(0) / w.sum())
    return centre


def body_camera(motion: Motion, t_head_cam: Float[Tensor, "3"]) -> Float[Tensor, "time 3"]:
    """Positions (m, world) of a camera mounted on a motion's head."""
    return motion.joint("head") @ t_head_cam  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class InitializationSettings:
    """Settings of the initialisation; the thesis's values are marked."""

    path: str = "fused"
    """"tangent": the camera's positions, a straight line where there is none, and each frame's heading by its direction
    of travel (thesis eq. 4.13). "fused" (ours): path and heading that suit, positions and orientations tell together,
    also of a standing wearer and where the camera is lost (`fuse_paths`)."""
    tangent_s: float = 1 / 3
    """Time span of a tangent (thesis: 10 frames at 30 Hz)."""
    min_speed: float = 0.3
    """m/s over a tangent; slower frames are stationary."""
    drift: DriftPrior = field(default_factory=DriftPrior)
    tilt: bool = True
    """Whether the suit's motion is tilted to gravity's direction in the map (ours)."""

    def __post_init__(self):
        require_choice(self.path, PATHS, f"path={self.path!r}")


@dataclass(frozen=True)
class Initialization:
    """Initial motion in the scene."""

    motion: Motion
    valid: Bool[Tensor, "time"]
    """Frames of the motion with an inlier camera position within a localisation step."""
    yaw_correction: Float[Tensor, "time"]
    """Angle (rad) about gravity by which each frame's root was turned."""
    root_step: Float[Tensor, "pair 3"]
    """Displacement of the root (m, scene) from each frame to the next: the suit's, turned by its frames' heading, or the
    fused path's."""


def initialize(
    suit_aligned: Motion,
    localization: Localization,
    R_head_cam: Float[Tensor, "3 3"],
    t_head_cam: Float[Tensor, "3"],
    settings: InitializationSettings | None = None,
) -> Initialization:
    """Turn the aligned suit's root to the camera's heading and translate it so that its worn camera is at the camera's.

    "fused" also corrects a yaw error of R_head_cam, so that `estimate_head_camera` with the returned motion's head gives a
    better R_head_cam. Outliers at 3 m/s are removed to convergence. Raises WearcapError when no frame is localised in the
    suit's time.
    """
    settings, suit = settings or InitializationSettings(), suit_aligned
    seen = _inliers_during(suit, localization)
    if not seen.any():
        what = "no localised frame in the suit's time"
        fix = "Synchronise the clocks, or check the map."
        raise WearcapError(what, where="localization", expected="camera poses on the suit's clock", fix=fix)
    times = localization.timestamps[seen]
    step = (localization.timestamps if len(seen) > 1 else suit.timestamps).diff().median().item()
    valid = (times[nearest_frames(times, suit.timestamps)] - suit.timestamps).abs() <= 1.5 * step
    body = body_camera(suit, t_head_cam)
    if settings.path == "tangent":
        places = localization.t_world_cam[seen].double().numpy()
        camera = torch.from_numpy(columns_at(suit.timestamps.numpy(), times.numpy(), places))
        yaw = _tangent_yaw(suit.timestamps, body.double(), camera, valid, settings)
    else:
        samples = _samples(suit, localization, seen, R_head_cam)
        yaw, camera = fuse_paths(suit.timestamps, body.double(), samples, settings.drift)
    turn = rotation.about_axis("z", yaw).to(body.dtype)
    R = suit.R_parent_joint.clone()
    R[:, 0] = turn @ R[:, 0]
    root = camera.to(body.dtype) - (turn @ (body - suit.t_world_root)[..., None])[..., 0]
    step = root.diff(dim=0)
    if settings.path == "tangent":
        heading = rotation.about_axis("z", yaw[:-1] + rotation.wrap_angle(yaw.diff()) / 2).to(body.dtype)
        step = (heading @ suit.t_world_root.diff(dim=0)[..., None])[..., 0]
    return Initialization(replace(suit, R_parent_joint=R, t_world_root=root), valid, yaw.to(body.dtype), step)


def _samples(
    suit: Motion, localization: Localization, seen: Bool[Tensor, "time"], R_head_cam: Float[Tensor, "3 3"]
) -> CameraSamples:
    """Positions and headings of the localised frames that are `seen`."""
    times = localization.timestamps[seen]
    R_world_head = _head_at(suit, times).R
    yaw, certainty = yaw_between(R_world_head, localization.R_world_cam[seen].to(R_world_head) @ R_head_cam.mT)
    confidence = localization.confidence[seen].double()
    position = localization.t_world_cam[seen].double()
    return CameraSamples(times, position, yaw.double(), confidence, confidence * certainty.double())


def _tangent_yaw(
    timestamps: Float64[Tensor, "time"],
    body: Float64[Tensor, "time 3"],
    camera: Float64[Tensor, "time 3"],
    valid: Bool[Tensor, "time"],
    settings: InitializationSettings,
) -> Float64[Tensor, "time"]:
    """Angle from the suit's to the camera's direction of travel (thesis eq. 4.13; the angle itself, where the printed
    exp(v × v) turns by its sine). Frames that stand or are lost take the last moving one's, the first ones the first's.
    """
    span_s, least_m = settings.tangent_s, settings.min_speed * settings.tangent_s
    ahead = torch.searchsorted(timestamps, timestamps + span_s - 1e-6).clamp(max=len(timestamps) - 1)
    by_suit, by_camera = (torch.view_as_complex((p[ahead] - p)[:, :2].contiguous()) for p in (body, camera))
    lost = torch.cat([valid.new_zeros(1), ~valid]).cumsum(0)
    moving = (lost[ahead + 1] == lost[:-1]) & (timestamps[ahead] - timestamps > 0.9 * span_s)
    moving &= (by_suit.abs() > least_m) & (by_camera.abs() > least_m)
    if not moving.any():
        return torch.zeros(len(body), dtype=torch.float64)
    frame = torch.where(moving, torch.arange(len(body)), -1).cummax(0).values
    frame = torch.where(frame < 0, moving.nonzero()[0], frame)
    return (by_camera * by_suit.conj()).angle()[frame]
