"""The head's path at a constant frame rate, the input of every head-driven system."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.recording import Recording
from wearcap.recording.recording import MIN_DURATION_S
from wearcap.tracking.floor import floor_from_path

MAX_GAP_S = 0.5
"""Longest interval (s) between head poses that is interpolated; a longer one is a gap, after which capture restarts."""


MAX_FILL = 600
"""Largest ratio of frames at the model's rate to head poses; above it the timestamps are not in seconds."""


MAX_SPEED_M_S = 12.0
"""Highest plausible speed of a head (faster than sprinters); a faster step is a jump of the tracking."""


@dataclass(frozen=True)
class HeadPath:
    """One recording's head path at the model's frame rate, with the wearer's skeleton and the floor below."""

    timestamps: Float64[Tensor, "time"]
    T_world_head: Rigid
    T_world_device: Rigid
    floor_height: Float[Tensor, "time"]
    """Floor height (m) below the head, estimated from the head's path alone."""
    skeleton: Skeleton
    stretches: tuple[tuple[int, int], ...]
    """Frame ranges (start, stop) between gaps and jumps of the tracking; head poses in the gaps are interpolated."""

    @property
    def stature(self) -> float:
        """Height of the head joint in the rest pose (m)."""
        return self.skeleton.height_of("head")

    @property
    def held_frames(self) -> Int64[Tensor, "time"]:
        """Index into the concatenated stretches for each frame; frames in a gap repeat the last index before it."""
        frames = torch.cat([torch.arange(start, stop) for start, stop in self.stretches])
        count = len(self.timestamps)
        return torch.searchsorted(frames, torch.arange(count), right=True).sub(1).clamp_min(0)


def head_path(recording: Recording, fallback: Skeleton, fps: float) -> HeadPath:
    """Step 1: the head joint's path at `fps` and the floor below it. Poses that are not finite count as missing.

    Raises WearcapError when the head stream is missing or too short, for timestamps that do not increase, for matrices
    that are not rotations, and for too few poses for their time span.
    """
    if recording.head is None:
        raise WearcapError(
            "no head poses in this recording", where=recording.name, expected="a recording with a `head` stream"
        )
    head = recording.head
    finite = head.R_world_device.isfinite().all(-1).all(-1) & head.t_world_device.isfinite().all(-1)
    times = head.timestamps[finite]
    if len(times) < 2 or times[-1] - times[0] < MIN_DURATION_S:
        raise WearcapError(
            f"head poses of {len(times)} frames", where=recording.name, expected=f"at least {MIN_DURATION_S} s"
        )
    if not (times.diff() > 0).all():
        raise WearcapError(
            "head poses whose timestamps do not grow",
            where=recording.name,
            fix="Sort the head stream by time and leave repeated poses out.",
        )
    _require_plausible(head.R_world_device[finite], times, fps, recording.name)
    skeleton = recording.skeleton or (recording.motion.skeleton if recording.motion else fallback)
    trajectory = Trajectory(times, head.R_world_device[finite], head.t_world_device[finite])
    broken = breaks(trajectory)
    count = int((times[-1] - times[0]).item() * fps + 1e-3) + 1
    timestamps = times[0] + torch.arange(count, dtype=torch.float64) / fps
    if count != len(times) or (timestamps - times).abs().max() > 1e-4:
        trajectory = resample(trajectory, timestamps.clamp_max(times[-1].item()))
    T_device_head = Rigid(head.R_head_device, head.t_head_device).inverse()
    T_world_head = trajectory.T_world_body @ T_device_head
    floor = floor_from_path(timestamps, T_world_head.t, skeleton.height_of("head"))
    stretches, first = [], 0
    for before, after in broken:
        stretches.append((first, int(torch.searchsorted(timestamps, before + 1e-6))))
        first = int(torch.searchsorted(timestamps, after - 1e-6))
    stretches.append((first, count))
    return HeadPath(
        timestamps,
        T_world_head,
        trajectory.T_world_body,
        floor,
        skeleton,
        tuple((start, stop) for start, stop in stretches if stop > start),
    )


def _require_plausible(
    R_world_device: Float[Tensor, "time 3 3"], times: Float64[Tensor, "time"], fps: float, name: str
) -> None:
    """Raise WearcapError for matrices that are not rotations, and for timestamps that are not in seconds."""
    skewed = (R_world_device.transpose(-1, -2) @ R_world_device - torch.eye(3)).abs().amax((-1, -2)) > 0.05
    if skewed.any():
        raise WearcapError(
            f"the head pose at {times[skewed][0].item():.3f} s is no rotation",
            where=name,
            expected="orthonormal matrices",
            fix="Run `wearcap doctor` on the recording.",
        )
    span = (times[-1] - times[0]).item()
    if span * fps > MAX_FILL * len(times):
        raise WearcapError(
            f"{len(times)} head poses over {span:.0f} s",
            where=name,
            expected=f"one in {MAX_FILL / fps:.0f} s at least",
            fix="Give timestamps in seconds, or cut the recording at its pauses.",
        )


def breaks(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Gaps and jumps of a trajectory, each as the times of the last pose before and the first pose after it."""
    step = trajectory.timestamps.diff()
    speed = trajectory.t_world_body.diff(dim=0).norm(dim=-1) / step
    turn = rotation.geodesic(trajectory.R_world_body[:-1], trajectory.R_world_body[1:]) / step
    broken = (step > MAX_GAP_S) | (speed > MAX_SPEED_M_S) | (turn > 60.0)
    return [
        (trajectory.timestamps[i].item(), trajectory.timestamps[i + 1].item()) for i in broken.nonzero()[:, 0].tolist()
    ]
