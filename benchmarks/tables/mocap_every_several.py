"""MocapEvery's several wearers (§3.4, φ_T): each one's capture is edited by what the other's head camera sees.

Pairs are simulated; CMU's people, whose motion is real, are each watched by a simulated wearer who stands before them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.stats import norm
from torch import Tensor

from benchmarks.tables.sensed import sensed
from benchmarks.tables.two_wearers import face_to_face, simulate_two_wearers
from wearcap.body.kinematics import forward_kinematics
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.metrics.position import body_parts, joint_error_cm
from wearcap.metrics.scores import truth_at
from wearcap.metrics.table import Row
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import at_times
from wearcap.sensors.simulated import smooth_noise
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.visual_cues import View, VisualCues, capture_session
from wearsim.recordings.simulate import SimulationConfig
from wearsim.sensors.keypoints import ACTION_CAMERA, BURST_S, NEAR_M, action_camera, camera_path

SCENES = (
    ("flat", ("stand", "gesture", "look_around")),
    ("flat", ("hold", "turn")),
    ("flat", ("crouch", "stand")),
    ("outdoor", ("walk", "stand")),
)
"""Surroundings and activities of the pairs, in turn. Those who walk part soon, outdoors, where no walls would hide them."""
DURATION_S, SHORTEST_S = 20.0, 3.0
"""Length (s) of the simulated pairs, and of the shortest recording of CMU that is watched."""
WATCHED_FROM_M = 4.0
VIEW_DEG, VIEW_MISSED = 12.0, 0.1
"""Error (°) of the local rotations that an off-the-shelf monocular estimator gives, and share of the frames that it misses.

With 12° joints are 9.4 cm off relative to the root, 7.5 cm after Procrustes alignment; on 3DPW, SPIN is 9.7 and 5.9 cm
off, HMR 2.0 7.0 and 4.4 cm."""
POSE_DRIFT_S, POSE_JITTER = 2.0, 1 / 6
"""Time (s) over which the errors of an estimated pose vary, and the share of them that is new in every frame."""
FRAMES = ("all frames", "frames seen")
VIEWS = {"edited by the other's view": (VIEW_DEG, VIEW_MISSED), "edited by exact views": (0.0, 0.0)}
"""Rows: error (°) and missed share of their views; those of exact views are the most that the editing can reach."""


@dataclass(frozen=True)
class Watched:
    """A wearer whom another wearer's head camera may see."""

    recording: Recording
    T_world_cam: Trajectory
    """True poses of the other's camera."""

    def view(self, error_deg: float, missed: float) -> View:
        """The other's view of this wearer."""
        assert self.recording.motion is not None
        rng = np.random.default_rng([7, *self.recording.name.encode()])
        return View(*seen_pose(self.recording.motion, self.T_world_cam, ACTION_CAMERA, error_deg, missed, rng))


@cache
def pair_of(split: str, number: int) -> tuple[Recording, Recording]:
    """The number-th pair of a split's people, always the same."""
    world, activities = SCENES[number % len(SCENES)]
    config = SimulationConfig(DURATION_S, points=False, suit=None, world=world, activities=activities)
    return simulate_two_wearers(config, f"{split}-pair-{number}", split, number)


def watched_pair(split: str, number: int) -> list[Watched]:
    """The wearers of a simulated pair, each watched by the other."""
    pair = pair_of(split, number)
    return [Watched(wearer, _camera_of(other)) for wearer, other in zip(pair, reversed(pair))]


def _camera_of(wearer: Recording) -> Trajectory:
    assert wearer.motion is not None
    assert wearer.camera is not None
    return camera_path(wearer.motion, wearer.camera)


def watched_person(recording: Recording, split: str) -> Watched | None:
    """A wearer of a data set, watched by the first of the simulated; None where the recording is too short."""
    motion, watcher = recording.motion, pair_of(split, 0)[0].motion
    assert motion is not None
    assert watcher is not None
    if motion.timestamps[-1] - motion.timestamps[0] < SHORTEST_S:
        return None
    there = watcher.moved(face_to_face(motion, watcher, WATCHED_FROM_M))
    camera = action_camera(watcher.timestamps[::2].contiguous())
    path = camera_path(there, camera)
    during = (path.timestamps >= motion.timestamps[0]) & (path.timestamps <= motion.timestamps[-1])
    path = Trajectory(path.timestamps[during], path.R_world_body[during], path.t_world_body[during])
    return Watched(replace(recording, session=recording.name), path)


def session_rows(
    session: Sequence[Watched], sensors: str, pipeline: MocapEvery, editor: VisualCues
) -> dict[str, list[Row]]:
    """Scores of a session's wearers by row, over all frames, and over those in which the other sees any of them."""
    worn = [replace(sensed(w.recording, sensors), session=w.recording.session) for w in session]
    captured = {recording.name: pipeline.run(recording).motion for recording in worn}
    motions = {"estimated": captured}
    for label, errors in VIEWS.items():
        views = {each.recording.name: [each.view(*errors)] for each in session}
        motions[label] = capture_session(worn, lambda r: captured[r.name], editor, views)
    rows: dict[str, list[Row]] = {}
    for frames, label, each in product(FRAMES, motions, session):
        name, shown = each.recording.name, each.view(0.0, 0.0)
        motion = motions[label][name]
        truth, _ = truth_at(motion, each.recording, name)
        seen = shown.confidence[nearest_frames(shown.motion.timestamps, truth.timestamps)].any(1)
        seen &= truth.timestamps <= shown.motion.timestamps[-1]
        mask = seen | (frames == FRAMES[0])
        if mask.any():
            rows.setdefault(f"{frames}, {label}", []).append(_at(motion, truth, mask, name))
    return rows


def _at(motion: Motion, truth: Motion, frames: Bool[Tensor, "time"], name: str) -> Row:
    """Scores in the world over some frames; jitter over those whose next three are among them, too."""
    joints = forward_kinematics(motion.skeleton, motion.R_parent_joint.double(), motion.t_world_root.double()).t
    error = joint_error_cm(joints.float(), truth.T_world_joint.t)[frames].mean(0)
    jerk = motion.fps**3 * joints.diff(n=3, dim=0).norm(dim=-1)[frames.unfold(0, 4, 1).all(-1)]
    scores = {f"{part}_pe_cm": error[indices].mean().item() for part, indices in body_parts(truth.skeleton).items()}
    scores |= {"mpjpe_cm": error.mean().item(), "jitter_m_s3": jerk.mean().item()}
    return Row(name, 0, int(frames.sum()), scores)


def seen_pose(
    motion: Motion, T_world_cam: Trajectory, camera: Camera, error_deg: float, drop: float, rng: np.random.Generator
) -> tuple[Motion, Float[Tensor, "time joint"]]:
    """Simulated monocular estimate of a person's pose in a camera's frames, and the confidence of each joint's rotation.

    Confidence is 0 where the joint or one of its children is outside the image, and in a share `drop` of the frames, in
    short bursts. Local rotations are off by `error_deg` (root mean square angle): half of the variance is constant, half
    drifts, and there is a little jitter (`POSE_JITTER`). The error level varies over the same time, and confidence
    decreases with it. The root is the true one.
    """
    seen = at_times(motion, T_world_cam.timestamps)
    count, joints, fps = len(seen), len(seen.skeleton), seen.fps
    p_cam = T_world_cam.T_world_body.inverse()[:, None] @ seen.T_world_joint.t
    _, inside = camera.project(p_cam)
    outside = ~(inside & (torch.linalg.vector_norm(p_cam, dim=-1) > NEAR_M))
    parents = torch.tensor(seen.skeleton.parents[1:])
    hidden = outside.float().index_add(1, parents, outside[:, 1:].float()) > 0
    missed = smooth_noise(rng, count, 1, BURST_S, fps) > norm.isf(drop)
    level = (0.4 * smooth_noise(rng, count, 1, POSE_DRIFT_S, fps)).exp()
    fixed = torch.from_numpy(rng.standard_normal((1, 3 * joints))).float()
    drift, jitter = (smooth_noise(rng, count, 3 * joints, period, fps) for period in (POSE_DRIFT_S, 0.0))
    error = np.deg2rad(error_deg) / np.sqrt(3) * level * ((fixed + drift) / np.sqrt(2) + POSE_JITTER * jitter)
    error = error.unflatten(1, (joints, 3))
    error[:, 0] = 0
    confidence = 1 / (1 + 0.25 * level**2) if error_deg else torch.ones(count, 1)
    return replace(seen, R_parent_joint=seen.R_parent_joint @ rotation.exp(error)), confidence * ~(hidden | missed)
