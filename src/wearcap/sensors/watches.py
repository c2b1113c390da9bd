"""Two watches as MocapEvery's estimator wants them: on the camera's clock, filtered, as joints (§4.1, appendix C.1)."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import find_gaps
from wearcap.recording import ImuStream

WRISTS = ("left_wrist", "right_wrist")
MAX_GAP_S = 0.5
"""Longer silence of a watch is not bridged."""
FILTER = 7
"""Frames of the mean filter."""
_HANGING = 0.25
"""Mean share of the vertical along the forearms from which one can tell left from right."""


def watches_at(
    streams: Mapping[str, ImuStream], timestamps: Float64[Tensor, "time"], where: str
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
    """Orientation of the wrist joints and their filtered free acceleration (m/s²) at an even clock's times.

    Orientations turn evenly between samples (slerp); accelerations are averaged over each frame, then over 7 frames.
    Raises WearcapError for a watch that is missing, silent at some of the times, or says neither orientation nor
    acceleration, and for watches that are worn on the wrong arms.
    """
    worn = []
    for joint in WRISTS:
        if joint not in streams:
            raise WearcapError(f"no watch on {joint}", where=where, expected=" and ".join(WRISTS),
                               fix="Give both watches, or capture with the head alone: pipeline=hmd2.")  # fmt: skip
        stream = streams[joint]
        if stream.R_world_imu is None or stream.acc_world is None:
            raise WearcapError("a watch without orientation or free acceleration", where=f"{where}, {joint}", expected="both")  # fmt: skip
        _require_awake(stream.timestamps, timestamps, f"{where}, {joint}")
        worn.append(stream)
    step = timestamps.diff().median().item() if len(timestamps) > 1 else 0.0
    frames = torch.arange(-(FILTER // 2), len(timestamps) + FILTER // 2).clamp(0, len(timestamps) - 1)
    R_world_wrist, acc_world = filtered(worn, timestamps, timestamps[frames], step)
    require_sides(R_world_wrist, where)
    return R_world_wrist, acc_world


def filtered(
    streams: Sequence[ImuStream],
    timestamps: Float64[Tensor, "time"],
    around: Float64[Tensor, "more"],
    step_s: float,
) -> tuple[Float[Tensor, "time wrist 3 3"], Float[Tensor, "time wrist 3"]]:
    """The same of watches that are known to be awake. `around` has the frames that the filter sees: the times with
    `FILTER` // 2 more on either side. Beyond a watch's time its first or last word stands."""
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
        accelerations.append(_averaged(times, acc, around, step_s).unfold(0, FILTER, 1).mean(-1))
    step, share = (torch.stack(part, 1) for part in zip(*turn))
    R_world_wrist = torch.stack(before, 1) @ rotation.exp(share[..., None] * rotation.log(step))
    return R_world_wrist, torch.stack(accelerations, 1)


def require_sides(R_world_wrist: Float[Tensor, "time wrist 3 3"], where: str) -> None:
    """Raise WearcapError when the watches are worn the wrong way round.

    Arms hang most of the time: the left forearm's axis (+y of a T-pose) then points down, the right one's up.
    """
    up = R_world_wrist[:, :, 2, 1].mean(0)
    if up[0] > _HANGING and up[1] < -_HANGING:
        raise WearcapError("the watches seem to be swapped: both forearms would point up most of the time", where=where,
                           fix="Exchange the logs of the left and the right watch, or calibrate them again.")  # fmt: skip


def _require_awake(times: Tensor, asked: Tensor, where: str) -> None:
    """Raise WearcapError when the watch is silent at some of the times."""
    step = times.diff()
    if len(times) < 2 or (step <= 0).any():
        raise WearcapError("times of a watch that do not grow", where=where,
                           fix="Sort its samples by time and leave repeated ones out.")  # fmt: skip
    early, late = (times[0] - asked[0]).item(), (asked[-1] - times[-1]).item()
    if early > MAX_GAP_S or late > MAX_GAP_S:
        raise WearcapError(
            f"the watch logged from {times[0].item():.2f} s to {times[-1].item():.2f} s", where=where,
            expected=f"{asked[0].item():.2f} s to {asked[-1].item():.2f} s, as the camera did",
            fix="Put both on one clock (wearcap calibrate), or cut the recording to what they share.")  # fmt: skip
    gaps = find_gaps(times, MAX_GAP_S)
    inside = [g for g in gaps.tolist() if times[g + 1] > asked[0] and times[g] < asked[-1]]
    if inside:
        first = inside[0]
        raise WearcapError(
            f"the watch is silent, or its clock jumps, for {step[first].item():.2f} s at {times[first].item():.2f} s "
            f"({len(inside)} such gaps)", where=where, expected=f"no gap above {MAX_GAP_S} s",
            fix="Cut the recording there.")  # fmt: skip


def _averaged(
    times: Float64[Tensor, "sample"],
    value: Float[Tensor, "sample 3"],
    at: Float64[Tensor, "time"],
    step_s: float,
) -> Float[Tensor, "time 3"]:
    """Mean over the frame around each time, of what is taken as linear between samples: whatever the watch's rate."""
    step = times.diff()[:, None]
    area = torch.cat(
        [value.new_zeros(1, 3).double(), ((value[1:] + value[:-1]).double() / 2 * step).cumsum(0)]
    )
    edges = torch.stack([at - step_s / 2, at + step_s / 2]).clamp(times[0].item(), times[-1].item())
    after = torch.searchsorted(times, edges.contiguous(), right=True).clamp(1, len(times) - 1)
    before = after - 1
    share = (edges - times[before])[..., None]
    slope = (value[after] - value[before]).double() / (times[after] - times[before])[..., None]
    upto = area[before] + share * (value[before].double() + slope * share / 2)
    span = (edges[1] - edges[0])[:, None]
    inside = (upto[1] - upto[0]) / span.clamp_min(1e-9)
    # Beyond the watch's time its first or last word stands.
    outside = value[torch.where(at < times[0], 0, len(times) - 1)].double()
    return torch.where(span > 1e-6, inside, outside).to(value.dtype)
