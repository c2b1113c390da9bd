"""Conversion of a captured motion in any skeleton to a recording with a head path, contacts and floor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from wearcap.body.retarget import fit_offsets, retarget
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.prepare.clean import CleaningLimits, floor_height, foot_contacts, foot_patches, levelled, without_glitches
from wearcap.prepare.engine import NOTE
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ContactTrack, FloorTrack, HeadStream, Recording
from wearcap.recording.timing import resampled


@dataclass(frozen=True)
class MocapSettings:
    """Settings of the conversion of motion capture without sensors to a recording."""

    fps: float | int
    t_head_device: Sequence[float]
    """Nominal position of a head-mounted device in the head joint's frame (m)."""
    limits: CleaningLimits


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

    The source's floor height is kept in the motion's provenance as `floor_m`. On ground that is not level
    (steps, ladders) there is no `floor`, and contacts follow from the patches' speed alone.
    """
    motion, note = without_glitches(on_xsens23(motion), settings.limits)
    motion = resampled(motion, settings.fps)
    positions, speed = foot_patches(motion)
    floor, level = floor_height(positions, speed, settings.limits)
    contact = foot_contacts(positions, speed, floor if level else None, settings.limits)
    provenance = motion.provenance | {"floor_m": f"{floor:.4f}", "floor": "level" if level else "uneven"}
    motion = replace(
        levelled(motion, floor),
        timestamps=motion.timestamps - motion.timestamps[0],
        provenance=provenance | ({NOTE: note} if note else {}),
    )
    times = motion.timestamps
    return Recording(
        about.name,
        head=nominal_head(motion, settings.t_head_device),
        motion=motion,
        contacts=ContactTrack(times, FOOT_PATCHES, contact),
        floor=FloorTrack(times, torch.zeros(len(times))) if level else None,
        skeleton=motion.skeleton,
        subject=about.subject,
        activity=about.activity,
        source=about.source,
        license=about.license,
    )


def on_xsens23(motion: Motion) -> Motion:
    """The motion on an xsens23 of the wearer's own bone lengths."""
    if motion.skeleton.name == "xsens23":
        return motion
    skeleton = fit_offsets(motion.skeleton, xsens23())
    R, t = retarget(motion.skeleton, skeleton, motion.R_parent_joint, motion.t_world_root)
    return replace(motion, skeleton=skeleton, R_parent_joint=R, t_world_root=t)


def nominal_head(motion: Motion, t_head_device: Sequence[float]) -> HeadStream:
    """The path of a device fixed to the head joint, its axes parallel to the head's."""
    head = motion.joint("head")
    t = torch.tensor(list(t_head_device))
    return HeadStream(motion.timestamps, head.R.contiguous(), head @ t, torch.eye(3), t)
