"""Scores of captured motions against ground truth: thesis §4.5, Tables 4.1 to 4.3, drift.

No alignment is applied before measuring. Inputs are in m, errors in cm.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from benchmarks.rivals.foot_surface import FootSurface, foot_surface, foot_vertices
from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.errors import WearcapError
from wearcap.geometry.surface import SurfaceIndex
from wearcap.metrics.position import joint_error_cm
from wearcap.metrics.surface import Chamfer, chamfer
from wearcap.metrics.table import evaluate_motion
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Intervals
from wearcap.recording.timing import resampled
from wearcap.scene.scan import Scan

FEET_S, FEET_EVERY_S = 2.0, 6.0
"""Feet are scored in the first `FEET_S` of every `FEET_EVERY_S` (s): in total about the thesis's three minutes."""
BIN_M = 20.0
"""Length of path (m) over which errors are averaged before a slope is fitted."""


@dataclass(frozen=True, eq=False)
class RigCloud:
    """Point cloud of the wearer from the rig's depth cameras at one instant (m, world)."""

    time_s: float
    """Time on the suit's clock."""
    points: Float[Tensor, "point 3"]


@dataclass(frozen=True, eq=False)
class HpsTruth:
    """Ground truth of one recording. Make it with `HpsTruth.of`."""

    motion: Motion
    """True motion at the captures' frames."""
    body: BodyModel
    """The wearer's body; a capture is scored with one of its own skeleton and the wearer's `shape`."""
    shape: dict[str, float] | None
    surface: SurfaceIndex
    contact: Bool[Tensor, "time patch"]
    """Foot contact as the suit reports it: the thesis's "frames when foot contact is detected"."""
    true_contact: Bool[Tensor, "time patch"]
    visits: tuple[tuple[RigCloud, ...], ...]
    """Clouds of each interval of the recording."""

    @classmethod
    def of(
        cls, recording: Recording, scan: Scan, visits: Sequence[Sequence[RigCloud]], fps: float = 30.0
    ) -> "HpsTruth":
        """Ground truth of a recording at `fps`; suit and true motion share their timestamps, as simulated ones do.
        Raises WearcapError when the recording lacks a suit with contacts, a true motion or true contacts."""
        motion, suit = recording.motion, recording.suit
        feet = None if recording.contacts is None else recording.contacts.feet
        if motion is None or suit is None or suit.contact_prob is None or feet is None:
            expected = "a true motion, true contacts, and a suit with contacts"
            raise WearcapError("nothing to measure a capture against", where=recording.name, expected=expected)
        touching = replace(motion, contact_prob=feet.float())
        true = resampled(touching, fps)
        detected = resampled(suit, fps).contact_prob
        assert true.contact_prob is not None
        assert detected is not None
        return cls(
            true,
            anny_body(motion.skeleton, recording.shape or None),
            recording.shape or None,
            scan.surface,
            detected >= 0.5,
            true.contact_prob >= 0.5,
            tuple(tuple(clouds) for clouds in visits),
        )


@dataclass(frozen=True)
class Drift:
    """Root error as a function of the distance walked, and its slope."""

    distance_m: tuple[float, ...]
    """Centres of the distance bins."""
    error_cm: tuple[float, ...]
    """Mean root error of each bin."""
    slope_cm_per_100m: float


@dataclass(frozen=True)
class HpsScores:
    """Scores of one capture; NaN where there was nothing to measure."""

    literal: tuple[Chamfer, ...]
    """Chamfer distance of each interval between vertices and points, in both directions, as in the thesis."""
    surface: tuple[Chamfer, ...]
    """Chamfer distance of each interval with points measured to the body's surface (ours)."""
    feet: FootSurface
    """Foot scores during the contacts that the suit reports (Table 4.3)."""
    feet_true_contact: FootSurface
    """Foot scores during true contacts."""
    drift: Drift
    joints: dict[str, float]
    """Scores of `metrics.table.evaluate_motion` over the whole recording."""


def score_hps(motion: Motion, truth: HpsTruth) -> HpsScores:
    """Score one capture. Raises WearcapError unless it has the truth's joints and timestamps, and finite poses."""
    joints = evaluate_motion(motion, truth.motion, truth.true_contact)
    body = anny_body(motion.skeleton, truth.shape)
    literal, surface = zip(*(interval_chamfer(motion, body, clouds) for clouds in truth.visits))
    error = joint_error_cm(motion.T_world_joint.t, truth.motion.T_world_joint.t)[:, 0]
    return HpsScores(
        literal,
        surface,
        _foot_scores(motion, body, truth, truth.contact),
        _foot_scores(motion, body, truth, truth.true_contact),
        drift(travelled_m(truth.motion), error),
        joints,
    )


def visit_times(intervals: Intervals, count: int = 10) -> Float64[Tensor, "interval frame"]:
    """Instants (s) at which the rig's clouds are taken: evenly spread over each interval, without its ends."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return intervals.start_s[:, None] + (intervals.stop_s - intervals.start_s)[:, None] * share


def interval_chamfer(motion: Motion, body: BodyModel, clouds: Sequence[RigCloud]) -> tuple[Chamfer, Chamfer]:
    """Mean Chamfer distance between clouds and the captured body: (vertices to points, points to surface). Raises
    WearcapError for a cloud more than half a frame away from every frame of the motion."""
    times = torch.tensor([cloud.time_s for cloud in clouds], dtype=torch.float64)
    frames = nearest_frames(motion.timestamps, times)
    vertices = body.vertices(motion.T_world_joint[frames])
    literal = [chamfer(v, cloud.points) for v, cloud in zip(vertices, clouds)]
    surface = [chamfer(v, cloud.points, faces=body.faces) for v, cloud in zip(vertices, clouds)]
    return mean_chamfer(literal), mean_chamfer(surface)


def nearest_frames(timestamps: Float64[Tensor, "time"], at: Float64[Tensor, "instant"]) -> Tensor:
    """Frame nearest to each instant (s). Raises WearcapError for an instant more than half a frame away from it."""
    frames = (timestamps[:, None] - at).abs().argmin(0)
    off = (timestamps[frames] - at).abs()
    if off.max() > 0.51 * timestamps.diff().median():
        what = f"no captured frame at {at[off.argmax()]:.2f} s"
        raise WearcapError(what, expected="a capture of the whole recording")
    return frames


def _foot_scores(motion: Motion, body: BodyModel, truth: HpsTruth, contact: Bool[Tensor, "time patch"]) -> FootSurface:
    """Foot-to-scan distance and foot sliding of a capture during `contact` (Table 4.3)."""
    times = truth.motion.timestamps
    examined = (times - times[0]) % FEET_EVERY_S < FEET_S
    touching = contact & examined[:, None]
    return foot_surface(*foot_vertices(body, motion.T_world_joint, touching), truth.surface)


def travelled_m(motion: Motion) -> Float[Tensor, "time"]:
    """Horizontal path length of the root since the first frame (m)."""
    length = motion.t_world_root[:, :2].double().diff(dim=0).norm(dim=-1).cumsum(0)
    return torch.cat([length.new_zeros(1), length])


def drift(distance_m: Float[Tensor, "time"], error_cm: Float[Tensor, "time"]) -> Drift:
    """Mean error of each bin of `BIN_M` walked, and the slope of a line fitted to these means.

    Each bin has the same weight, however long the wearer stood in it; the last one counts only if at least half of it
    was walked.
    """
    number = (distance_m / BIN_M).floor().long().numpy()
    whole = number < round(distance_m[-1].item() / BIN_M)
    if not whole.any():
        whole[:] = True
    count = np.bincount(number[whole])
    error = np.bincount(number[whole], error_cm.double().numpy()[whole])[count > 0] / count[count > 0]
    middle = (np.flatnonzero(count) + 0.5) * BIN_M
    slope = 100 * float(np.polyfit(middle, error, 1)[0]) if len(middle) > 1 else math.nan
    return Drift(tuple(middle.tolist()), tuple(error.tolist()), slope)


def mean_chamfer(frames: list[Chamfer]) -> Chamfer:
    """Mean over frames: one row's entry in Tables 4.1 and 4.2. Raises WearcapError without frames."""
    if not frames:
        raise WearcapError("no frames to average", expected="at least one frame with a cloud")
    return Chamfer(
        float(np.mean([frame.cloud_to_body_cm for frame in frames])),
        float(np.mean([frame.body_to_cloud_cm for frame in frames])),
    )
