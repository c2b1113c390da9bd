"""How tall a wearer is, from how high the head is carried while upright."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.skeleton import Skeleton, skeleton_of_height
from wearcap.errors import WearcapError
from wearcap.recording import Recording
from wearcap.scene.floor import estimate_floor
from wearcap.tracking.floor import CARRIED, MIN_POINTS, UPRIGHT_WITHIN_S

UPRIGHT = 0.9
"""Quantile of the head's height over the floor that is taken for upright, as in `tracking.floor.floor_from_path`."""
CONFIDENT = 0.3
"""Least confidence of the floor's height for a frame to count."""
LEAST_S = 5.0
"""Least time (s) over a known floor."""
POSTURE_M = 0.025
"""Deviation (m) of the height that remains on long recordings: posture, shoes, seat of the device, proportions."""
HEIGHTS_M = (1.2, 2.2)
"""Heights that are believed."""
SEATED_M = (0.6, 1.4, 1.5)
"""Heights of standing people with heads as high as of people who sit: on the floor; at most; at most if they are tall."""
WALK_M, WALK_S, WALKED_S = 0.8, 2.0, 2.5
"""A head that moves that far (m) within that time (s), for that long (s), walks; trackers that start anew seem to for `WALK_S`."""
UNKNOWN = {
    "seated": "seated: the height is not known",
    "seated?": "seated, or a small wearer who stays in one place? The height is not known",
    "unknown": "the height is not known",
}


@dataclass(frozen=True)
class Stature:
    """A wearer's height, and where it is from."""

    height_m: float
    """The height, or the one that is assumed."""
    deviation_m: float
    """Expected error (m); 0 for a height that was given."""
    source: str
    """"given", "skeleton", "head" or "walk", or a key of `UNKNOWN`."""

    @property
    def known(self) -> bool:
        return self.source not in UNKNOWN

    def __str__(self) -> str:
        if not self.known:
            return f"{UNKNOWN[self.source]}, {self.height_m:.2f} m is assumed"
        if self.source == "head":
            small = "; a child, or somebody who sits?" if self.height_m < SEATED_M[1] else ""
            return f"{self.height_m:.2f} ± {self.deviation_m:.2f} m, from how high the head is carried{small}"
        if self.source == "walk":
            return f"{self.height_m:.2f} ± {self.deviation_m:.2f} m, from how high the head is carried and how knees bear weight"
        return f"{self.height_m:.2f} m, {'as given' if self.source == 'given' else 'of its skeleton'}"


def with_stature(
    recording: Recording, default: Skeleton, height_m: float | None = None, skeleton: Skeleton | None = None
) -> tuple[Recording, Stature]:
    """The recording with the skeleton of its wearer's height, and that height.

    A given height (m) and skeleton come first, then the skeleton that the recording has, then `estimate_stature`; where none
    is known, the recording is returned as it is. Raises WearcapError for a height that is no person's.
    """
    if skeleton is not None:
        recording = replace(recording, skeleton=skeleton)
    if height_m is not None:
        skeleton = skeleton_of_height(height_m, skeleton_of(recording) or default)
        return replace(recording, skeleton=skeleton), Stature(height_m, 0.0, "given")
    own = skeleton_of(recording)
    if own is not None:
        return recording, Stature(own.stature, 0.0, "skeleton")
    found = estimate_stature(recording, default)
    if found.known:
        recording = replace(recording, skeleton=skeleton_of_height(found.height_m, default))
    return recording, found


def estimate_stature(recording: Recording, skeleton: Skeleton) -> Stature:
    """Height of a wearer whose head joint stands over a known floor as high as people of `skeleton`, scaled, carry it.

    The floor is the recording's own, else that below its points. Not known without a head path or floor, over less than
    `LEAST_S`, of somebody who sits (`source_of`), and outside `HEIGHTS_M`.
    """
    unknown, head, floor = Stature(skeleton.stature, math.inf, "unknown"), recording.head, _floor_below(recording)
    if head is None or floor is None:
        return unknown
    t_world_head, times = head.T_world_head.t, head.timestamps
    step_s, known = times.diff().median().item(), floor.isfinite() & t_world_head.isfinite().all(-1)
    t_world_head, times, floor = t_world_head[known], times[known], floor[known]
    if len(times) * step_s < LEAST_S:
        return unknown
    pieces = (t_world_head[:, 2] - floor).split(max(round(UPRIGHT_WITHIN_S / step_s), 1))
    upright = torch.stack([piece.quantile(UPRIGHT) for piece in pieces if len(piece) * step_s >= LEAST_S])
    high = upright.quantile(0.75)  # in half of the half-minutes people may sit
    if height_over(high.item(), skeleton) < SEATED_M[2]:
        high = upright.max()  # or in all but one
    near = upright[(upright - high).abs() < 0.1]
    height_m = height_over(near.median().item(), skeleton)
    source = source_of(height_m, times, t_world_head)
    if source != "head":
        return replace(unknown, source=source)
    spread = near.std().item() if len(near) > 1 else 0.0
    return Stature(height_m, (POSTURE_M**2 + spread**2) ** 0.5, "head")


def height_over(above_m: float, skeleton: Skeleton, carried: float = CARRIED) -> float:
    """Height (m) of somebody with the proportions of `skeleton` whose head joint is `above_m` over the floor while upright.

    `carried` is that height as a share of the joint's in the rest pose: 1 for somebody who is asked to stand straight.
    """
    return above_m * skeleton.stature / (carried * skeleton.height_of("head"))


def source_of(
    height_m: float, timestamps: Float64[Tensor, "time"], t_world_head: Float[Tensor, "time 3"]
) -> Literal["head", "seated", "seated?", "unknown"]:
    """Where the height comes from of a wearer who would be `height_m` tall if the head's path were upright.

    A head that never walks, no higher than sitters', shows none: "seated", "seated?" where small adults stand as high.
    """
    if height_m >= SEATED_M[2]:
        return "head" if height_m <= HEIGHTS_M[1] else "unknown"
    later = torch.searchsorted(timestamps, timestamps + WALK_S).clamp(max=len(timestamps) - 1)
    far = (t_world_head[later] - t_world_head)[:, :2].norm(dim=-1) > WALK_M
    if far.sum() * timestamps.diff().median() > WALKED_S:
        return "head" if height_m >= HEIGHTS_M[0] else "unknown"
    return "unknown" if height_m < SEATED_M[0] else "seated" if height_m < SEATED_M[1] else "seated?"


def _floor_below(recording: Recording) -> Float[Tensor, "time"] | None:
    """Height (m) of the floor below each pose of the head, NaN where it is not sure; None if it is nowhere known."""
    head, points = recording.head, recording.points
    if head is None or len(head.timestamps) < 2:
        return None
    if recording.floor is not None and len(recording.floor.timestamps):
        nearest = torch.searchsorted(recording.floor.timestamps, head.timestamps)
        return recording.floor.height[nearest.clamp(max=len(recording.floor.height) - 1)]
    if points is None or len(points.points_world) < MIN_POINTS:
        return None
    try:
        below = estimate_floor(points.points_world, head.T_world_head.t)
    except WearcapError:
        return None
    return below.height.where(below.confidence >= CONFIDENT, torch.nan)


def skeleton_of(recording: Recording) -> Skeleton | None:
    """The wearer's skeleton, as the recording or one of its motions has it."""
    motions = [motion.skeleton for motion in (recording.motion, recording.suit) if motion is not None]
    return recording.skeleton or next(iter(motions), None)
