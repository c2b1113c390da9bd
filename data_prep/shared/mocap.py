"""Conversion of motion capture in any skeleton to ground truth: one rate, no glitches, a level floor, contacts, a head path."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.shared.engine import NOTE
from wearcap.body.kinematics import site_positions
from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ContactTrack, FloorTrack, HeadStream, Recording
from wearcap.recording.timing import resampled

TRUNK = ("pelvis", "l5", "l3", "t12", "t8", "neck", "head", "left_hip", "right_hip")
"""Joints of xsens23 that no limb can swing."""


_STANDING, _LEAST_STANDING = 0.25, 10
"""Share of the contact speed below which both ends of a sole stand still, and number of such soles that tell the floor."""


@dataclass(frozen=True)
class CleaningLimits:
    """Thresholds for a glitch, a planted foot and a level floor."""

    max_trunk_speed: float | int = 8.0
    """Largest speed of `TRUNK`'s joints (m/s); sprinters reach 12, CMU's runners 5."""
    max_limb_speed: float | int = 15.0
    """Largest speed of all other joints (m/s); a kicking foot reaches 14 in CMU."""
    contact_speed: float | int = 0.5
    """Speed (m/s) below which a foot patch may be in contact."""
    contact_height: float | int = 0.06
    """Height above the floor (m) below which a slow foot patch is in contact."""
    level_within: float | int = 0.12
    """Spread (m, 5th to 95th percentile) of the lowest planted patch's height up to which the floor is level."""


@dataclass(frozen=True)
class MocapSettings:
    """Settings of the conversion of motion capture without sensors to a recording."""

    fps: float | int = 60
    t_head_device: Sequence[float] = (0.09, 0.0, 0.09)
    """Nominal position of a head-mounted device in the head joint's frame (m)."""
    limits: CleaningLimits = field(default_factory=CleaningLimits)


MOCAP = MocapSettings()


@dataclass(frozen=True)
class About:
    """Metadata of a recording."""

    name: str
    subject: str
    source: str
    license: str
    activity: str = ""


def mocap_recording(motion: Motion, about: About, settings: MocapSettings) -> Recording:
    """Retarget to xsens23, cut glitches, resample, level the floor, find contacts, put a device on the head.

    The floor is at the median height of the soles of feet that stand still on heel and toes, else of the lowest of
    `FOOT_PATCHES` while that patch is planted. On ground that is not
    level (steps, ladders) there is no `floor`, contacts follow from the patches' speed alone, and z = 0 is the 5th
    percentile of these heights, the lowest ground trodden. The source's height is kept in the provenance as `floor_m`.
    """
    motion, note = without_glitches(on_xsens23(motion), settings.limits)
    motion = resampled(motion, settings.fps)
    positions, speed = foot_patches(motion)
    height, patch = positions[..., 2].min(1)
    slow = speed < settings.limits.contact_speed
    planted = height[slow.gather(1, patch[:, None])[:, 0]]
    planted = planted if len(planted) else height
    low, middle, high = planted.quantile(torch.tensor([0.05, 0.5, 0.95])).tolist()
    level = high - low <= settings.limits.level_within
    floor = _sole_height(positions, speed, middle, settings.limits) if level else low
    if level:
        slow &= positions[..., 2] < floor + settings.limits.contact_height
    # Single frames follow their neighbours.
    votes = torch.nn.functional.pad(slow.float().T[None], (1, 1), mode="replicate")[0]
    contact = votes.unfold(-1, 3, 1).sum(-1).T >= 2
    provenance = motion.provenance | {"floor_m": f"{floor:.4f}", "floor": "level" if level else "uneven"}
    motion = replace(
        motion,
        timestamps=motion.timestamps - motion.timestamps[0],
        t_world_root=motion.t_world_root - torch.tensor([0.0, 0.0, floor]),
        provenance=provenance | ({NOTE: note} if note else {}),
    )
    times, head, t = motion.timestamps, motion.joint("head"), torch.tensor(list(settings.t_head_device))
    return Recording(
        **vars(about),
        # The path of a device fixed to the head joint, its axes parallel to the head's
        head=HeadStream(times, head.R.contiguous(), head @ t, torch.eye(3), t),
        motion=motion,
        contacts=ContactTrack(times, FOOT_PATCHES, contact),
        floor=FloorTrack(times, torch.zeros(len(times))) if level else None,
        skeleton=motion.skeleton,
    )


def _sole_height(
    positions: Float[Tensor, "time patch 3"], speed: Float[Tensor, "time patch"], middle: float, limits: CleaningLimits
) -> float:
    """Median height (m) of the middles of soles that stand near `middle`; `middle` where none stands."""
    heights = positions[..., 2].unflatten(1, (2, 2)).mean(-1)
    still = (speed < _STANDING * limits.contact_speed).unflatten(1, (2, 2)).all(-1)
    standing = heights[still & ((heights - middle).abs() < limits.contact_height)]
    return standing.median().item() if len(standing) >= _LEAST_STANDING else middle


def on_xsens23(motion: Motion) -> Motion:
    """The motion on an xsens23 of the wearer's own bone lengths."""
    if motion.skeleton.name == "xsens23":
        return motion
    skeleton = fit_offsets(motion.skeleton, xsens23())
    R, t = retarget(motion.skeleton, skeleton, motion.R_parent_joint, motion.t_world_root)
    return replace(motion, skeleton=skeleton, R_parent_joint=R, t_world_root=t)


def without_glitches(motion: Motion, limits: CleaningLimits) -> tuple[Motion, str]:
    """The longest span between impossible steps, and a note about the cut ("" if there was none).

    A step is impossible when a joint of the trunk moves faster than `max_trunk_speed`, or any other joint
    faster than `max_limb_speed`: markers that were swapped or lost flip limbs within one frame.
    """
    if len(motion) < 2:
        return motion, ""
    names = motion.skeleton.joint_names
    limit = torch.tensor([limits.max_trunk_speed if n in TRUNK else limits.max_limb_speed for n in names])
    step_s = motion.timestamps.diff().to(motion.t_world_root.dtype)
    speed = motion.T_world_joint.t.diff(dim=0).norm(dim=-1) / step_s[:, None]
    bad = (speed > limit).any(1).nonzero()[:, 0].tolist()
    if not bad:
        return motion, ""
    edges = [0, *(step + 1 for step in bad), len(motion)]
    start, stop = max(pairwise(edges), key=lambda span: span[1] - span[0])
    worst = int((speed / limit).amax(0).argmax())
    note = (
        f"kept frames {start} to {stop - 1} of {len(motion)}: {len(bad)} impossible steps, the worst "
        f"{speed[:, worst].max().item():.0f} m/s of {names[worst]}"
    )
    return motion.sliced(start, stop), note


def foot_patches(motion: Motion) -> tuple[Float[Tensor, "time patch 3"], Float[Tensor, "time patch"]]:
    """World positions (m) and speeds (m/s, central differences) of `FOOT_PATCHES`."""
    positions = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)
    step_s = (motion.timestamps[2:] - motion.timestamps[:-2]).to(positions.dtype)
    speed = (positions[2:] - positions[:-2]).norm(dim=-1) / step_s[:, None]
    return positions, torch.cat([speed[:1], speed, speed[-1:]])
