"""Display of an environment's objects and of a body's contacts with them: posed meshes, and layers of the page."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
import trimesh
import viser
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, TOUCH_M, contact_points
from wearcap.body.model import BodyModel
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
from wearcap.viewer.page_layers import MotionLayer, nearest_frame

CLOUD_BALLS, CLOUD_BALL_M = 1500, 0.012
"""Number and radius (m) of small balls that show a cloud without faces."""
LIT_PROB = 0.5
"""Probability of contact above which points are shown."""
BALL_M = 0.018
"""Radius of a ball (m)."""
DIM, BRIGHT = np.array([0.55, 0.16, 0.02]), np.array([1.0, 0.86, 0.10])
"""Colours (RGB) at the threshold and at probability 1."""


def poses_at(track: Trajectory | None, item: SceneObject, times: Float64[Tensor, "time"]) -> Rigid:
    """Displayed poses of an object at times (s): of the nearest frames of its track, or the initial one without a track."""
    if track is None or not len(track):
        T = item.T_world_object
        return Rigid(T.R.expand(len(times), 3, 3), T.t.expand(len(times), 3))
    return track.T_world_body[nearest_frames(track.timestamps, times)]


@lru_cache(maxsize=1024)
def _shown_mesh(item: SceneObject) -> Mesh:
    """An object's triangles in its own axes; small balls at the points of a cloud."""
    if len(item.mesh.faces):
        return item.mesh
    points = item.mesh.vertices[:: max(1, len(item.mesh.vertices) // CLOUD_BALLS)].astype(np.float64)
    size = np.full(len(points), CLOUD_BALL_M)
    return capsules(points, points, size, size, np.full((len(points), 3), 0.6), 4)


def posed_meshes(environment: Environment, tracks: dict[str, Trajectory], time_s: float) -> list[Mesh]:
    """Meshes of all objects at a time (s), in the world."""
    meshes, times = [], torch.tensor([time_s], dtype=torch.float64)
    for item in environment.objects:
        T = poses_at(tracks.get(item.name), item, times)[0]
        R, t, mesh = T.R.double().numpy(), T.t.double().numpy(), _shown_mesh(item)
        meshes.append(replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32)))
    return meshes


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
        low, high = torch.from_numpy(np.stack([item.mesh.vertices.min(0), item.mesh.vertices.max(0)]))
        middle = T.R @ ((low + high) / 2).to(T.R) + T.t
        near = (places - middle[:, None]).norm(dim=-1) <= (high - low).norm() / 2 + TOUCH_M  # others cannot touch it
        distance, _ = environment.distance(item.name, places[near], T[near.nonzero()[:, 0]])
        touching = torch.zeros_like(near)
        touching[near] = distance <= TOUCH_M
        touches[take] = touching.to(touches.dtype)
    return touches


def lit_color(prob: Float[Tensor, "point"]) -> Float[np.ndarray, "point 3"]:
    """Colours (RGB, 0…1) of points by their probability of contact."""
    share = ((prob.double().numpy() - LIT_PROB) / (1 - LIT_PROB)).clip(0.0, 1.0)
    return DIM + share[:, None] * (BRIGHT - DIM)


def lit_points(points: BodyModel, motion: Motion, frame: int) -> Mesh | None:
    """Balls at the contact points of one frame; None if there are none. `points` is a body of contact points alone."""
    if motion.body_contact_prob is None:
        return None
    prob = motion.body_contact_prob[frame]
    lit = prob > LIT_PROB
    if not lit.any():
        return None
    places = points.vertices(motion.T_world_joint[frame])[lit].double().numpy()
    size = np.full(len(places), BALL_M)
    return capsules(places, places, size, size, lit_color(prob[lit]), 8)


class BodyPointsLayer(MotionLayer):
    """The balls of one motion on the page; a frame is their positions, sizes (0 without contact) and colours."""

    def __init__(self, server: viser.ViserServer, name: str, motion: Motion, body: BodyModel):
        self.motion, self.points = motion, contact_points(body)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=BALL_M)
        self.handle = server.scene.add_batched_meshes_simple(
            f"/{name}",
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (BODY_POINTS, 1)),
            batched_positions=np.zeros((BODY_POINTS, 3)),
            batched_scales=np.zeros(BODY_POINTS),
            batched_colors=np.zeros((BODY_POINTS, 3), np.uint8),
            cast_shadow=False,
            lod="off",
        )
        super().__init__(self.handle)

    def show(self, time: float) -> None:
        frame = nearest_frame(self.motion.timestamps, time)
        assert self.motion.body_contact_prob is not None
        prob = self.motion.body_contact_prob[frame]
        size = (prob > LIT_PROB).float().numpy()
        if not size.any() and not np.any(self.handle.batched_scales):
            return
        pose = self.motion.T_world_joint[frame]
        # The balls' parent node is at the root, so that the browser's culling considers the body's position.
        root = pose.t[0].double().numpy()
        self.handle.position = root + self.offset
        self.handle.batched_positions = (self.points.vertices(pose).double().numpy() - root).astype(np.float32)
        self.handle.batched_scales = size
        self.handle.batched_colors = (255 * lit_color(prob)).round().astype(np.uint8)


class ObjectsLayer(MotionLayer):
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
        self.objects, self.tracks, handles = tuple(objects), tracks, []
        for item in self.objects:
            mesh = _shown_mesh(item)
            color = 255 * np.atleast_2d(mesh.color).mean(0)
            if tint is not None:
                color = (color + tint) / 2
            handles.append(
                server.scene.add_mesh_simple(
                    f"/{name}/{item.name}",
                    mesh.vertices,
                    mesh.faces.astype(np.uint32),
                    color=tuple(int(c) for c in color),
                )
            )
        super().__init__(*handles)

    def show(self, time: float) -> None:
        for item, handle in zip(self.objects, self.handles):
            pose = poses_at(self.tracks.get(item.name), item, torch.tensor([time], dtype=torch.float64))[0]
            wxyz, position = (quat_wxyz_from_matrix(pose.R.double()).numpy(), pose.t.double().numpy() + self.offset)
            if not (np.array_equal(wxyz, handle.wxyz) and np.array_equal(position, handle.position)):
                handle.wxyz, handle.position = wxyz, position
