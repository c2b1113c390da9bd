"""Objects as conditions of ECHO (class, extents and an encoder's feature), their poses, and body contact with them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.skeleton import FOOT_PATCHES, MIRROR
from wearcap.data.objects import object_cloud
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.triangle_distance import TriangleIndex
from wearcap.models.point_encoder import PointNeXt, cloud_extents
from wearcap.recording.recording import Recording
from wearcap.scene.environment import Environment
from wearcap.scene.objects import SceneObject
from wearcap.systems.echo.features import EchoFeatures


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

    def centred(self, T_world_object: Rigid) -> Rigid:
        """Pose of the bounding box's centre, given the mesh's pose."""
        return Rigid(T_world_object.R, T_world_object @ self.middle.to(T_world_object.t))

    def of_mesh(self, T_world_middle: Rigid) -> Rigid:
        """The inverse of `centred`."""
        return Rigid(T_world_middle.R, T_world_middle @ -self.middle.to(T_world_middle.t))

    @property
    def mean(self) -> Float[Tensor, "3"]:
        """Mean of the cloud's points (m)."""
        return self.cloud.mean(0)

    @property
    def spread(self) -> Float[Tensor, "3 3"]:
        """Second moment of the cloud's points (m²), which gives their mean squared displacement by a rotation."""
        return self.cloud.mT @ self.cloud / len(self.cloud)


class ObjectReader:
    """Turns objects into conditions for the network; each mesh is processed once."""

    def __init__(
        self, features: EchoFeatures, encoder: PointNeXt | None, embed: Callable[[Tensor], Tensor] | None = None
    ):
        """`encoder` None: codes are class and extents alone, for features without shape. `embed`: the network's layer
        on codes (`EchoDenoiser.object`), which is the same in every window; None leaves them raw."""
        self.features, self.encoder, self._embed = features, encoder, embed
        empty = torch.zeros(1, features.object_condition_size)
        self.nothing: Float[Tensor, "code"] = self._embedded(empty)[0]
        """Placeholder code for frames without an active object."""
        self._shapes: dict[tuple[int, str], ObjectShape] = {}

    @torch.inference_mode()
    def __call__(self, item: SceneObject) -> ObjectShape:
        """Shape and codes of an object. Raises WearcapError for a class that the model was not built for."""
        key = (id(item.mesh), item.category)
        if key not in self._shapes:
            self._shapes[key] = self._read(item)
        return replace(self._shapes[key], name=item.name)

    def _read(self, item: SceneObject) -> ObjectShape:
        one_hot = self.features.class_code(item.category)
        cloud = object_cloud(item.mesh)
        middle = (cloud.max(0).values + cloud.min(0).values) / 2
        both = torch.stack([cloud - middle, (cloud - middle) * torch.tensor(MIRROR)])
        parts = [one_hot.expand(2, -1), cloud_extents(both)]
        if self.encoder is not None and self.features.shape_size:
            parts.append(self.encoder(both))
        code, code_mirrored = self._embedded(torch.cat(parts, -1)).unbind(0)
        return ObjectShape(
            item.name,
            item.category,
            item.mesh,
            middle,
            both[0].clone(),
            code,
            code_mirrored,
            TriangleIndex.of(item.mesh),
        )

    @torch.no_grad()
    def _embedded(self, codes: Float[Tensor, "object raw"]) -> Float[Tensor, "object code"]:
        return (codes if self._embed is None else self._embed(codes)).clone()


def object_poses(recording: Recording, environment: Environment, name: str, shape: ObjectShape, take: Tensor) -> Rigid:
    """Ground-truth poses of an object's centre at frames `take` of the motion, whose clock its trajectory shares.

    An object without a trajectory stays at its pose in the environment.
    """
    track = recording.object_motion.get(name)
    if track is None:
        item = environment.by_name(name)
        T = Rigid(item.R_world_object.expand(len(take), 3, 3).clone(), item.t_world_object.expand(len(take), 3).clone())
    else:
        T = track.T_world_body[take]
    return shape.centred(T)


def body_contact(
    points_world: Float[Tensor, "time point 3"], shape: ObjectShape, T_world_middle: Rigid, within_m: float
) -> Tensor:
    """Whether each contact point of the body is within τ_c (`within_m`) of the object's surface (ECHO §3.1).

    Distances are to the exact surface, not to its vertices (ours), which may be further apart than τ_c.
    """
    T_object_world = shape.of_mesh(T_world_middle).inverse()
    R, t = T_object_world.R.double(), T_object_world.t.double()
    local = (R[:, None] @ points_world.double()[..., None])[..., 0] + t[:, None]
    low, high = shape.mesh.vertices.min(0) - within_m, shape.mesh.vertices.max(0) + within_m
    flat = local.flatten(0, 1).numpy()
    near = np.flatnonzero(((flat >= low) & (flat <= high)).all(1))
    touches = torch.zeros(len(flat), dtype=torch.bool)
    if len(near):
        distance, _ = shape.surface.nearest(np.ascontiguousarray(flat[near]))
        touches[torch.from_numpy(near)] = torch.from_numpy(distance) <= within_m
    return touches.unflatten(0, local.shape[:2])


def foot_patches(recording: Recording) -> Bool[Tensor, "time patch"]:
    """Recorded contact of `FOOT_PATCHES` with the floor. Raises WearcapError for a recording without it."""
    track, motion = recording.contacts, recording.motion
    assert motion is not None
    if track is None or not set(FOOT_PATCHES) <= set(track.parts) or len(track.contact) != len(motion):
        raise WearcapError(
            "no foot contacts beside the motion",
            where=recording.name,
            expected=f"contacts of {', '.join(FOOT_PATCHES)}",
            fix="Prepare the data set again.",
        )
    return track.contact[:, [track.parts.index(patch) for patch in FOOT_PATCHES]]
