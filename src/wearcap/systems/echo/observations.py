"""ECHO's conditioning from a recording at the model's rate: tracked points, floor, active objects, observations."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.skeleton import FOOT_PATCHES, WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate_clamped, resample
from wearcap.recording.active_objects import ActiveSpan, changes
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.objects import ActiveObjects, ObjectReader, ObjectShape
from wearcap.systems.echo.queue import Conditioning
from wearcap.tracking.floor import CARRIED
from wearcap.tracking.head_path import HeadPath
from wearcap.tracking.wrists import seen_wrist

MAX_GAP_S = 0.5
"""Longest gap in a wrist's tracking that is interpolated (s)."""
SAME_S = 1e-4
"""Times closer than this count as equal (s)."""
SWAPPED_M = 0.02
"""Median distance of the left wrist to the right of the right wrist from which the two count as swapped (m)."""


_GAPS = "checkpoint=echo_gaps knows wrists that come and go."


@dataclass(frozen=True, eq=False)
class Observed:
    """Sparse observations of the output modalities, each at its own times (ECHO §4.2)."""

    motion: Motion | None = None
    """The body, at the frames in which it is observed."""
    object_motion: Mapping[str, Trajectory] = field(default_factory=dict)
    """Poses of objects by name, at the times at which they are observed."""
    contact_times: Float64[Tensor, "frame"] | None = None
    """Times of the observed contacts (s)."""
    contact: Float[Tensor, "frame contact"] | None = None
    """64 body points on the active object, then `FOOT_PATCHES` on the floor: 1 for contact."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A recording, the objects in it, and the intervals in which each of them is active."""

    recording: Recording
    environment: Environment | None = None
    active_objects: tuple[ActiveSpan, ...] = ()
    """Intervals with an active object; empty: the human alone is captured."""
    observed: Observed = field(default_factory=Observed)
    placed: bool = False
    """Whether the environment's pose of each object counts as observed in its first active frame."""


@dataclass(frozen=True, eq=False)
class BatchItem:
    """One scenario, ready for the queue."""

    path: HeadPath
    conditioning: Conditioning
    """Conditioning of all frames, with a batch axis of one."""
    objects: list[ObjectShape]
    """Objects that are active at some time, in the order of `Conditioning.object_number`."""


def batch_item_of(scenario: Scenario, path: HeadPath, reader: ObjectReader) -> BatchItem:
    """Conditioning of a scenario, for every frame of the head path.

    Raises WearcapError for wrists that are not tracked or are swapped, for spans of unknown objects, for objects whose
    mesh or class cannot be used, and for observations beyond the recording.
    """
    recording = scenario.recording
    R, t, seen = _tracked_points(recording, path, reader.features.gaps)
    floor = path.floor_below(CARRIED)
    if recording.floor is not None:
        floor = interpolate_clamped(recording.floor.timestamps, recording.floor.height, path.timestamps)
    objects = _active_objects(scenario, path, reader)
    frames = objects.frames(path.timestamps, R, t, floor.float(), len(path.skeleton), seen)
    return BatchItem(path, _with_observed(scenario, path, frames), objects.shapes)


def _tracked_points(
    recording: Recording, path: HeadPath, gaps: bool
) -> tuple[Float[Tensor, "time point 3 3"], Float[Tensor, "time point 3"], Bool[Tensor, "time point"]]:
    """Measured head and tracked wrists, and where each is tracked; the ground-truth wrists if the recording tracks none.

    `gaps`: whether the network knows of wrists that are missing; otherwise their last pose stands in.
    """
    where, found = recording.name, [joint for joint in WRISTS if joint in recording.tracked]
    seen = torch.ones(len(path.timestamps), 3, dtype=torch.bool)
    poses, truth = [path.T_world_head], recording.motion
    if len(found) == 1 and not gaps:
        expected = f"`tracked` poses of {' and '.join(WRISTS)}"
        raise WearcapError(f"only {found[0]} is tracked", where=where, expected=expected, fix=_GAPS)
    if found:
        for number, joint in enumerate(WRISTS, 1):
            track = recording.tracked.get(joint)
            if track is not None:
                _require_times(track.timestamps, path, f"tracking of {joint}", where, gaps)
            if gaps:
                pose, seen[:, number] = seen_wrist(track, path.timestamps)
            else:
                assert track is not None
                pose = wrist_poses(track, path.timestamps)
            poses.append(pose)
    elif truth is not None:
        times = path.timestamps.clamp(truth.timestamps[0].item(), truth.timestamps[-1].item())
        truth = at_times(truth, times)
        poses += [truth.joint(joint) for joint in WRISTS]
    else:
        expected = f"`tracked` poses of {' and '.join(WRISTS)}, or a true motion"
        raise WearcapError("this recording has no tracked wrists", where=where, expected=expected)
    R, t = torch.stack([T.R.float() for T in poses], 1), torch.stack([T.t.float() for T in poses], 1)
    if not (R.isfinite().all() and t.isfinite().all()):
        raise WearcapError("poses of wrists that are NaN or infinite", where=where, expected="finite poses")
    # Wrists of a ground-truth motion cannot be swapped trackers: the wearer crosses the arms.
    both = seen[:, 1] & seen[:, 2]
    if found and both.any():
        heading = rotation.about_axis("z", rotation.yaw_of(R[both, 0]))
        apart = (heading.mT @ (t[both, 1] - t[both, 2])[..., None])[:, 1, 0].median().item()
        if apart < -SWAPPED_M:
            what = f"the left wrist is {-100 * apart:.0f} cm to the right of the right one, by the median"
            raise WearcapError(what, where=where, expected="the left wrist on the left", fix="Swap the two trackers.")
    return R, t, seen


def wrist_poses(track: Trajectory, at: Float64[Tensor, "time"]) -> Rigid:
    """Poses of a tracked wrist at any times; gaps longer than `MAX_GAP_S` and times after the end have the last
    pose."""
    times = track.timestamps
    inside = at.clamp(times[0].item(), times[-1].item())
    last = (torch.searchsorted(times, inside + SAME_S, right=True) - 1).clamp_min(0)
    gone = (times[(last + 1).clamp_max(len(times) - 1)] - times[last] > MAX_GAP_S) | (inside - times[last] <= SAME_S)
    held = track.T_world_body[last]
    if gone.all():  # as where wrists and head come in one packet
        return held
    found = resample(track, inside).T_world_body
    return Rigid(torch.where(gone[:, None, None], held.R, found.R), torch.where(gone[:, None], held.t, found.t))


def _require_times(times: Float64[Tensor, "frame"], path: HeadPath, what: str, where: str, gaps: bool) -> None:
    if len(times) < 2 or not (times.diff() > 0).all():
        raise WearcapError(
            f"{what} at {len(times)} times that do not increase", where=where, expected="increasing timestamps (s)"
        )
    late, early = times[0] - path.timestamps[0], path.timestamps[-1] - times[-1]
    if not gaps and max(late.item(), early.item()) > 0.5:
        expected = f"all of {path.timestamps[0]:.2f} to {path.timestamps[-1]:.2f} s, as the head"
        raise WearcapError(
            f"{what} from {times[0]:.2f} to {times[-1]:.2f} s", where=where, expected=expected, fix=_GAPS
        )


def _active_objects(scenario: Scenario, path: HeadPath, reader: ObjectReader) -> ActiveObjects:
    """Objects of a recording, when they are active, and where they are observed."""
    objects, where = ActiveObjects(reader, scenario.environment, scenario.placed), scenario.recording.name
    names = list(dict.fromkeys(span.object for span in scenario.active_objects))
    if names and scenario.environment is None:
        what = f"spans of {names[0]!r}, but no objects"
        expected = "an environment with the objects' meshes"
        raise WearcapError(what, where=where, expected=expected, fix="Give environment=FILE.")
    begin_s = path.timestamps[0].item()
    found = changes(scenario.active_objects)
    for k, (time_s, name) in enumerate(found):
        if k + 1 < len(found) and found[k + 1][0] <= begin_s:
            continue  # over before the first frame
        try:
            objects.activate(name, max(time_s, begin_s))
        except WearcapError as error:
            place = f"object {name!r} of {where}"
            raise WearcapError(error.what, where=place, expected=error.expected, fix=error.fix) from error
    for name, track in scenario.observed.object_motion.items():
        if name not in names:
            expected = f"one of {', '.join(names) or 'no objects'}"
            raise WearcapError(f"an observed object {name!r}", where=where, expected=expected)
        _frames(track.timestamps, path, where)
        for number, time_s in enumerate(track.timestamps.tolist()):
            objects.see(name, time_s, track.T_world_body[number])
    return objects


def _with_observed(scenario: Scenario, path: HeadPath, frames: Conditioning) -> Conditioning:
    """The frames with the observed values of body and contacts, each at its nearest frame."""
    seen, where, joints = scenario.observed, scenario.recording.name, len(path.skeleton)
    R, root, contact = (part.clone() for part in (frames.R_parent_joint, frames.t_world_root, frames.contact))
    is_observed = frames.is_observed.clone()
    if seen.motion is not None:
        at = _frames(seen.motion.timestamps, path, where)
        if len(seen.motion.skeleton) != joints:
            what = f"an observed body of {len(seen.motion.skeleton)} joints"
            raise WearcapError(what, where=where, expected=f"{joints}, as the wearer has")
        R[0, at], root[0, at] = seen.motion.R_parent_joint.float(), seen.motion.t_world_root.float()
        is_observed[0, at, 0] = True
    if seen.contact is not None and seen.contact_times is not None:
        at = _frames(seen.contact_times, path, where)
        if seen.contact.shape[1] != CONTACTS:
            expected = f"{BODY_POINTS} of the body and {len(FOOT_PATCHES)} of the feet"
            raise WearcapError(f"observed contacts of {seen.contact.shape[1]} points", where=where, expected=expected)
        contact[0, at] = seen.contact.float()
        is_observed[0, at, 2] = True
    for value in (R, root, frames.R_world_object, frames.t_world_object, contact):
        if not value.isfinite().all():
            raise WearcapError("observations that are NaN or infinite", where=where, expected="finite values")
    return frames._replace(R_parent_joint=R, t_world_root=root, contact=contact, is_observed=is_observed)


def _frames(times: Float64[Tensor, "frame"], path: HeadPath, where: str) -> Tensor:
    """Indices of the frames nearest to `times`. Raises WearcapError for times beyond the recording."""
    clock = path.timestamps
    step = (clock[1] - clock[0]).item() if len(clock) > 1 else 0.0
    beyond = ~((times >= clock[0] - step) & (times <= clock[-1] + step))
    if beyond.any():
        what = f"an observation at {times[beyond][0].item():.2f} s, beyond the recording"
        raise WearcapError(what, where=where, expected=f"times from {clock[0].item():.2f} to {clock[-1].item():.2f} s")
    return ((times - clock[0]) / max(step, 1e-9)).round().long().clamp(0, len(clock) - 1)
