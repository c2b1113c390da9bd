"""Timed poses of one body: resampling, velocities, outliers, gaps, smoothing."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid


@dataclass(frozen=True)
class Trajectory:
    """Poses of a body in the world over time (timestamps in s, rising; translations in m)."""

    timestamps: Float64[Tensor, "time"]
    R_world_body: Float[Tensor, "time 3 3"]
    t_world_body: Float[Tensor, "time 3"]

    @property
    def T_world_body(self) -> Rigid:
        return Rigid(self.R_world_body, self.t_world_body)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index) -> "Trajectory":
        """Frames by slice, index tensor or mask."""
        return Trajectory(self.timestamps[index], self.R_world_body[index], self.t_world_body[index])


def finite_difference(
    value: Float[Tensor, "time *rest"], timestamps: Float64[Tensor, "time"]
) -> Float[Tensor, "time *rest"]:
    """Backward difference per second; the first frame repeats the second's (one frame: zero)."""
    if len(value) < 2:
        return torch.zeros_like(value)
    dt = timestamps.diff().to(value.dtype).reshape(-1, *[1] * (value.ndim - 1))
    velocity = value.diff(dim=0) / dt
    return torch.cat([velocity[:1], velocity])


def require_rising(timestamps: Float64[Tensor, "time"]) -> None:
    """Raise WearcapError, naming the first bad frame, unless timestamps are finite and strictly rising."""
    steps = timestamps.diff()
    for bad, word in (
        (~timestamps.isfinite(), "is not a number"),
        (torch.cat([steps.new_ones(1), steps])[: len(timestamps)] == 0, "repeats the one before"),
        (torch.cat([steps.new_ones(1), steps])[: len(timestamps)] < 0, "lies before its predecessor"),
    ):
        if bad.any():
            frame = int(bad.nonzero()[0])
            what = f"the timestamp of frame {frame} ({timestamps[frame].item():.6f} s) {word}"
            expected = "strictly rising timestamps in seconds"
            raise WearcapError(what, expected=expected, fix="Sort the frames and drop duplicates.")


def interpolate(
    timestamps: Float64[Tensor, "time"], value: Float[Tensor, "time *rest"], at: Float64[Tensor, "new_time"]
) -> Float[Tensor, "new_time *rest"]:
    """Values at other times, by linear interpolation. Raises WearcapError for times outside, as `resample`."""
    require_rising(timestamps)
    if not len(timestamps):
        raise WearcapError("nothing to resample", expected="at least one frame")
    slack = timestamps.diff().median().item() if len(timestamps) > 1 else 0.0
    outside = ~((at >= timestamps[0] - slack) & (at <= timestamps[-1] + slack))
    if outside.any():
        what = f"{int(outside.sum())} of {len(at)} times, first {at[outside][0].item():.3f} s, lie outside the stream"
        raise WearcapError(what, expected=f"times from {timestamps[0].item():.3f} s to {timestamps[-1].item():.3f} s")
    return _lerp(value, *_brackets(timestamps, at))


def slerp(
    timestamps: Float64[Tensor, "time"], R: Float[Tensor, "time *rest 3 3"], at: Float64[Tensor, "new_time"]
) -> Float[Tensor, "new_time *rest 3 3"]:
    """Rotations at any times, at constant angular velocity between frames; beyond the ends they are constant."""
    before, after, blend = _brackets(timestamps, at)
    return rotation.between(R[before], R[after], blend.to(R.dtype).reshape(-1, *[1] * (R.ndim - 3)))


def interpolate_clamped(
    timestamps: Float64[Tensor, "time"], value: Float[Tensor, "time *rest"], at: Float64[Tensor, "*new"]
) -> Float[Tensor, "..."]:
    """Values (of shape `*new *rest`) at any times, by linear interpolation; beyond the ends they are constant."""
    if len(timestamps) == 1:
        return value[0].expand(*at.shape, *value.shape[1:]).clone()
    right = torch.searchsorted(timestamps, at.contiguous()).clamp(1, len(timestamps) - 1)
    share = ((at - timestamps[right - 1]) / (timestamps[right] - timestamps[right - 1])).clamp(0, 1)
    share = share.to(value.dtype).reshape(*at.shape, *[1] * (value.ndim - 1))
    return value[right - 1] + share * (value[right] - value[right - 1])


def nearest_frames(timestamps: Float64[Tensor, "time"], at: Float64[Tensor, "new_time"]) -> Int64[Tensor, "new_time"]:
    """Index of the frame nearest to each time, at any distance."""
    return torch.searchsorted((timestamps[1:] + timestamps[:-1]) / 2, at.contiguous())


def resample(trajectory: Trajectory, timestamps: Float64[Tensor, "new_time"]) -> Trajectory:
    """Poses at other times: linear in translation, slerp in rotation.

    The end poses are extended by up to one median frame step outside the trajectory; times further outside, and
    timestamps that do not rise, raise WearcapError.
    """
    t = interpolate(trajectory.timestamps, trajectory.t_world_body, timestamps)
    return Trajectory(timestamps, slerp(trajectory.timestamps, trajectory.R_world_body, timestamps), t)


def _lerp(value: Tensor, before: Tensor, after: Tensor, blend: Tensor) -> Tensor:
    return torch.lerp(value[before], value[after], blend.to(value.dtype).reshape(-1, *[1] * (value.ndim - 1)))


def _brackets(timestamps: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Frames before and after each time, and how far between them it lies (0…1)."""
    after = torch.searchsorted(timestamps, at.contiguous(), right=True).clamp(max=len(timestamps) - 1)
    before = (after - 1).clamp(min=0)
    span = timestamps[after] - timestamps[before]
    blend = (at - timestamps[before]) / torch.where(span > 0, span, 1.0)
    return before, after, blend.clamp(0, 1)


def linear_velocity(trajectory: Trajectory) -> Float[Tensor, "time 3"]:
    """Velocity in the world (m/s) by central differences, one-sided at the ends (one frame: zero)."""
    first, last, dt = _central(trajectory)
    return (trajectory.t_world_body[last] - trajectory.t_world_body[first]) / dt


def angular_velocity(trajectory: Trajectory) -> Float[Tensor, "time 3"]:
    """Angular velocity in the world's axes (rad/s) by central differences; turns under π per two frames."""
    first, last, dt = _central(trajectory)
    R = trajectory.R_world_body
    return rotation.log(R[last] @ R[first].mT) / dt


def _central(trajectory: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
    require_rising(trajectory.timestamps)
    frame = torch.arange(len(trajectory), device=trajectory.timestamps.device)
    first, last = (frame - 1).clamp(min=0), (frame + 1).clamp(max=max(len(trajectory) - 1, 0))
    span = trajectory.timestamps[last] - trajectory.timestamps[first]
    return first, last, torch.where(span > 0, span, 1.0).to(trajectory.t_world_body.dtype)[:, None]


def pieces(cut: Bool[Tensor, "step"]) -> tuple[Int64[Tensor, "frame"], Int64[Tensor, "piece"], Bool[Tensor, "piece"]]:
    """Piece of each frame of a track that is cut at some steps, the pieces' numbers of frames, and which of them are not
    longer than their neighbours (never the longest one)."""
    piece = torch.cat([cut.new_zeros(1), cut]).cumsum(0)
    length = torch.bincount(piece)
    wall = length.new_full((1,), len(piece) + 1)
    left, right = torch.cat([wall, length[:-1]]), torch.cat([length[1:], wall])
    return piece, length, ((length <= left) & (length <= right)).index_fill(0, length.argmax(), False)


def outlier_mask(trajectory: Trajectory, max_speed: float) -> Bool[Tensor, "time"]:
    """Mask of valid frames: neighbouring valid frames are at most as far apart as `max_speed` (m/s) allows.

    The track is cut where the speed is exceeded. Pieces not longer than their neighbouring pieces are dropped, the
    neighbours are joined, and this repeats until no cut is left; then dropped frames that agree with their valid
    neighbours are restored (thesis §4, initialisation, 3 m/s). A block of wrong positions is thus dropped as a whole
    without good neighbours. Frames with positions that are not finite are never valid.
    """
    require_rising(trajectory.timestamps)
    position, time = trajectory.t_world_body.double(), trajectory.timestamps
    finite = position.isfinite().all(-1)
    kept = finite.nonzero()[:, 0]
    while len(kept) > 1:
        cut = position[kept].diff(dim=0).norm(dim=-1) > max_speed * time[kept].diff()
        if not cut.any():
            break
        piece, _, short = pieces(cut)
        kept = kept[~short[piece]]
    valid = torch.zeros_like(finite)
    valid[kept] = True
    if not len(kept):
        return valid
    # Candidates, from first to last, must be near enough to the next valid frame and to the previous one, which may be
    # a candidate that was just accepted.
    frame = (finite & ~valid).nonzero()[:, 0]
    stretch = torch.searchsorted(kept, frame)
    following = kept[stretch.clamp(max=len(kept) - 1)]
    distance = (position[frame] - position[following]).norm(dim=-1)
    near = (stretch == len(kept)) | (distance <= max_speed * (time[following] - time[frame]))
    frame, stretch = frame[near], stretch[near]
    before = torch.where(stretch > 0, kept[(stretch - 1).clamp(min=0)], -1).tolist()
    p, t, taken, last = position.tolist(), time.tolist(), [], -1
    # One after the other: each answer depends on the one before.
    for now, last_kept in zip(frame.tolist(), before):
        last = max(last, last_kept)
        if last < 0 or math.dist(p[now], p[last]) <= max_speed * (t[now] - t[last]):
            taken.append(now)
            last = now
    valid[torch.tensor(taken, dtype=torch.int64, device=position.device)] = True
    return valid


def filled(trajectory: Trajectory, valid: Bool[Tensor, "time"]) -> Trajectory:
    """The same timestamps with invalid frames interpolated from valid ones (constant beyond the ends)."""
    if not valid.any():
        raise WearcapError("no valid pose to interpolate from", expected="at least one valid frame")
    good = trajectory[valid]
    t = _lerp(good.t_world_body, *_brackets(good.timestamps, trajectory.timestamps))
    R = slerp(good.timestamps, good.R_world_body, trajectory.timestamps)
    return Trajectory(trajectory.timestamps, R, t)


def find_gaps(timestamps: Float64[Tensor, "time"], max_step_s: float) -> Int64[Tensor, "gap"]:
    """Frames after which the next one comes later than `max_step_s`."""
    require_rising(timestamps)
    return (timestamps.diff() > max_step_s).nonzero()[:, 0]


def smooth(trajectory: Trajectory, sigma_s: float) -> Trajectory:
    """Gaussian-weighted mean over time (standard deviation in s): arithmetic for t, chordal for R."""
    require_rising(trajectory.timestamps)
    if len(trajectory) < 2 or sigma_s <= 0:
        return trajectory
    reach = int(3 * sigma_s / trajectory.timestamps.diff().median().item()) + 1
    reach = min(reach, len(trajectory) - 1)
    frame = torch.arange(len(trajectory), device=trajectory.timestamps.device)
    near = frame[:, None] + torch.arange(-reach, reach + 1, device=frame.device)
    exists = (near >= 0) & (near < len(trajectory))
    near = near.clamp(0, len(trajectory) - 1)
    distance = (trajectory.timestamps[near] - trajectory.timestamps[:, None]) / sigma_s
    weight = (exists * torch.exp(-0.5 * distance**2)).to(trajectory.t_world_body.dtype)
    weight = weight / weight.sum(1, keepdim=True)
    t = torch.einsum("fk,fki->fi", weight, trajectory.t_world_body[near])
    R = torch.einsum("fk,fkij->fij", weight, trajectory.R_world_body[near])
    return Trajectory(trajectory.timestamps, rotation.nearest_rotation(R), t)
