"""ECHO's ground truth and tables: metrics of body, object and contacts."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.contact_points import BODY_POINTS, TOUCH_M, contact_points
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, interpolate_clamped, nearest_frames, resample
from wearcap.metrics import objects as object_metrics
from wearcap.metrics.detection import detection_scores
from wearcap.metrics.physics import foot_contact, plausibility
from wearcap.metrics.position import body_parts, joint_error_cm, mpjpe_cm, part_errors_cm
from wearcap.metrics.posture import errors_by_posture, postures
from wearcap.metrics.symmetry import closest_surface_error_cm
from wearcap.metrics.table import TRUTH, Row, both_walking
from wearcap.recording import Motion, Recording
from wearcap.recording.active_objects import active_at
from wearcap.recording.timing import at_times
from wearcap.systems.echo.observations import ObjectReader, ObjectShape, Scenario

FASTENED = "cabinet_door", "door", "drawer", "window"
"""Categories of objects that hinges and rails hold; the others are loose."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a scenario at a capture's frames."""

    motion: Motion
    floor_height: Float[Tensor, "time"]
    objects: list[ObjectShape]
    active: Int64[Tensor, "time"]
    """Index of the active object in `objects`, -1 without one."""
    T_world_object: list[Rigid]
    """Poses of each object's centre over time."""
    touch: Bool[Tensor, "time point"]
    """Contact of the body's points with the active object."""
    foot_contact: Float[Tensor, "time patch"]
    """Contact of `FOOT_PATCHES` with the floor."""


def truth_of(scenario: Scenario, timestamps: Float64[Tensor, "time"], reader: ObjectReader) -> Truth:
    """Ground truth at `timestamps` (s). Raises WearcapError if motion or an active object's poses are missing."""
    recording, environment = scenario.recording, scenario.environment
    if recording.motion is None:
        raise WearcapError("no true motion to compare with", where=recording.name, expected="a recording with `motion`")
    whole = recording.motion
    times = timestamps.clamp(whole.timestamps[0].item(), whole.timestamps[-1].item())
    motion = at_times(whole, times)
    names = list(dict.fromkeys(span.object for span in scenario.active_objects))
    active = active_at(scenario.active_objects, names, timestamps)
    surface = contact_points(anny_body(motion.skeleton, recording.shape or None))
    touch = torch.zeros(len(times), BODY_POINTS, dtype=torch.bool)
    shapes, poses = [], []
    for number, name in enumerate(names):
        assert environment is not None
        if name not in recording.object_motion:
            raise WearcapError(f"no true poses of {name!r}", where=recording.name, expected="them in `object_motion`")
        shape = reader(environment.by_name(name))
        T = shape.centred(_poses_at(recording.object_motion[name], times))
        rows = (active == number).nonzero()[:, 0]
        touch[rows] = body_contact(surface.vertices(motion.T_world_joint[rows]), shape, T[rows], TOUCH_M)
        shapes.append(shape)
        poses.append(T)
    floor = torch.zeros(len(times))
    if recording.floor is not None:
        floor = interpolate_clamped(recording.floor.timestamps, recording.floor.height, times).float()
    nearest = nearest_frames(whole.timestamps, times)
    return Truth(motion, floor, shapes, active, poses, touch, foot_patches(recording)[nearest].float())


def _poses_at(track: Trajectory, times: Float64[Tensor, "time"]) -> Rigid:
    inside = times.clamp(track.timestamps[0].item(), track.timestamps[-1].item())
    return resample(track, inside).T_world_body


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
    feet, motion = None if recording.contacts is None else recording.contacts.feet, recording.motion
    assert motion is not None
    if feet is None or len(feet) != len(motion):
        what = "no foot contacts beside the motion"
        expected = f"contacts of {', '.join(FOOT_PATCHES)}"
        raise WearcapError(what, where=recording.name, expected=expected, fix="Prepare the data set again.")
    return feet


def score_echo(motion: Motion, truth: Truth, name: str, seed: int) -> Row:
    """ECHO's metrics of one capture in world coordinates without alignment: body over all frames, object over the
    frames in which one is active, of doors, drawers and windows (`FASTENED`) and of loose ones by themselves, too."""
    skeleton, fps = motion.skeleton, motion.fps
    pose, pose_true = motion.T_world_joint.to(torch.float64), truth.motion.T_world_joint.to(torch.float64)
    joints, true = motion.T_world_joint.t, truth.motion.T_world_joint.t
    floor, touching = truth.floor_height, foot_contact(truth.foot_contact > 0.5)
    error = joint_error_cm(joints, true)
    by_part = {part: error[:, mine].mean() for part, mine in body_parts(skeleton).items()}
    by_part |= part_errors_cm(skeleton, error)
    scores = {
        "mpjpe_mm": 10 * error.mean().item(),
        **{f"{part}_pe_mm": 10 * value.item() for part, value in by_part.items()},
        "mpjve_mm": object_metrics.joint_step_error_mm(joints, true).item(),
        "foot_contact": object_metrics.foot_contact_share(skeleton, joints, floor).item(),
        f"{TRUTH}foot_contact": object_metrics.foot_contact_share(skeleton, true, floor).item(),
    }
    scores |= {name: value.item() for name, value in plausibility(skeleton, pose, touching, floor, fps).items()}
    plausible_true = plausibility(truth.motion.skeleton, pose_true, touching, floor, fps)
    scores |= {f"{TRUTH}{name}": value.item() for name, value in plausible_true.items()}
    scores |= both_walking(motion, truth.motion)
    scores |= errors_by_posture(skeleton, postures(skeleton, pose_true, floor, fps), error, "mm")
    busy = truth.active >= 0
    if busy.any():
        scores["busy_mpjpe_mm"] = 10 * mpjpe_cm(joints[busy], true[busy]).item()
        parts: dict[str, list[Tensor]] = {}
        for number, (shape, T_true) in enumerate(zip(truth.objects, truth.T_world_object)):
            rows = (truth.active == number).nonzero()[:, 0]
            track = (motion.object_motion or {}).get(shape.name)
            if track is None or not len(rows):
                continue
            T_found, T_true = shape.centred(_poses_at(track, motion.timestamps[rows])), T_true[rows]
            for key, value in {
                "v2v_cm": object_metrics.vertex_error_cm(T_found, T_true, shape.cloud),
                "symmetric_v2v_cm": shape.symmetry.vertex_error_cm(
                    shape.of_mesh(T_found), shape.of_mesh(T_true), shape.cloud + shape.middle
                ),
                "center_cm": object_metrics.center_error_cm(T_found, T_true, shape.cloud),
                "rotation_deg": object_metrics.rotation_difference_deg(T_found, T_true),
                "quaternion": object_metrics.quaternion_difference(T_found, T_true),
                "symmetric_rotation_deg": shape.symmetry.rotation_difference_deg(T_found, T_true),
                "add_s_cm": closest_surface_error_cm(T_found, T_true, shape.cloud, shape.middle, shape.surface),
            }.items():
                parts.setdefault(key, []).append(value)
                if key in ("center_cm", "symmetric_v2v_cm"):
                    kind = "fastened" if shape.category in FASTENED else "loose"
                    parts.setdefault(f"{kind}_{key}", []).append(value)
        scores |= {key: torch.cat(values).mean().item() for key, values in parts.items()}
    touch = truth.touch[busy]
    if motion.body_contact_prob is not None and motion.object_motion and touch.any():
        found = detection_scores(motion.body_contact_prob[busy].flatten(), touch.flatten())
        precision, recall = found.precision, found.recall  # without recall the precision may be undefined
        scores["touch_f1"] = 2 * precision * recall / (precision + recall) if recall else 0.0
    return Row(name, seed, len(motion), scores)
