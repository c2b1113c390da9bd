"""Objects as ECHO's network is conditioned on them: class, extents and shape, when they are active, where observed."""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.skeleton import MIRROR
from wearcap.data.objects import object_cloud
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import nearest_frames
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.metrics.symmetry import Symmetry
from wearcap.models.point_encoder import PointNeXt, bounds
from wearcap.recording.active_objects import NO_OBJECT, SAME_S
from wearcap.scene.objects import Environment, SceneObject
from wearcap.systems.echo.features import CONTACTS, EchoFeatures
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import Conditioning


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


class ActiveObjects:
    """Conditions of frames on objects, from changes of the active object and observed poses."""

    def __init__(self, reader: ObjectReader, environment: Environment | None, placed: bool):
        """`placed`: whether the environment's pose of an object counts as observed where it first becomes active."""
        self._reader, self._environment, self._placed = reader, environment, placed
        self._shapes: dict[str, ObjectShape] = {}
        """Objects that were named so far, in order of their first use."""
        self.changes: list[tuple[float, str | None]] = []
        """Times (s), rising, from which on an object is active; None: no object is."""
        self.seen: list[tuple[float, str, Rigid]] = []
        """Observed poses of objects' centres with their times (s)."""

    @property
    def shapes(self) -> list[ObjectShape]:
        """Objects in the order of `Conditioning.object_number`."""
        return list(self._shapes.values())

    def shape(self, name: str) -> ObjectShape:
        """An object by name. Raises WearcapError for an unknown one, and for one whose mesh or class cannot be used."""
        if name not in self._shapes:
            if self._environment is None:
                raise WearcapError(f"no object {name!r}", expected="a session with an environment")
            item = self._environment.by_name(name)
            item.check(f"object {name!r}")
            self._shapes[name] = self._reader(item)
        return self._shapes[name]

    def activate(self, name: str | None, timestamp: float) -> None:
        """Make an object the active one from `timestamp` (s) on; None: no object is. Raises as `shape` does."""
        if name is not None and name not in self._shapes:
            self.shape(name)
            if self._placed and self._environment is not None:
                # Half a frame later, so that the first frame from `timestamp` on is the nearest one.
                soon = timestamp + 0.499 / self._reader.features.fps
                self.see(name, soon, self._environment.by_name(name).T_world_object)
        self.changes = [*(change for change in self.changes if change[0] < timestamp), (timestamp, name)]

    def see(self, name: str, timestamp: float, T_world_object: Rigid) -> None:
        """Add an observed pose of an object at a time (s). Raises as `shape` does."""
        self.seen.append((timestamp, name, self.shape(name).centred(T_world_object)))

    def active(self, timestamp: float) -> str | None:
        """Name of the active object at a time (s)."""
        return self.changes[at - 1][1] if (at := self._change(timestamp)) else None

    def _change(self, timestamp: float) -> int:
        return bisect_right(self.changes, timestamp, key=lambda change: change[0])

    def forget(self, timestamp: float) -> None:
        """Drop what no frame after this time (s) needs."""
        self.seen = [row for row in self.seen if row[0] > timestamp - 1.0]
        self.changes = self.changes[max(self._change(timestamp) - 1, 0) :]

    def frames(
        self,
        timestamps: Float64[Tensor, "time"],
        R_world_point: Float[Tensor, "time point 3 3"],
        t_world_point: Float[Tensor, "time point 3"],
        floor_height: Float[Tensor, "time"],
        joints: int,
        seen: Bool[Tensor, "time point"],
    ) -> Conditioning:
        """Frames with these tracked points, of which only objects are observed, as a batch of one."""
        count, nothing = len(timestamps), self._reader.nothing.expand(len(timestamps), -1)
        none, eye, zeros = torch.zeros(count, dtype=torch.bool), torch.eye(3).repeat(count, 1, 1), torch.zeros(count, 3)
        objects = none, nothing, nothing, torch.full((count,), float(NO_OBJECT))
        body = eye[:, None].repeat(1, joints, 1, 1), zeros
        unobserved = *body, eye, zeros, torch.zeros(count, CONTACTS), none[:, None].repeat(1, len(MODALITIES))
        fields = timestamps, R_world_point, t_world_point, floor_height, *objects, ~none, *unobserved, seen
        return self.updated(Conditioning(*(field[None] for field in fields)))

    def updated(self, frames: Conditioning) -> Conditioning:
        """The frames with what is known of objects now."""
        times, names = frames.timestamps[0], list(self._shapes)
        starts = torch.tensor([start for start, _ in self.changes], dtype=torch.float64)
        numbers = [NO_OBJECT, *(NO_OBJECT if name is None else names.index(name) for _, name in self.changes)]
        active = torch.tensor(numbers)[torch.searchsorted(starts, times + SAME_S, right=True)]
        codes = torch.stack([*(shape.code for shape in self.shapes), self._reader.nothing])
        mirrored = torch.stack([*(shape.code_mirrored for shape in self.shapes), self._reader.nothing])
        R, t, is_observed = (
            part.clone() for part in (frames.R_world_object, frames.t_world_object, frames.is_observed)
        )
        is_observed[..., 1] = False
        for number, name in enumerate(names):
            rows = sorted((row for row in self.seen if row[1] == name), key=lambda row: row[0])
            if not rows:
                continue
            at, _, T = zip(*rows)
            at = torch.tensor(at, dtype=torch.float64)
            nearest = nearest_frames(at, times)
            near = (at[nearest] - times).abs() <= 0.5 / self._reader.features.fps + 1e-6
            here = near & (active == number)
            R[0, here] = torch.stack([each.R.float() for each in T])[nearest[here]]
            t[0, here] = torch.stack([each.t.float() for each in T])[nearest[here]]
            is_observed[0, here, 1] = True
        return frames._replace(
            has_object=(active != NO_OBJECT)[None],
            object_code=codes[active][None],
            object_code_mirrored=mirrored[active][None],
            object_number=active.float()[None],
            R_world_object=R,
            t_world_object=t,
            is_observed=is_observed,
        )
