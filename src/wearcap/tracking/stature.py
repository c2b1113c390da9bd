"""How tall a wearer is, from how high the head is carried while upright."""

from dataclasses import dataclass, replace

import torch

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
"""Heights that are believed; heads carried lower or higher belong to someone who sits, or to a wrong floor."""


@dataclass(frozen=True)
class Stature:
    """A wearer's height, and where it is from."""

    height_m: float
    deviation_m: float
    """Expected error (m); 0 for a height that was given."""
    source: str
    """"given", "skeleton" or "head"."""

    def __str__(self) -> str:
        if self.source == "head":
            return f"{self.height_m:.2f} ± {self.deviation_m:.2f} m, from how high the head is carried"
        return f"{self.height_m:.2f} m, {'as given' if self.source == 'given' else 'of its skeleton'}"


def with_stature(
    recording: Recording, default: Skeleton, height_m: float | None = None, skeleton: Skeleton | None = None
) -> tuple[Recording, Stature | None]:
    """The recording with the skeleton of its wearer's height, and that height.

    A given height (m) and skeleton come first, then the skeleton that the recording has, then `estimate_stature`; where none
    is known, the recording is returned as it is, with None. Raises WearcapError for a height that is no person's.
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
    return (
        recording if found is None else replace(recording, skeleton=skeleton_of_height(found.height_m, default))
    ), found


def estimate_stature(recording: Recording, skeleton: Skeleton) -> Stature | None:
    """Height of a wearer whose head joint stands over a known floor as high as people of `skeleton`, scaled, carry it.

    The floor is the recording's own, else that below its points. None without a head path or floor, over less than
    `LEAST_S`, and for heights outside `HEIGHTS_M`.
    """
    head = recording.head
    if head is None or len(head.timestamps) < 2:
        return None
    t_world_head, times = head.T_world_head.t, head.timestamps
    if recording.floor is not None and len(recording.floor.timestamps):
        nearest = torch.searchsorted(recording.floor.timestamps, times).clamp(max=len(recording.floor.height) - 1)
        floor, sure = recording.floor.height[nearest], torch.ones(len(times), dtype=torch.bool)
    elif recording.points is not None and len(recording.points.points_world) >= MIN_POINTS:
        try:
            below = estimate_floor(recording.points.points_world, t_world_head)
        except WearcapError:
            return None
        floor, sure = below.height, below.confidence >= CONFIDENT
    else:
        return None
    step_s = times.diff().median().item()
    clearance = (t_world_head[:, 2] - floor)[sure & t_world_head.isfinite().all(-1)]
    if len(clearance) * step_s < LEAST_S:
        return None
    pieces = clearance.split(max(round(UPRIGHT_WITHIN_S / step_s), 1))
    upright = torch.stack([piece.quantile(UPRIGHT) for piece in pieces if len(piece) * step_s >= LEAST_S])
    high = upright.quantile(0.75)  # in half of the half-minutes people may sit
    near = upright[(upright - high).abs() < 0.1]
    height_m = near.median().item() * skeleton.stature / (CARRIED * skeleton.height_of("head"))
    if not HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1]:
        return None
    spread = near.std().item() if len(near) > 1 else 0.0
    return Stature(height_m, (POSTURE_M**2 + spread**2) ** 0.5, "head")


def skeleton_of(recording: Recording) -> Skeleton | None:
    """The wearer's skeleton, as the recording or one of its motions has it."""
    motions = [motion.skeleton for motion in (recording.motion, recording.suit) if motion is not None]
    return recording.skeleton or next(iter(motions), None)
