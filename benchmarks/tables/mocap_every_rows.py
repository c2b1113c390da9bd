"""What MocapEvery's tables capture: rows on recordings as devices sense them, hands as a camera sees them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from benchmarks.rivals import compose
from benchmarks.tables.sensed import sensed
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.cli.conf import load_pipeline
from wearcap.geometry.trajectory import interpolate_clamped
from wearcap.metrics.position import joint_error_cm
from wearcap.metrics.scores import score_in_world, truth_at
from wearcap.metrics.table import Row, evaluate_motion
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.systems.mocap_every.energy import LatentSolver
from wearcap.systems.mocap_every.pipeline import CapturedWithFloor, MocapEvery
from wearcap.systems.mocap_every.visual_cues import at_frames, load_visual_cues
from wearsim.sensors.keypoints import action_camera, camera_path, seen_joints

NEAR_M = 0.03
DETECTOR_PX, MISSED = 4.0, 0.1


@dataclass(frozen=True)
class Method:
    """A row: a checkpoint, how it captures, and what it senses."""

    name: str
    checkpoint: str
    sensors: str
    """Preset of the errors of head and watches (`WEARABLES`), or `GIVEN`."""
    pipeline: tuple[str, ...] = ("pipeline=mocap_every",)
    height_off_m: float | None = None
    """How far the height that the wearer gives is off (m); None: as the preset knows it."""


def pipeline_of(method: Method) -> MocapEvery:
    pipeline = load_pipeline(method.checkpoint, compose("evaluate", list(method.pipeline)).pipeline, "cpu")
    assert isinstance(pipeline, MocapEvery)
    return pipeline


def captures(
    method: Method, store: RecordingStore, names: Sequence[str], step: Callable[[], None]
) -> Iterator[tuple[Recording, Recording, CapturedWithFloor]]:
    """Every recording with its truth, what devices sense of it, and what is captured of that."""
    pipeline = pipeline_of(method)
    for name in names:
        recording = store.load(name)
        given = sensed(recording, method.sensors, method.height_off_m)
        yield recording, given, pipeline.run(given)
        step()


def body_row(recording: Recording, captured: CapturedWithFloor, seed: int = 0) -> Row:
    """Scores in the world, the paper's metrics among them."""
    return score_in_world(captured.motion, recording, recording.name, seed)


def floor_row(recording: Recording, given: Recording, captured: CapturedWithFloor) -> Row:
    """Body and floor: where the floor is below the head as tracked, against the recording's, and what is stood on."""
    row = body_row(recording, captured)
    assert recording.floor is not None
    found = captured.floor
    true = interpolate_clamped(recording.floor.timestamps, recording.floor.height, found.timestamps)
    height = found.height - _tracked_too_high(recording, given, found.timestamps)
    stood = floor_error_m(height, *_ground(recording, captured.motion))
    smooth = floor_error_m(_smoothed(height, captured.motion.fps), *_ground(recording, captured.motion))
    scores = row.scores | {
        "floor_cm": 100 * (height - true).abs().mean().item(),
        "floor_within_3cm": 100 * (stood < NEAR_M).float().mean().item(),
        "floor_within_3cm_smoothed": 100 * (smooth < NEAR_M).float().mean().item(),
    }
    return replace(row, scores=scores)


def _tracked_too_high(recording: Recording, given: Recording, at: Float64[Tensor, "time"]) -> Float[Tensor, "time"]:
    """Height (m) by which the head's tracking is above the true head: SLAM's world drifts, and the floor with it."""
    heads = []
    for each in (recording, given):
        assert each.head is not None
        heads.append(interpolate_clamped(each.head.timestamps, each.head.T_world_head.t[:, 2], at))
    return heads[1] - heads[0]


def _ground(recording: Recording, motion: Motion) -> tuple[Tensor, Tensor]:
    truth, contact = truth_at(motion, recording, recording.name)
    assert contact is not None
    soles = site_positions(truth.skeleton, truth.T_world_joint, FOOT_PATCHES)[..., 2]
    patches = torch.where(contact, soles, torch.inf).unflatten(-1, (2, 2)).amin(-1)
    return stood_on(patches, contact.unflatten(-1, (2, 2)).any(-1))


def _smoothed(height: Tensor, fps: float) -> Tensor:
    """Averaged over half a second before and behind (Gaussian), as can be done when all is over."""
    reach = torch.arange(-int(1.5 * fps), int(1.5 * fps) + 1)
    kernel = torch.exp(-0.5 * (reach / (0.5 * fps)) ** 2)
    padded = torch.nn.functional.pad(height[None, None], (len(reach) // 2,) * 2, mode="replicate")[0, 0]
    return padded.unfold(0, len(reach), 1) @ (kernel / kernel.sum())


def cue_row(
    recording: Recording, sensors: str, pipeline: MocapEvery, manifold: str, solver: LatentSolver
) -> tuple[Row, Row] | None:
    """Scores at the frames that show the right wrist, before and after editing by it; None where none does."""
    motion, head = recording.motion, recording.head
    assert motion is not None
    assert head is not None
    camera = action_camera(head.timestamps)
    rng = np.random.default_rng([6, *recording.name.encode()])
    cues = seen_joints(motion, camera_path(motion, camera), camera.camera, ["right_wrist"], DETECTOR_PX, MISSED, rng)
    if not cues:
        return None
    shown = replace(sensed(recording, sensors), camera=camera, cues=cues)
    before = pipeline.run(shown).motion
    seen = at_frames(cues["right_wrist"], before.timestamps).confidence > 0
    if not seen.any():
        return None
    editor = load_visual_cues(manifold, solver=solver)
    T_world_head = before.joint("head")
    after, _ = editor.edit(before, shown, T_world_head)
    truth, _ = truth_at(before, recording, recording.name)
    return tuple(_at(motion, truth, seen, recording.name) for motion in (before, after))  # pyright: ignore[reportReturnType]


def _at(motion: Motion, truth: Motion, seen: Tensor, name: str) -> Row:
    skeleton = truth.skeleton
    error = joint_error_cm(motion.T_world_joint.t, truth.T_world_joint.t)[seen].mean(0)
    arm = skeleton.indices("right_shoulder", "right_elbow", "right_wrist")
    upper = [
        skeleton.index(j)
        for j in skeleton.joint_names
        if not any(p in j for p in ("hip", "knee", "ankle", "toe", "pelvis"))
    ]
    scores = {
        "right_hand_cm": error[arm[-1]].item(),
        "right_arm_cm": error[arm].mean().item(),
        "upper_cm": error[upper].mean().item(),
        "mpjpe_cm": error.mean().item(),
        "jitter_m_s3": evaluate_motion(motion, truth)["jitter_m_s3"],
    }
    return Row(name, 0, int(seen.sum()), scores)


def stood_on(
    sole_height: Float[Tensor, "time foot"], contact: Bool[Tensor, "time foot"]
) -> tuple[Float[Tensor, "time"], Float[Tensor, "time"]]:
    """Lowest and highest ground (m) that the feet stand on, or stood on last.

    `sole_height` is the height of each foot's lowest point. On level ground and slopes both are nearly equal; on stairs
    they differ by a step. Before its first contact a foot uses the ground of that contact; a foot without contact is
    ignored.
    """
    ground = []
    frames = torch.arange(len(contact))
    for foot in range(contact.shape[1]):
        stands = contact[:, foot].nonzero()[:, 0]
        if not len(stands):
            continue
        latest = stands[(torch.searchsorted(stands, frames, right=True) - 1).clamp_min(0)]
        ground.append(sole_height[latest, foot])
    if not ground:
        nowhere = torch.full((len(contact),), torch.nan)
        return nowhere, nowhere
    both = torch.stack(ground)
    return both.amin(0), both.amax(0)


def floor_error_m(
    height: Float[Tensor, "time"], low: Float[Tensor, "time"], high: Float[Tensor, "time"]
) -> Float[Tensor, "time"]:
    """Distance (m) of a floor's height from the interval between the lowest and the highest ground stood on."""
    return torch.maximum(low - height, height - high).clamp_min(0)
