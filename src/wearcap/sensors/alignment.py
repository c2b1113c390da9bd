"""Alignment of the suit's world to the scene's (thesis eq. 4.14, 4.15), and the camera's mount (eq. 4.3)."""

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, outlier_mask, resample
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Localization

MAX_SPEED = 3.0
"""m/s between localised positions beyond which one of them is wrong (thesis §4.2.5)."""


def align_suit(
    suit: Motion, localization: Localization, mount: Rigid, first_s: float = 10.0
) -> tuple[Motion, Float[Tensor, ""]]:
    """Move a suit's motion into the scene by a rotation about gravity and a translation: (motion, angle in rad).

    The angle is that of eq. 4.14, estimated robustly over the first `first_s` seconds of localised frames instead of
    frame 0, which may be an outlier; it turns root orientation and path of all frames (eq. 4.15). The translation moves
    the worn camera to its localised positions. `mount` is the camera's nominal pose in head axes, T_head_cam. Clocks
    must agree already. Raises WearcapError when no localised frame lies within the suit's time.
    """
    seen = inliers(localization)
    inside = localization.timestamps >= suit.timestamps[0]
    early = _first(seen & inside & (localization.timestamps <= suit.timestamps[-1]), localization, first_s)
    if not early.any():
        raise WearcapError(
            f"none of {len(seen)} frames is localised between {suit.timestamps[0]:.1f} s and "
            f"{suit.timestamps[-1]:.1f} s",
            where="localization",
            expected="camera poses on the suit's clock",
            fix="Synchronise the clocks, or check the map.",
        )
    times, weight = localization.timestamps[early], localization.confidence[early]
    head = suit.joint("head")
    head = resample(Trajectory(suit.timestamps, head.R, head.t), times).T_world_body
    T_world_cam = Rigid(localization.R_world_cam[early], localization.t_world_cam[early]).to(head.t.dtype)
    angle, certainty = yaw_between(head.R, T_world_cam.R @ mount.R.mT)
    turn = robust_angle(angle, weight * certainty)
    R_scene_suit = rotation.about_axis("z", turn)
    worn: Tensor = head @ mount.t  # pyright: ignore[reportAssignmentType]
    move = _weighted_median(T_world_cam.t - worn @ R_scene_suit.mT, weight)
    return suit.moved(Rigid(R_scene_suit, move)), turn


def inliers(localization: Localization) -> Bool[Tensor, "time"]:
    """Localised frames (confidence above 0) within 3 m/s of their inlier neighbours."""
    found = (localization.confidence > 0) & localization.R_world_cam.isfinite().all(-1).all(-1)
    position = torch.where(found[:, None], localization.t_world_cam, torch.nan)
    return outlier_mask(Trajectory(localization.timestamps, localization.R_world_cam, position), MAX_SPEED)


def _first(seen: Tensor, localization: Localization, first_s: float) -> Tensor:
    """The first localised frames, as many as make up `first_s` seconds."""
    step = localization.timestamps.diff().median().item() if len(seen) > 1 else first_s
    return seen & (seen.cumsum(0) <= max(round(first_s / step), 1))


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


def robust_angle(
    angle: Float[Tensor, "sample"], weight: Float[Tensor, "sample"], scale_rad: float = 0.05
) -> Float[Tensor, ""]:
    """Centre (rad) of angles on the circle: the sample with the least weighted sum of distances to all others, then
    reweighted means in which an angle `scale_rad` away counts a quarter, and far ones hardly."""
    # A subset of candidates suffices for the initial estimate.
    candidates = angle[:: max(len(angle) // 300, 1)]
    distance = rotation.wrap_angle(candidates[:, None] - angle).abs()
    centre = candidates[(distance @ weight).argmin()]
    for _ in range(30):
        off = rotation.wrap_angle(angle - centre)
        w = weight / (1 + (off / scale_rad) ** 2) ** 2
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
    centre: Tensor = roma.special_procrustes(median)  # pyright: ignore[reportAssignmentType]
    for _ in range(20):
        w = weight / rotation.geodesic(R, centre.expand_as(R)).clamp(min=0.005)
        mean = (w[:, None, None] * R).sum(0) / w.sum()
        centre = roma.special_procrustes(mean)  # pyright: ignore[reportAssignmentType]
    return centre


def body_camera(motion: Motion, t_head_cam: Float[Tensor, "3"]) -> Float[Tensor, "time 3"]:
    """Positions (m, world) of a camera mounted on a motion's head."""
    return motion.joint("head") @ t_head_cam  # pyright: ignore[reportReturnType]
