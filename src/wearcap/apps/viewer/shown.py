"""What the page and pictures show of a motion: its body, its objects, its contacts, and their colours."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import TOUCH_M, contact_points
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh, capsules
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.recording.active_objects import NO_OBJECT, active_at, true_spans
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.scene.objects import Environment, SceneObject

GUESSED_M, GUESSED_COLOR = (0.03, 0.15), np.array([0.93, 0.80, 0.42])
"""Deviations (m) of a bone of the motion's own colour and of one that is all of the other colour, and that (RGB, 0…1)."""
CLOUD_BALLS, CLOUD_BALL_M = 1500, 0.012
"""Number and radius (m) of small balls that show a cloud without faces."""
LIT_PROB = 0.5
"""Probability of contact above which points are shown."""
BALL_M = 0.018
"""Radius of a ball (m)."""
DIM, BRIGHT = np.array([0.55, 0.16, 0.02]), np.array([1.0, 0.86, 0.10])
"""Colours (RGB) at the threshold and at probability 1."""


def nearest_frame(timestamps: Float64[Tensor, "time"], time: float) -> int:
    """Index of the frame nearest in time."""
    return int(nearest_frames(timestamps, torch.tensor([time], dtype=torch.float64))[0])


def stick_body(skeleton: Skeleton) -> BodyModel:
    """Capsules along the bones and a ball for the head: a body for any skeleton."""
    rest = skeleton.rest_joints.double().numpy()
    joints = [joint for joint in range(1, len(skeleton)) if np.linalg.norm(skeleton.t_parent_joint[joint]) > 1e-4]
    bones = [skeleton.parents[joint] for joint in joints]
    radius = np.clip([0.12 * float(skeleton.t_parent_joint[j].norm()) for j in joints], 0.012, 0.05)
    start, end = rest[bones], rest[joints]
    if "head" in skeleton:
        head = skeleton.index("head")
        start, end = (np.concatenate([points, rest[[head]] + [0.02, 0.0, 0.09]]) for points in (start, end))
        radius, bones = np.append(radius, 0.10), [*bones, head]
    mesh = capsules(start, end, radius, radius, np.zeros((len(bones), 3)), segments=12)
    bone_of_vertex = torch.tensor(bones).repeat_interleave(len(mesh.vertices) // len(bones))
    weights = torch.zeros(len(bone_of_vertex), 4)
    weights[:, 0] = 1
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces).long()
    return BodyModel(skeleton, vertices, faces, bone_of_vertex[:, None].repeat(1, 4), weights)


def surface_or_sticks(skeleton: Skeleton, shape: dict[str, float]) -> BodyModel:
    """The default human, or sticks where the skeleton is no human's."""
    try:
        return anny_body(skeleton, shape)
    except WearcapError:
        return stick_body(skeleton)


def vertex_colors(
    body: BodyModel, motion: Motion, frame: int, color: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "vertex 3"] | Float[np.ndarray, "3"]:
    """Colours (RGB, 0…1) of a body's vertices: the farther bones are known only roughly (`joint_std`, of both ends), the more
    of `GUESSED_COLOR`; the one colour of a motion that does not say."""
    if motion.joint_std is None:
        return color
    ends = motion.joint_std[frame].double().numpy()
    bones = np.stack([ends, ends])  # a joint's bone reaches to its children
    for joint, parent in enumerate(motion.skeleton.parents):
        if parent >= 0:
            bones[1, parent] = max(bones[1, parent], ends[joint])
    known, guessed = GUESSED_M
    share = ((bones.mean(0) - known) / (guessed - known)).clip(0.0, 1.0)
    weights = body.skin_weights.double().numpy()
    share = (share[body.skin_joints.numpy()] * weights).sum(-1, keepdims=True) / weights.sum(-1, keepdims=True)
    return color + share * (GUESSED_COLOR - color)


def by_height(
    points: Float[np.ndarray, "point 3"],
    low: float,
    high: float,
    colors: Sequence[Sequence[float]] = ((60, 90, 130), (220, 170, 90)),
) -> Float[np.ndarray, "point 3"]:
    """Colours of points without colours: from blue at the height `low` (m) to sand at `high`."""
    share = np.clip((points[:, 2:] - low) / max(high - low, 1e-6), 0, 1)
    return (1 - share) * np.array(colors[0]) + share * np.array(colors[1])


def poses_at(track: Trajectory | None, item: SceneObject, times: Float64[Tensor, "time"]) -> Rigid:
    """Displayed poses of an object at times (s): of the nearest frames of its track, or the initial one without a track."""
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
    meshes, times = [], torch.tensor([time_s], dtype=torch.float64)
    for item in environment.objects:
        T = poses_at(tracks.get(item.name), item, times)[0]
        R, t, mesh = T.R.double().numpy(), T.t.double().numpy(), shown_mesh(item)
        meshes.append(replace(mesh, vertices=(mesh.vertices @ R.T + t).astype(np.float32)))
    return meshes


def with_objects(recording: Recording, environment: Environment | None = None) -> Motion | None:
    """The true motion with the true objects, hand contacts and contact points, for viewers of single motions."""
    truth = recording.motion
    if truth is None:
        return None
    labels = recording.interactions
    hands = None if labels is None else labels.hand_contact(truth.timestamps).to(truth.t_world_root.dtype)
    points = None if environment is None else _true_body_contact(recording, truth, environment)
    objects = recording.object_motion or None
    return replace(truth, object_motion=objects, hand_contact_prob=hands, body_contact_prob=points)


def _true_body_contact(
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
    spans = [span for span in true_spans(recording) if span.object in names]
    active = active_at(spans, names, truth.timestamps)
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
