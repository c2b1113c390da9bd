"""ECHO's conditioning from a recording at the model's rate: tracked points, floor, active objects, observations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.skeleton import FOOT_PATCHES, MIRROR, WRISTS
from wearcap.data.objects import object_cloud
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate_clamped, resample
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.metrics.symmetry import Symmetry
from wearcap.models.point_encoder import PointNeXt, bounds
from wearcap.recording.active_objects import NO_OBJECT, ActiveSpan, active_at
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment, SceneObject
from wearcap.systems.echo.features import CONTACTS, EchoFeatures
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import Conditioning
from wearcap.tracking.floor import CARRIED
from wearcap.tracking.head_path import HeadPath

MAX_GAP_S = 0.5
"""Longest gap in a wrist's tracking that is interpolated (s)."""
SAME_S = 1e-4
"""Times closer than this count as equal (s)."""
SWAPPED_M = 0.02
"""Median distance of the left wrist to the right of the right wrist from which the two count as swapped (m)."""


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """An object in its own axes, centred on its bounding box; its pose is the pose of this centre."""

    name: str
    category: str
    mesh: Mesh
    middle: Float[Tensor, "3"]
    """Centre of the bounding box in coordinates of the mesh (m)."""
    cloud: Float[Tensor, "point 3"]
    """Surface points relative to the centre (m)."""
    code: Float[Tensor, "code"]
    """Condition for the network: class, extents and feature, raw or embedded (`ObjectReader`)."""
    code_mirrored: Float[Tensor, "code"]
    """Condition for the object mirrored along its own y axis."""
    surface: TriangleIndex
    """Spatial index of the mesh's triangles."""
    item: SceneObject | None = None
    """The object in its environment, whose freedom captures keep to; None: it may be anywhere."""

    @cached_property
    def symmetry(self) -> Symmetry:
        """Turns that leave the object as it was."""
        return Symmetry.of(self.mesh, self.cloud + self.middle, self.surface)

    def centred(self, T_world_object: Rigid) -> Rigid:
        """Pose of the bounding box's centre, given the mesh's pose."""
        return Rigid(T_world_object.R, T_world_object @ self.middle.to(T_world_object.t))

    def reachable(self, T_world_middle: Rigid) -> Rigid:
        """The nearest pose of the centre that the object's freedom allows."""
        if self.item is None:
            return T_world_middle
        return self.centred(self.item.reachable(self.of_mesh(T_world_middle), self.middle))

    def of_mesh(self, T_world_middle: Rigid) -> Rigid:
        """The inverse of `centred`."""
        return Rigid(T_world_middle.R, T_world_middle @ -self.middle.to(T_world_middle.t))


class ObjectReader:
    """Turns objects into conditions for the network; each mesh is processed once."""

    def __init__(
        self,
        features: EchoFeatures,
        encoder: PointNeXt | None,
        embed: Callable[[Tensor], Tensor] | None = None,
        freedoms: bool = False,
    ):
        """`freedoms`: whether shapes know how their objects can move. `encoder` None: codes are class and extents alone, for features without shape. `embed`: the network's layer
        on codes (`EchoDenoiser.object`), which is the same in every window; None leaves them raw."""
        self.features, self.encoder, self._embed, self._freedoms = features, encoder, embed, freedoms
        empty = torch.zeros(1, features.object_condition_size)
        self.nothing: Float[Tensor, "code"] = self._embedded(empty)[0]
        """Placeholder code for frames without an active object."""
        self._shapes: dict[tuple[int, str], ObjectShape] = {}

    @torch.inference_mode()
    def __call__(self, item: SceneObject) -> ObjectShape:
        """Shape and codes of an object. Raises WearcapError for a class that the model was not built for."""
        key = (id(item.mesh), item.category)
        if key in self._shapes:
            return replace(self._shapes[key], name=item.name, item=item if self._freedoms else None)
        one_hot = self.features.class_code(item.category)
        cloud = object_cloud(item.mesh)
        middle = (cloud.max(0).values + cloud.min(0).values) / 2
        both = torch.stack([cloud - middle, (cloud - middle) * torch.tensor(MIRROR)])
        parts = [one_hot.expand(2, -1), torch.cat(bounds(both), -1)]
        if self.encoder is not None and self.features.shape_size:
            parts.append(self.encoder(both))
        code, code_mirrored = self._embedded(torch.cat(parts, -1)).unbind(0)
        made = item.name, item.category, item.mesh, middle, both[0].clone(), code, code_mirrored
        self._shapes[key] = ObjectShape(*made, TriangleIndex.of(item.mesh), item if self._freedoms else None)
        return self._shapes[key]

    @torch.no_grad()
    def _embedded(self, codes: Float[Tensor, "object raw"]) -> Float[Tensor, "object code"]:
        return (codes if self._embed is None else self._embed(codes)).clone()


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
    R, t = _tracked_points(recording, path)
    names = list(dict.fromkeys(span.object for span in scenario.active_objects))
    objects = _objects(scenario, names, reader)
    active = active_at(scenario.active_objects, names, path.timestamps)
    codes = torch.stack([*(shape.code for shape in objects), reader.nothing])
    mirrored = torch.stack([*(shape.code_mirrored for shape in objects), reader.nothing])
    floor = path.floor_below(CARRIED)
    if recording.floor is not None:
        floor = interpolate_clamped(recording.floor.timestamps, recording.floor.height, path.timestamps)
    objects_of_frames = active != NO_OBJECT, codes[active], mirrored[active], active.float()
    valid = torch.ones(len(path.timestamps), dtype=torch.bool)
    observed = _observed(scenario, path, names, objects, active)
    parts = R, t, floor.float(), *objects_of_frames, valid, *observed
    return BatchItem(path, Conditioning(*(part[None] for part in parts)), objects)


def _tracked_points(
    recording: Recording, path: HeadPath
) -> tuple[Float[Tensor, "time point 3 3"], Float[Tensor, "time point 3"]]:
    """Measured head and tracked wrists; the ground-truth wrists if the recording tracks none."""
    poses = [path.T_world_head]
    truth = recording.motion
    found = [joint for joint in WRISTS if joint in recording.tracked]
    if len(found) == 1:
        expected = f"`tracked` poses of {' and '.join(WRISTS)}"
        raise WearcapError(f"only {found[0]} is tracked", where=recording.name, expected=expected)
    if found:
        for joint in found:
            track = recording.tracked[joint]
            _require_times(track.timestamps, path, f"tracking of {joint}", recording.name)
            poses.append(wrist_poses(track, path.timestamps))
    elif truth is not None:
        times = path.timestamps.clamp(truth.timestamps[0].item(), truth.timestamps[-1].item())
        truth = at_times(truth, times)
        poses += [truth.joint(joint) for joint in WRISTS]
    else:
        expected = f"`tracked` poses of {' and '.join(WRISTS)}, or a true motion"
        raise WearcapError("this recording has no tracked wrists", where=recording.name, expected=expected)
    R, t = torch.stack([T.R.float() for T in poses], 1), torch.stack([T.t.float() for T in poses], 1)
    if not (R.isfinite().all() and t.isfinite().all()):
        raise WearcapError("poses of wrists that are NaN or infinite", where=recording.name, expected="finite poses")
    heading = rotation.about_axis("z", rotation.yaw_of(R[:, 0]))
    apart = (heading.mT @ (t[:, 1] - t[:, 2])[..., None])[:, 1, 0].median().item()
    # Wrists of a ground-truth motion cannot be swapped trackers: the wearer crosses the arms.
    if found and apart < -SWAPPED_M:
        what = f"the left wrist is {-100 * apart:.0f} cm to the right of the right one, by the median"
        expected = "the left wrist on the left"
        raise WearcapError(what, where=recording.name, expected=expected, fix="Swap the two trackers.")
    return R, t


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


def _require_times(times: Float64[Tensor, "frame"], path: HeadPath, what: str, where: str) -> None:
    if len(times) < 2 or not (times.diff() > 0).all():
        raise WearcapError(
            f"{what} at {len(times)} times that do not increase", where=where, expected="increasing timestamps (s)"
        )
    late, early = times[0] - path.timestamps[0], path.timestamps[-1] - times[-1]
    if max(late.item(), early.item()) > 0.5:
        expected = f"all of {path.timestamps[0]:.2f} to {path.timestamps[-1]:.2f} s, as the head"
        raise WearcapError(f"{what} from {times[0]:.2f} to {times[-1]:.2f} s", where=where, expected=expected)


def _objects(scenario: Scenario, names: list[str], reader: ObjectReader) -> list[ObjectShape]:
    if names and scenario.environment is None:
        what = f"spans of {names[0]!r}, but no objects"
        expected = "an environment with the objects' meshes"
        raise WearcapError(what, where=scenario.recording.name, expected=expected, fix="Give environment=FILE.")
    shapes = []
    for name in names:
        assert scenario.environment is not None
        where = f"object {name!r} of {scenario.recording.name}"
        try:
            item = scenario.environment.by_name(name)
            item.check(where)
            shapes.append(reader(item))
        except WearcapError as error:
            raise WearcapError(error.what, where=where, expected=error.expected, fix=error.fix) from error
    return shapes


def _observed(
    scenario: Scenario, path: HeadPath, names: list[str], objects: list[ObjectShape], active: Tensor
) -> tuple[Tensor, ...]:
    """Observed values, each at its nearest frame, and a mask of observed frames per modality."""
    count, seen, where = len(path.timestamps), scenario.observed, scenario.recording.name
    joints = len(path.skeleton)
    R, root = torch.eye(3).repeat(count, joints, 1, 1), torch.zeros(count, 3)
    R_object, t_object = torch.eye(3).repeat(count, 1, 1), torch.zeros(count, 3)
    contact, is_observed = torch.zeros(count, CONTACTS), torch.zeros(count, len(MODALITIES), dtype=torch.bool)
    if seen.motion is not None:
        at = _frames(seen.motion.timestamps, path, where)
        if len(seen.motion.skeleton) != joints:
            what = f"an observed body of {len(seen.motion.skeleton)} joints"
            raise WearcapError(what, where=where, expected=f"{joints}, as the wearer has")
        R[at], root[at] = seen.motion.R_parent_joint.float(), seen.motion.t_world_root.float()
        is_observed[at, 0] = True
    for name, track in seen.object_motion.items():
        if name not in names:
            expected = f"one of {', '.join(names) or 'no objects'}"
            raise WearcapError(f"an observed object {name!r}", where=where, expected=expected)
        at, number = _frames(track.timestamps, path, where), names.index(name)
        mine = active[at] == number
        T = objects[number].centred(track.T_world_body)
        R_object[at[mine]], t_object[at[mine]] = T.R[mine].float(), T.t[mine].float()
        is_observed[at[mine], 1] = True
    if scenario.placed and scenario.environment is not None:
        for number, name in enumerate(names):
            first = (active == number).nonzero()[:1, 0]
            if len(first) and not is_observed[first, 1]:
                T = objects[number].centred(scenario.environment.by_name(name).T_world_object)
                R_object[first], t_object[first] = T.R.float(), T.t.float()
                is_observed[first, 1] = True
    if seen.contact is not None and seen.contact_times is not None:
        at = _frames(seen.contact_times, path, where)
        if seen.contact.shape[1] != CONTACTS:
            expected = f"{BODY_POINTS} of the body and {len(FOOT_PATCHES)} of the feet"
            raise WearcapError(f"observed contacts of {seen.contact.shape[1]} points", where=where, expected=expected)
        contact[at] = seen.contact.float()
        is_observed[at, 2] = True
    for value in (R, root, R_object, t_object, contact):
        if not value.isfinite().all():
            raise WearcapError("observations that are NaN or infinite", where=where, expected="finite values")
    return R, root, R_object, t_object, contact, is_observed


def _frames(times: Float64[Tensor, "frame"], path: HeadPath, where: str) -> Tensor:
    """Indices of the frames nearest to `times`. Raises WearcapError for times beyond the recording."""
    clock = path.timestamps
    step = (clock[1] - clock[0]).item() if len(clock) > 1 else 0.0
    beyond = ~((times >= clock[0] - step) & (times <= clock[-1] + step))
    if beyond.any():
        what = f"an observation at {times[beyond][0].item():.2f} s, beyond the recording"
        raise WearcapError(what, where=where, expected=f"times from {clock[0].item():.2f} to {clock[-1].item():.2f} s")
    return ((times - clock[0]) / max(step, 1e-9)).round().long().clamp(0, len(clock) - 1)
