"""Objects of an interactive environment as they are shown: posed meshes, and a layer of the page."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import viser

from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.scene.environment import Environment
from wearcap.scene.objects import SceneObject

CLOUD_BALLS, CLOUD_BALL_M = 1500, 0.012
"""A cloud without faces is shown as so many small balls."""


def pose_at(track: Trajectory | None, thing: SceneObject, time_s: float) -> Rigid:
    """Where an object is shown: its pose at the nearest frame of its track, or the initial one without a track."""
    if track is None or not len(track):
        return thing.T_world_object
    return track.T_world_body[int((track.timestamps - time_s).abs().argmin())]


@lru_cache(maxsize=1024)
def shown_mesh(thing: SceneObject) -> Mesh:
    """An object's triangles in its own axes; small balls at the points of a cloud."""
    if len(thing.mesh.faces):
        return thing.mesh
    points = thing.mesh.vertices[:: max(1, len(thing.mesh.vertices) // CLOUD_BALLS)].astype(np.float64)
    size = np.full(len(points), CLOUD_BALL_M)
    return capsules(points, points, size, size, np.full((len(points), 3), 0.6), 4)


def posed_meshes(environment: Environment, tracks: dict[str, Trajectory], time_s: float) -> list[Mesh]:
    """All objects at a time (s), in the world."""
    return [
        moved(shown_mesh(thing), pose_at(tracks.get(thing.name), thing, time_s))
        for thing in environment.objects
    ]


def moved(mesh: Mesh, T_world_object: Rigid) -> Mesh:
    """A mesh of an object's axes in the world."""
    R, t = T_world_object.R.double().numpy(), T_world_object.t.double().numpy()
    return replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32))


def with_objects(recording: Recording) -> Motion | None:
    """The true motion with the true objects and hands, for viewers that show one motion each."""
    truth = recording.motion
    if truth is None:
        return None
    held = recording.interactions
    hands = None if held is None else held.hand_contact(truth.timestamps).to(truth.t_world_root.dtype)
    return replace(truth, object_motion=recording.object_motion or None, hand_contact_prob=hands)


class ObjectsLayer:
    """Objects on the page; a frame is one pose per object."""

    def __init__(self, server: viser.ViserServer, environment: Environment, tracks: dict[str, Trajectory]):
        self.environment, self.tracks = environment, tracks
        self.handles = []
        for thing in environment.objects:
            mesh = shown_mesh(thing)
            color = np.atleast_2d(mesh.color).mean(0)
            self.handles.append(server.scene.add_mesh_simple(
                f"/objects/{thing.name}", mesh.vertices, mesh.faces.astype(np.uint32),
                color=tuple(int(255 * c) for c in color),
            ))  # fmt: skip

    def show(self, time: float) -> None:
        for thing, handle in zip(self.environment.objects, self.handles):
            pose = pose_at(self.tracks.get(thing.name), thing, time)
            handle.wxyz = quat_wxyz_from_matrix(pose.R.double()).numpy()
            handle.position = pose.t.double().numpy()
