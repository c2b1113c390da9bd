"""Display of an interactive environment's objects: posed meshes, and a layer of the page."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
import viser
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import TOUCH_M, contact_points
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.recording.acts import NO_OBJECT, active_at, true_acts
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.scene.environment import Environment
from wearcap.scene.objects import SceneObject

CLOUD_BALLS, CLOUD_BALL_M = 1500, 0.012
"""Number and radius (m) of small balls that show a cloud without faces."""


def pose_at(track: Trajectory | None, item: SceneObject, time_s: float) -> Rigid:
    """Displayed pose of an object: at the nearest frame of its track, or the initial pose without a track."""
    return poses_at(track, item, torch.tensor([time_s], dtype=torch.float64))[0]


def poses_at(track: Trajectory | None, item: SceneObject, times: Float64[Tensor, "time"]) -> Rigid:
    """`pose_at` for many times (s)."""
    if track is None or not len(track):
        T = item.T_world_object
        return Rigid(T.R.expand(len(times), 3, 3), T.t.expand(len(times), 3))
    return track.T_world_body[nearest_frames(track.timestamps, times)]


@lru_cache(maxsize=1024)
def shown_mesh(item: SceneObject) -> Mesh:
    """An object's triangles in its own axes; small balls at the points of a cloud."""
    if len(item.mesh.faces):
        return item.mesh
    points = item.mesh.vertices[:: max(1, len(item.mesh.vertices) // CLOUD_BALLS)].astype(np.float64)
    size = np.full(len(points), CLOUD_BALL_M)
    return capsules(points, points, size, size, np.full((len(points), 3), 0.6), 4)


def posed_meshes(environment: Environment, tracks: dict[str, Trajectory], time_s: float) -> list[Mesh]:
    """Meshes of all objects at a time (s), in the world."""
    return [moved(shown_mesh(item), pose_at(tracks.get(item.name), item, time_s)) for item in environment.objects]


def moved(mesh: Mesh, T_world_object: Rigid) -> Mesh:
    """A mesh transformed from an object's axes to the world."""
    R, t = T_world_object.R.double().numpy(), T_world_object.t.double().numpy()
    return replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32))


def with_objects(recording: Recording, environment: Environment | None = None) -> Motion | None:
    """The true motion with the true objects, hand contacts and contact points, for viewers of single motions."""
    truth = recording.motion
    if truth is None:
        return None
    labels = recording.interactions
    hands = None if labels is None else labels.hand_contact(truth.timestamps).to(truth.t_world_root.dtype)
    points = None if environment is None else true_body_contact(recording, truth, environment)
    return replace(
        truth, object_motion=recording.object_motion or None, hand_contact_prob=hands, body_contact_prob=points
    )


def true_body_contact(
    recording: Recording, truth: Motion, environment: Environment
) -> Float[Tensor, "time point"] | None:
    """1 where a contact point of the body is within `TOUCH_M` of the active object's surface, else 0.

    None if the recording does not state which object is active, and for bodies that are not human.
    """
    if recording.interactions is None and len(recording.object_motion) != 1:
        return None
    try:
        points = contact_points(anny_body(truth.skeleton, recording.shape))
    except WearcapError:
        return None
    touches = torch.zeros(len(truth), len(points.rest_vertices))
    names = [item.name for item in environment.objects]
    acts = [act for act in true_acts(recording) if act.object in names]
    active = active_at(acts, names, truth.timestamps)
    for number in active.unique().tolist():
        if number == NO_OBJECT:
            continue
        item, take = environment.objects[number], (active == number).nonzero()[:, 0]
        T = poses_at(recording.object_motion.get(item.name), item, truth.timestamps[take])
        places = points.vertices(truth.T_world_joint[take])
        touches[take] = _touches(environment, item, places, T).to(touches.dtype)
    return touches


def _touches(
    environment: Environment, item: SceneObject, places: Float[Tensor, "time point 3"], T_world_object: Rigid
) -> Bool[Tensor, "time point"]:
    """Whether points of the world (m) touch an object; only those inside its bounding sphere are measured."""
    low, high = torch.from_numpy(np.stack([item.mesh.vertices.min(0), item.mesh.vertices.max(0)]))
    middle = T_world_object.R @ ((low + high) / 2).to(T_world_object.R) + T_world_object.t
    radius = (high - low).norm() / 2
    near = (places - middle[:, None]).norm(dim=-1) <= radius + TOUCH_M
    frame = near.nonzero()[:, 0]
    distance, _ = environment.distance(item.name, places[near], T_world_object[frame])
    touches = torch.zeros_like(near)
    touches[near] = distance <= TOUCH_M
    return touches


class ObjectsLayer:
    """Objects on the page; a frame is one pose per object."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        objects: Sequence[SceneObject],
        tracks: dict[str, Trajectory],
        tint: tuple[int, int, int] | None = None,
    ):
        """`tint` is the RGB colour (0…255) that the objects' own colours are mixed with equally."""
        self.objects, self.tracks, self.offset = tuple(objects), tracks, np.zeros(3)
        self.handles = []
        for item in self.objects:
            mesh = shown_mesh(item)
            color = 255 * np.atleast_2d(mesh.color).mean(0)
            if tint is not None:
                color = (color + tint) / 2
            self.handles.append(
                server.scene.add_mesh_simple(
                    f"/{name}/{item.name}",
                    mesh.vertices,
                    mesh.faces.astype(np.uint32),
                    color=tuple(int(c) for c in color),
                )
            )

    def place(self, offset: Float[np.ndarray, "3"], visible: bool) -> None:
        self.offset = offset
        for handle in self.handles:
            handle.visible = visible

    def show(self, time: float) -> None:
        for item, handle in zip(self.objects, self.handles):
            pose = pose_at(self.tracks.get(item.name), item, time)
            wxyz, position = (quat_wxyz_from_matrix(pose.R.double()).numpy(), pose.t.double().numpy() + self.offset)
            if not (np.array_equal(wxyz, handle.wxyz) and np.array_equal(position, handle.position)):
                handle.wxyz, handle.position = wxyz, position
