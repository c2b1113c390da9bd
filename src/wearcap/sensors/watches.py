"""Preprocessing of two watches for MocapEvery: resampled to the camera's clock and filtered (§4.1, appendix C.1)."""

import warnings
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import find_gaps
from wearcap.recording import ImuStream

MAX_GAP_S = 0.5
"""Longest gap (s) between a watch's samples that is interpolated."""
FILTER = 7
"""Width of the mean filter, in frames."""
_HANGING = 0.25
"""Smallest mean vertical component of the forearm axes that tells left from right."""


def watches_at(
    streams: Mapping[str, ImuStream], timestamps: Float64[Tensor, "time"], where: str
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
    """Orientation and filtered free acceleration (m/s²) of the wrist joints at evenly spaced times.

    Orientations are interpolated by slerp; accelerations are averaged over each frame, then over 7 frames. Raises
    WearcapError for a watch that is missing or lacks orientation or acceleration; warns of gaps, during which a watch is
    taken as static, and of watches that may be worn on the wrong arms.
    """
    worn = []
    for joint in WRISTS:
        if joint not in streams:
            fix = "Give both watches, or capture with the head alone: pipeline=hmd2."
            raise WearcapError(f"no watch on {joint}", where=where, expected=" and ".join(WRISTS), fix=fix)
        stream, place = streams[joint], f"{where}, {joint}"
        times = stream.timestamps
        if stream.R_world_imu is None or stream.acc_world is None:
            what = "a watch without orientation or free acceleration"
            raise WearcapError(what, where=place, expected="both")
        steps = times.diff()
        if len(times) < 2 or (steps <= 0).any():
            fix = "Sort its samples by time and leave repeated ones out."
            raise WearcapError("times of a watch that do not grow", where=place, fix=fix)
        early, late = (times[0] - timestamps[0]).item(), (timestamps[-1] - times[-1]).item()
        if early > MAX_GAP_S or late > MAX_GAP_S:
            what = f"the watch logged from {times[0].item():.2f} s to {times[-1].item():.2f} s"
            expected = f"{timestamps[0].item():.2f} s to {timestamps[-1].item():.2f} s, as the camera did"
            fix = "Put both on one clock (wearcap calibrate), or cut the recording to what they share."
            raise WearcapError(what, where=place, expected=expected, fix=fix)
        worn.append(bridged(stream))
    for gap in watch_gaps(streams, timestamps):
        warnings.warn(f"{where}: {gap}", stacklevel=2)
    step = timestamps.diff().median().item() if len(timestamps) > 1 else 0.0
    frames = torch.arange(-(FILTER // 2), len(timestamps) + FILTER // 2).clamp(0, len(timestamps) - 1)
    R_world_wrist, acc_world = filtered(worn, timestamps, timestamps[frames], step)
    if _point_up(R_world_wrist):  # as do 9 of CMU's 165 training recordings, with raised arms: no ground for refusal
        warnings.warn(f"{where}: forearms point up most of the time: raised arms, or swapped watches", stacklevel=2)
    return R_world_wrist, acc_world


def bridged(stream: ImuStream) -> ImuStream:
    """The stream with its gaps longer than `MAX_GAP_S` filled as streaming captures do: last orientation, no acceleration."""
    gaps = find_gaps(stream.timestamps, MAX_GAP_S)
    if not len(gaps):
        return stream
    times, step = stream.timestamps, stream.timestamps.diff().median()
    edge = torch.minimum(step, (times[gaps + 1] - times[gaps]) / 4)
    added = torch.stack([times[gaps] + edge, times[gaps + 1] - edge], 1).flatten()
    order = torch.cat([times, added]).argsort()
    rows = torch.cat([torch.arange(len(times)), gaps.repeat_interleave(2)])[order]
    acc = stream.acc_world
    if acc is not None:
        acc = torch.cat([acc, acc.new_zeros(len(added), 3)])[order]
    R = None if stream.R_world_imu is None else stream.R_world_imu[rows]
    return ImuStream(torch.cat([times, added])[order], stream.joint, R, acc, R_joint_imu=stream.R_joint_imu)


def watch_gaps(streams: Mapping[str, ImuStream], timestamps: Float64[Tensor, "time"]) -> list[str]:
    """A sentence for each watch that is silent while the camera records."""
    found = []
    for joint, stream in streams.items():
        times = stream.timestamps
        inside = [
            g
            for g in find_gaps(times, MAX_GAP_S).tolist()
            if times[g + 1] > timestamps[0] and times[g] < timestamps[-1]
        ]
        if inside:
            silent_s = sum((times[g + 1] - times[g]).item() for g in inside)
            found.append(
                f"the watch on {joint} is silent, or its clock jumps, {len(inside)} times for {silent_s:.2f} s in all, first "
                f"at {times[inside[0]].item():.2f} s: taken as static there"
            )
    return found


def filtered(
    streams: Sequence[ImuStream], timestamps: Float64[Tensor, "time"], around: Float64[Tensor, "more"], step_s: float
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
    """`watches_at` without checks. `around` holds the frames of the filter: the times with `FILTER` // 2 more on either
    side. Outside a watch's log its first or last sample is repeated."""
    before, turn, accelerations = [], [], []
    for stream in streams:
        times, R, acc = stream.timestamps, stream.R_world_imu, stream.acc_world
        assert R is not None
        assert acc is not None
        if stream.R_joint_imu is not None:
            R = R @ stream.R_joint_imu.mT
        after = torch.searchsorted(times, timestamps, right=True).clamp(1, len(times) - 1)
        share = (timestamps - times[after - 1]) / (times[after] - times[after - 1])
        before.append(R[after - 1])
        turn.append((R[after - 1].mT @ R[after], share.clamp(0, 1).to(R.dtype)))
        # Mean over the frame around each time, with linear interpolation between samples at any sample rate
        interval = times.diff()[:, None]
        area = torch.cat([acc.new_zeros(1, 3).double(), ((acc[1:] + acc[:-1]).double() / 2 * interval).cumsum(0)])
        edges = torch.stack([around - step_s / 2, around + step_s / 2]).clamp(times[0].item(), times[-1].item())
        later = torch.searchsorted(times, edges.contiguous(), right=True).clamp(1, len(times) - 1)
        earlier = later - 1
        into_s = (edges - times[earlier])[..., None]
        slope = (acc[later] - acc[earlier]).double() / (times[later] - times[earlier])[..., None]
        upto = area[earlier] + into_s * (acc[earlier].double() + slope * into_s / 2)
        span = (edges[1] - edges[0])[:, None]
        inside = (upto[1] - upto[0]) / span.clamp_min(1e-9)
        # Outside the watch's log its first or last sample is repeated.
        outside = acc[torch.where(around < times[0], 0, len(times) - 1)].double()
        mean = torch.where(span > 1e-6, inside, outside).to(acc.dtype)
        accelerations.append(mean.unfold(0, FILTER, 1).mean(-1))
    step, share = (torch.stack(part, 1) for part in zip(*turn))
    R_world_wrist = torch.stack(before, 1) @ rotation.exp(share[..., None] * rotation.log(step))
    return R_world_wrist, torch.stack(accelerations, 1)


def require_sides(R_world_wrist: Float[Tensor, "time wrist 3 3"], where: str) -> None:
    """Raise WearcapError when left and right watch are swapped, at a time when arms hang."""
    if _point_up(R_world_wrist):
        what = "the watches seem to be swapped: both forearms would point up most of the time"
        fix = "Exchange the logs of the left and the right watch, or calibrate them again."
        raise WearcapError(what, where=where, fix=fix)


def _point_up(R_world_wrist: Float[Tensor, "time wrist 3 3"]) -> bool:
    """Whether both forearms point up on the mean, as those of swapped watches do where arms hang.

    The left forearm's axis (+y of a T-pose) points down there, the right one's up.
    """
    up = R_world_wrist[:, :, 2, 1].mean(0)
    return bool(up[0] > _HANGING and up[1] < -_HANGING)
