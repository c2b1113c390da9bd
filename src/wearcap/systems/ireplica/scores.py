"""Scores of captured interactions against ground truth: thesis Tables 5.1, 5.2, 5.5, and errors during interactions.

No alignment is applied before measuring.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import site_positions
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh, face_normals, random_points
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.metrics.objects import Handling, contact_mean, handlings, object_error
from wearcap.metrics.position import mpjpe_cm
from wearcap.metrics.surface import chamfer
from wearcap.recording import Motion, Recording
from wearcap.recording.motion import Interactions
from wearcap.recording.timing import at_times
from wearcap.scene.objects import Environment, SceneObject
from wearcap.systems.ireplica.object_tracker import PALMS

SETTLED_S = 0.6
"""Time (s) after an object's release at which its final pose is scored, or when it is taken again if that is earlier:
releases are detected late."""
CHAMFER_EVERY_S, CHAMFER_POINTS = 1.0, 1500


@dataclass(frozen=True)
class _InteractionScores:
    """Scores of one capture."""

    handlings: tuple[Handling, ...]
    mpjpe_cm: float
    """Mean per-joint position error in the world over the whole recording."""
    body_chamfer_cm: float
    """Chamfer distance between captured and true body during interactions (Table 5.5)."""
    object_chamfer_cm: float
    """Chamfer distance between captured and true object during interactions (Table 5.5)."""
    false_moves_cm: float
    """Mean displacement of the centres of objects that were never touched, from the first to the last frame."""


def score_interactions(motion: Motion, recording: Recording, environment: Environment) -> _InteractionScores:
    """Score one capture; its object motion may lack objects that never moved. Raises WearcapError when the recording
    lacks a true motion, interactions or object motion, or the capture objects."""
    truth, held = recording.motion, recording.interactions
    if truth is None or held is None or not recording.object_motion:
        expected = "a true motion, interactions and object motion"
        raise WearcapError("nothing to measure interactions against", where=recording.name, expected=expected)
    if motion.object_motion is None:
        raise WearcapError("this capture has no objects", where=recording.name, expected="object_motion")
    true = at_times(truth, motion.timestamps)
    palms = [site_positions(m.skeleton, m.T_world_joint, PALMS) for m in (motion, true)]
    found = {
        scene_object.name: poses_at(motion.object_motion.get(scene_object.name), scene_object, motion.timestamps)
        for scene_object in environment.objects
    }
    real = {
        name: poses_at(recording.object_motion.get(name), environment.by_name(name), motion.timestamps)
        for name in found
    }
    rows = handlings(held.start_s, held.stop_s, held.objects)
    scored = [_handling(row, rows, environment, held, motion.timestamps, palms, found, real) for row in rows]
    body, objects = _chamfer(motion, true, recording, rows, environment, found, real)
    joints = mpjpe_cm(motion.T_world_joint.t, true.T_world_joint.t).item()
    untouched = [scene_object for scene_object in environment.objects if scene_object.name not in held.objects]
    ends = [object_error(found[t.name][[-1]], found[t.name][[0]], _middle_of(t))[0][0] for t in untouched]
    false_moves = float(torch.stack(ends).mean()) if ends else 0.0
    return _InteractionScores(tuple(scored), joints, body, objects, false_moves)


def poses_at(track: Trajectory | None, scene_object: SceneObject, timestamps: Float64[Tensor, "time"]) -> Rigid:
    """Poses of an object at given times; it is static before and after its track, and throughout without a track."""
    if track is None:
        count = len(timestamps)
        return Rigid(scene_object.R_world_object.expand(count, 3, 3), scene_object.t_world_object.expand(count, 3))
    inside = timestamps.clamp(track.timestamps[0], track.timestamps[-1])
    return resample(track, inside).T_world_body


def _middle_of(scene_object: SceneObject) -> Float[Tensor, "3"]:
    """Centre of an object's bounding box in its own axes (m)."""
    vertices = scene_object.mesh.vertices
    return torch.from_numpy((vertices.min(0) + vertices.max(0)) / 2)


def _handling(row, rows, environment, held, timestamps, palms, found, real) -> Handling:
    name, start, stop = row
    scene_object = environment.by_name(name)
    again = min((a for n, a, _ in rows if n == name and a > start), default=float("inf"))
    end = max(int(torch.searchsorted(timestamps, min(stop + SETTLED_S, again))) - 1, 0)
    begin = int(torch.searchsorted(timestamps, start).clamp(max=len(timestamps) - 1))
    middle = _middle_of(scene_object)
    left_cm, left_deg = object_error(found[name][end], real[name][end], middle)
    own = [o == name and start <= a < stop for o, a in zip(held.objects, held.start_s.tolist())]
    mine = torch.tensor(own, dtype=torch.bool)
    unnamed = ("",) * int(mine.sum())
    held = Interactions(held.start_s[mine], held.stop_s[mine], held.hands[mine], unnamed, unnamed)
    frames = slice(begin, max(int(torch.searchsorted(timestamps, stop)), begin + 1))
    contact = held.hand_contact(timestamps[frames])
    apart = torch.stack(
        [environment.distance(name, palms[0][frames, hand], found[name][frames])[0] for hand in range(2)], 1
    )
    during_cm, during_deg = object_error(found[name][frames], real[name][frames], middle)
    moved_cm, _ = object_error(real[name][[end]], real[name][[begin]], middle)
    return Handling(
        name,
        scene_object.category,
        (start, stop),
        float(left_cm),
        float(left_deg),
        float(moved_cm[0]),
        100 * float(contact_mean(apart, contact)),
        100 * float(contact_mean((palms[0] - palms[1])[frames].norm(dim=-1), contact)),
        float(during_cm.mean()),
        float(during_deg.mean()),
    )


def _chamfer(
    motion: Motion, true: Motion, recording: Recording, rows, environment: Environment, found, real
) -> tuple[float, float]:
    """Chamfer distances (cm) between captured and true surfaces of body and handled object, once a second."""
    body = anny_body(motion.skeleton, recording.shape or None)
    thinned = slice(None, None, max(1, len(body.rest_vertices) // CHAMFER_POINTS))
    errors: tuple[list[float], list[float]] = ([], [])
    for name, start, stop in rows:
        times = torch.arange(start, stop, CHAMFER_EVERY_S, dtype=torch.float64)
        frames = torch.searchsorted(motion.timestamps, times).clamp(max=len(motion) - 1).tolist()
        surface = surface_points(environment.by_name(name).mesh)
        for frame in frames:
            bodies = [body.vertices(m.T_world_joint[frame])[thinned] for m in (motion, true)]
            errors[0].append(chamfer(*bodies).mean_cm)
            errors[1].append(chamfer(*(T[name][frame].to(torch.float32) @ surface for T in (found, real))).mean_cm)
    return tuple(float(np.mean(part)) if part else float("nan") for part in errors)  # pyright: ignore[reportReturnType]


def surface_points(mesh: Mesh) -> Float[Tensor, "point 3"]:
    """Points uniform by area on an object's surface (without faces: its vertices), in its own axes, always the same."""
    rng = np.random.default_rng(0)
    if not len(mesh.faces):
        return torch.from_numpy(mesh.vertices[rng.permutation(len(mesh.vertices))[:CHAMFER_POINTS]])
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(face_normals(corners), axis=1)
    chosen = rng.choice(len(mesh.faces), CHAMFER_POINTS, p=area / area.sum())
    return torch.from_numpy(random_points(corners[chosen], rng))
