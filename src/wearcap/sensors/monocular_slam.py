"""A monocular SLAM's path without a board: outliers removed (MocapEvery §3.2), scale and vertical by other means.

Scale and vertical come from an inertial sensor on the head (`by_head_imu`) or from the floor (`by_floor`), the scale
alone from walked distances (`scale_by_walks`). Inertial: with s metres per unit, s a_slam - g_slam = R_slam_imu f for
the specific force f (m/s²), so that gravity and scale are linear unknowns. Nearly all error lies in a_slam, a second
difference of jittery positions; solved for s, that error would stand beside the unknown and pull s down by as much as
its share of a_slam's variance. So the equation is solved as a_slam = (1/s) R f + g/s, the error on the left.
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import swing_between
from wearcap.geometry.trajectory import Trajectory, filled, find_gaps, interpolate, pieces, require_rising, resample
from wearcap.recording.recording import ImuStream
from wearcap.sensors.camera_alignment import SlamAlignment
from wearcap.sensors.imu import GRAVITY, acceleration
from wearcap.sensors.stillness import Stretch, during

_HALF_S = 0.25
"""Half span of the second differences: longer ones reduce jitter, shorter ones keep more of the gait."""
_BLOCK_S = 1.0
"""Errors further apart in time are assumed independent."""
_BIAS = 0.05
"""Expected standard deviation (m/s²) of an accelerometer's bias."""
_GRAVITY_SHARE = 0.05
"""Largest relative difference of the estimated gravity's magnitude from 9.81 m/s²."""
_ROUNDS = 20


def clean_track(
    trajectory: Trajectory, max_acceleration: float, max_burst_s: float
) -> tuple[Trajectory, Bool[Tensor, "time"], Float64[Tensor, "jump"]]:
    """Drop outliers of position (m) by their acceleration, and fill them by linear interpolation and slerp: trajectory
    on the same timestamps, the frames that were kept, and the times before jumps that are not short bursts.

    A jump between two frames accelerates both of them, there and back; a hard step or a turn only one. Where both
    exceed `max_acceleration` (m/s²; the paper gives no number, a running head stays below 30) the track is cut, a piece
    not longer than those beside it nor than `max_burst_s` is dropped, its neighbours are joined, and so on. A burst of
    any shape is thus dropped as a whole; longer deviating pieces are jumps of the SLAM system to another place and stay.
    Frames that are not finite are never valid. Raises WearcapError for timestamps that do not rise, and when no pose is
    finite.
    """
    require_rising(trajectory.timestamps)
    position, time = trajectory.t_world_body.double(), trajectory.timestamps
    valid = position.isfinite().all(-1) & trajectory.R_world_body.isfinite().all(-1).all(-1)
    if not valid.any():
        raise WearcapError("no pose of the trajectory is finite", expected="camera positions in metres")
    kept = valid.nonzero()[:, 0]
    while (cut := _jump_acceleration(position[kept], time[kept]) > max_acceleration).any():
        piece, length, short = pieces(cut)
        end = length.cumsum(0)
        span = time[kept][end - 1] - time[kept][end - length]
        dropped = (short & (span <= max_burst_s))[piece]
        if not dropped.any():
            break
        kept = kept[~dropped]
    valid = torch.zeros_like(valid).index_fill(0, kept, True)
    return filled(trajectory, valid), valid, time[kept][:-1][cut]


def _jump_acceleration(position: Float64[Tensor, "time 3"], time: Float64[Tensor, "time"]) -> Float64[Tensor, "step"]:
    """For each step from frame to frame, the smaller of the accelerations (m/s²) at its two ends.

    Second differences on uneven times; the first and the last frame have none of their own.
    """
    if len(time) < 3:
        return time.new_zeros(max(len(time) - 1, 0))
    step = time.diff()
    velocity = position.diff(dim=0) / step[:, None]
    inner = 2 * velocity.diff(dim=0).norm(dim=-1) / (step[1:] + step[:-1])
    beyond = inner.new_full((1,), torch.inf)
    return torch.minimum(torch.cat([beyond, inner]), torch.cat([inner, beyond]))


def scale_by_walks(slam: Trajectory, walks: Sequence[tuple[float, float, float]]) -> tuple[float, float]:
    """Metres per SLAM unit from walked distances, and the relative spread of their individual scales.

    A walk is (start s, stop s, metres between the two places). Raises WearcapError for walks that lead nowhere.
    """
    if not walks:
        raise WearcapError("no walked distance", expected="(start s, stop s, metres), once or more")
    at = torch.tensor([walk[:2] for walk in walks], dtype=torch.float64).reshape(-1)
    ends = interpolate(slam.timestamps, slam.t_world_body.double(), at).reshape(-1, 2, 3)
    lengths = (ends[:, 1] - ends[:, 0]).norm(dim=-1).numpy()
    metres = np.array([walk[2] for walk in walks])
    if lengths.min() < 1e-9 or metres.min() <= 0:
        what = f"walks of {metres.tolist()} m, and {lengths.round(4).tolist()} in the SLAM"
        expected = "two different places and a distance above 0"
        raise WearcapError(what, where="walked distances", expected=expected, fix="Check the times of the walks.")
    scales = metres / lengths
    return float(metres @ lengths / (lengths @ lengths)), float(np.ptp(scales) / scales.mean())


def by_head_imu(slam: Trajectory, imu: ImuStream, T_cam_imu: Rigid | None = None) -> SlamAlignment:
    """Scale and vertical (`_upright`) from a sensor (acc_imu, the camera's clock) fixed to the camera at a known place (m).

    Huber's robust least squares in (1/s, g/s, bias/s); its covariance allows for correlated errors within a second.
    Raises WearcapError where the two overlap by less than 10 s, do not move enough to observe the scale, or contradict
    each other: gravity not 9.81 m/s² long, or a negative scale.
    """
    a_slam, force_slam, R, fps = _alike(slam, imu, T_cam_imu or Rigid.identity())
    # a_slam = k R f - h - R b with h = -g/s (up), b = k bias
    rows = np.concatenate([force_slam[:, :, None], np.broadcast_to(-np.eye(3), R.shape), -R], 2)
    # Huber's estimate of x in rows @ x = y, and its covariance with errors that are correlated within blocks;
    # the last three unknowns, k times a bias, have a zero-mean prior
    block = round(_BLOCK_S * fps)
    weight, prior = np.ones(len(a_slam)), np.zeros(rows.shape[2])
    sigma2, k = a_slam.var(), 0.0
    for _ in range(_ROUNDS):
        # Errors are correlated over a block: a block counts as one observation against the prior.
        prior[-3:] = block * sigma2 / max(k * _BIAS, 1e-6) ** 2 if k else 1e6 * len(a_slam)
        normal = np.einsum("t,tij,tik->jk", weight, rows, rows) + np.diag(prior)
        x = np.linalg.solve(normal, np.einsum("t,tij,ti->j", weight, rows, a_slam))
        k = abs(x[0])
        error = a_slam - rows @ x
        size = np.linalg.norm(error, axis=1)
        scale = np.median(size) / 1.54  # of a three-dimensional normal error, per axis
        weight = np.minimum(1.0, 2.5 * scale / np.maximum(size, 1e-12))
        sigma2 = scale**2
    scores = np.einsum("t,tij,ti->tj", weight, rows, error)
    count = len(scores) // block * block
    summed = scores[:count].reshape(-1, block, rows.shape[2]).sum(1)
    inverse = np.linalg.inv(normal)
    middle = summed.T @ summed * len(scores) / max(count, 1)
    middle[-3:, -3:] += np.diag(prior[-3:] ** 2 * (k * _BIAS) ** 2)
    covariance = inverse @ middle @ inverse
    k, up = x[0], x[1:4]
    length = np.linalg.norm(up) / k if abs(k) > 1e-12 else math.inf
    deviation = math.sqrt(covariance[0, 0]) / abs(k)
    if deviation > 0.1:
        what = f"the scale stays uncertain by {100 * deviation:.0f} %"
        fix = "Walk with turns for half a minute; give more of the log."
        raise WearcapError(what, where="scale from the head's sensor", expected="at most 10 %", fix=fix)
    if k <= 0 or abs(length / GRAVITY - 1) > _GRAVITY_SHARE:
        what = f"gravity of {length:.2f} m/s² and a scale of {1 / k:.3g}"
        expected = "9.81 m/s² and a scale above 0"
        fix = "Check the unit of the accelerations, how the sensor sits on the camera, and the clocks."
        raise WearcapError(what, where="scale from the head's sensor", expected=expected, fix=fix)
    direction = up / np.linalg.norm(up)
    across = np.eye(3) - np.outer(direction, direction)
    turn = across @ covariance[1:4, 1:4] @ across / (up @ up)
    return _upright(direction, 1 / k, deviation, math.sqrt(np.trace(turn)))


def _alike(slam: Trajectory, imu: ImuStream, T_cam_imu: Rigid) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Second differences of the camera's path, the specific force through the same filter, R_slam_imu, and frame rate.

    (p(t-h) + p(t+h) - 2p(t)) / h² is the acceleration under a triangle of half-width h; so the forces go under one, too.
    """
    if imu.acc_imu is None:
        raise WearcapError("a stream without acc_imu", where="the head's sensor", expected="specific force (m/s²)")
    start, stop = max(slam.timestamps[0], imu.timestamps[0]), min(slam.timestamps[-1], imu.timestamps[-1])
    if stop - start < 10:
        what = f"camera and sensor share {max((stop - start).item(), 0):.1f} s"
        fix = "Bring both to one clock, and walk for longer."
        raise WearcapError(what, where="scale from the head's sensor", expected="10 s or more", fix=fix)
    if len(gaps := find_gaps(slam.timestamps, 0.5)):
        what = f"the camera is lost at {slam.timestamps[gaps[0]].item():.2f} s"
        fix = "Give a part without gaps."
        raise WearcapError(what, where="scale from the head's sensor", expected="poses without gaps", fix=fix)
    step, fine = slam.timestamps.diff().median().item(), 4
    n = max(round(_HALF_S / step), 1)
    # On the camera's frames: between them positions would be interpolated, which flattens them.
    first = slam.timestamps[torch.searchsorted(slam.timestamps, start)].item()
    dense = torch.arange(first, stop.item(), step / fine, dtype=torch.float64)
    poses = resample(Trajectory(slam.timestamps, slam.R_world_body.double(), slam.t_world_body.double()), dense)
    R = poses.R_world_body @ T_cam_imu.R.double()
    force = interpolate(imu.timestamps, imu.acc_imu.double(), dense)
    force_slam = (R @ force[..., None])[..., 0].numpy()
    triangle = np.bartlett(2 * n * fine + 1)
    force_slam, turned = (
        scipy.ndimage.convolve1d(value, triangle / triangle.sum(), axis=0)[::fine]
        for value in (force_slam, R.numpy().reshape(-1, 9))
    )
    swung = acceleration((poses.R_world_body @ T_cam_imu.t.double())[::fine], 1 / step, n).numpy()
    a_slam = acceleration(poses.t_world_body[::fine], 1 / step, n).numpy()
    inner = slice(n, len(a_slam) - n)
    return a_slam[inner], (force_slam - swung)[inner], turned.reshape(-1, 3, 3)[inner], 1 / step


def by_floor(
    slam: Trajectory, points_slam: Float[Tensor, "point 3"], standing: Stretch, height_m: float
) -> SlamAlignment:
    """Scale and vertical (`_upright`) from the floor below the path, and the camera's height above it while standing (m).

    The floor is the plane with most points below the path (RANSAC, then total least squares), at most 35° from the
    camera's mean level. Standard deviations by a bootstrap over patches of the floor, with 5 mm of the measured
    height. Raises WearcapError when too few points lie on a plane, or for an implausible height.
    """
    if not 0.5 < height_m < 2.5:
        what = f"a standing height of {height_m} m"
        raise WearcapError(what, where="scale from the floor", expected="0.5 m to 2.5 m")
    random = np.random.default_rng(0)
    eyes = slam.t_world_body[during(slam.timestamps, standing, "standing", 1.0)].double().mean(0).numpy()
    rough = -slam.R_world_body[:, :, 1].double().mean(0).numpy()
    rough /= np.linalg.norm(rough)
    points, path, across = (
        points_slam.double().numpy(),
        slam.t_world_body.double().numpy(),
        np.eye(3) - np.outer(rough, rough),
    )
    distance, nearest = KDTree(path @ across).query(points @ across)
    drop = (path[nearest] - points) @ rough
    below = (drop > 0) & (distance < 1.2 * drop)  # within 50° of vertically below the path
    floor = _floor_points(points[below], eyes, rough, random)
    up, height = _plane(floor, eyes)
    patch = np.unique(np.floor(floor / (height / 4)).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    members = np.split(np.argsort(patch, kind="stable"), np.cumsum(np.bincount(patch))[:-1])
    turns, scales = [], []
    for _ in range(200):
        drawn = np.concatenate([members[k] for k in random.integers(0, len(members), len(members))])
        up_k, height_k = _plane(floor[drawn], eyes)
        turns.append(math.acos(min(up @ up_k, 1.0)))
        scales.append((height_m + 0.005 * random.standard_normal()) / height_k)
    scale = height_m / height
    return _upright(up, scale, float(np.std(scales)) / scale, math.sqrt(np.mean(np.square(turns))))


def _floor_points(points: np.ndarray, eyes: np.ndarray, rough: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Points of the plane with most support; a point counts within 2 % of the camera's height above it."""
    best = np.zeros(len(points), bool)
    for _ in range(500 if len(points) >= 30 else 0):
        a, b, c = points[random.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 or abs(normal @ rough) < math.cos(math.radians(35)) * length:
            continue
        normal *= np.sign(normal @ rough) / length
        height = (eyes - a) @ normal
        near = np.abs((points - a) @ normal) < 0.02 * height
        best = near if near.sum() > best.sum() else best
    for _ in range(3):
        if best.sum() < 30:
            what = f"{int(best.sum())} of {len(points)} points below the path lie on one plane"
            fix = "Look at the floor while walking, or use the board."
            raise WearcapError(what, where="scale from the floor", expected="30 or more", fix=fix)
        up, height = _plane(points[best], eyes)
        best = np.abs((points - eyes) @ up + height) < 0.02 * height
    return points[best]


def _plane(points: np.ndarray, eyes: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit normal of the points' plane towards the eyes, and their height above it."""
    middle = points.mean(0)
    normal = np.linalg.eigh(np.cov((points - middle).T))[1][:, 0]
    height = float((eyes - middle) @ normal)
    return (normal, height) if height > 0 else (-normal, -height)


def _upright(up: np.ndarray, scale: float, scale_std: float, gravity_std: float) -> SlamAlignment:
    """The least turn that puts z up, so that the heading stays the SLAM's, about its origin; deviations as a share and in
    rad."""
    R = swing_between(torch.from_numpy(up.copy()), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    deviations = {"scale_std": float(scale_std), "gravity_std_deg": math.degrees(gravity_std)}
    return SlamAlignment(float(scale), R, torch.zeros(3, dtype=torch.float64), **deviations)
