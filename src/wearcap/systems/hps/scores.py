"""Scores of captured motions against ground truth: thesis §4.5, Tables 4.1 to 4.3, drift, localisation outages.

No alignment is applied before measuring. Inputs are in m, errors in cm.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.surface import SurfaceIndex
from wearcap.metrics.surface import Chamfer, FootSurface, chamfer, foot_surface, foot_vertices, mean_chamfer
from wearcap.metrics.table import evaluate_motion
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Intervals
from wearcap.recording.timing import resampled
from wearcap.scene.scan import Scan

FEET_S, FEET_EVERY_S = 2.0, 6.0
"""Feet are scored in the first `FEET_S` of every `FEET_EVERY_S` (s): in total about the thesis's three minutes."""
BIN_M = 20.0
"""Length of path (m) over which errors are averaged before a slope is fitted."""
MARGIN_S = 5.0
"""Least time (s) between a visit to the depth-camera rig and a planted outage."""


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

        Raises WearcapError when the recording lacks a suit with contacts, a true motion or true contacts.
        """
        motion, suit, track = recording.motion, recording.suit, recording.contacts
        if motion is None or suit is None or suit.contact_prob is None or track is None:
            raise WearcapError(
                "nothing to measure a capture against",
                where=recording.name,
                expected="a true motion, true contacts, and a suit with contacts",
            )
        columns = [track.parts.index(patch) for patch in FOOT_PATCHES]
        touching = replace(motion, contact_prob=track.contact[:, columns].float())
        true = resampled(touching, fps)
        detected = resampled(suit, fps).contact_prob
        assert true.contact_prob is not None
        assert detected is not None
        return cls(
            true,
            anny_body(motion.skeleton, recording.shape or None),
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
    """Chamfer distance of each interval between vertices and points, both ways, as in the thesis."""
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
    literal, surface = zip(*(interval_chamfer(motion, truth.body, clouds) for clouds in truth.visits))
    error = _joint_errors_cm(motion, truth.motion)[:, 0]
    return HpsScores(
        literal,
        surface,
        _foot_scores(motion, truth, truth.contact),
        _foot_scores(motion, truth, truth.true_contact),
        drift(travelled_m(truth.motion), error),
        joints,
    )


def visit_times(intervals: Intervals, count: int = 10) -> Float64[Tensor, "interval frame"]:
    """Instants (s) at which the rig's clouds are taken: evenly spread over each interval, without its ends."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return intervals.start_s[:, None] + (intervals.stop_s - intervals.start_s)[:, None] * share


def interval_chamfer(motion: Motion, body: BodyModel, clouds: Sequence[RigCloud]) -> tuple[Chamfer, Chamfer]:
    """Mean Chamfer distance between clouds and the captured body: (vertices to points, points to surface).

    Raises WearcapError for a cloud more than half a frame away from every frame of the motion.
    """
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
        raise WearcapError(
            f"no captured frame at {at[off.argmax()]:.2f} s", expected="a capture of the whole recording"
        )
    return frames


def _foot_scores(motion: Motion, truth: HpsTruth, contact: Bool[Tensor, "time patch"]) -> FootSurface:
    """Foot-to-scan distance and foot sliding of a capture during `contact` (Table 4.3)."""
    times = truth.motion.timestamps
    examined = (times - times[0]) % FEET_EVERY_S < FEET_S
    touching = contact & examined[:, None]
    return foot_surface(*foot_vertices(truth.body, motion.T_world_joint, touching), truth.surface)


def _joint_errors_cm(motion: Motion, truth: Motion) -> Float[Tensor, "time joint"]:
    """Position error of each joint in the world (cm); the root comes first."""
    return 100 * (motion.T_world_joint.t - truth.T_world_joint.t).norm(dim=-1)


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


@dataclass(frozen=True)
class Outage:
    """A time span without localisation (s, on the suit's clock)."""

    start_s: float
    length_s: float

    def frames(self, timestamps: Float64[Tensor, "time"]) -> Bool[Tensor, "time"]:
        """Mask of the frames within the outage."""
        return (timestamps >= self.start_s) & (timestamps < self.start_s + self.length_s)


def planted_outages(intervals: Intervals, end_s: float, lengths_s: Sequence[float]) -> list[Outage]:
    """Outages centred in the walks between visits: at most one per walk, the longest in the longest walk.

    An outage that does not leave `MARGIN_S` before and after it is shortened. Raises WearcapError when there are more
    outages than walks.
    """
    away = torch.cat([intervals.stop_s, torch.zeros(1, dtype=torch.float64)])
    back = torch.cat([intervals.start_s, torch.tensor([end_s], dtype=torch.float64)])
    walks = sorted(zip(away[:-1].tolist(), back[1:].tolist()), key=lambda walk: walk[0] - walk[1])
    if len(lengths_s) > len(walks):
        raise WearcapError(f"{len(lengths_s)} outages", expected=f"no more than {len(walks)}, one per walk")
    outages = []
    for length, (start, stop) in zip(sorted(lengths_s, reverse=True), walks):
        length = min(length, stop - start - 2 * MARGIN_S)
        if length <= 0:
            raise WearcapError(
                f"no room for an outage in a walk of {stop - start:.1f} s", expected=f"more than {2 * MARGIN_S:.0f} s"
            )
        outages.append(Outage((start + stop - length) / 2, length))
    return sorted(outages, key=lambda outage: outage.length_s)


@dataclass(frozen=True)
class _Disturbance:
    """Mean errors (cm) with and without localisation outages, over the same frames."""

    root_cm: float
    joint_cm: float
    undisturbed_root_cm: float
    undisturbed_joint_cm: float

    @property
    def root_ratio(self) -> float:
        """Error with outages divided by the error without."""
        return self.root_cm / self.undisturbed_root_cm

    @property
    def joint_ratio(self) -> float:
        """Error with outages divided by the error without."""
        return self.joint_cm / self.undisturbed_joint_cm


def disturbance(disturbed: Motion, undisturbed: Motion, truth: Motion, frames: Bool[Tensor, "time"]) -> _Disturbance:
    """Compare captures with and without outages over the given frames."""
    with_, without = (_joint_errors_cm(motion, truth)[frames] for motion in (disturbed, undisturbed))
    return _Disturbance(*(float(e) for e in (with_[:, 0].mean(), with_.mean(), without[:, 0].mean(), without.mean())))


def in_order(errors: Sequence[float]) -> bool:
    """Whether the errors strictly decrease, as those of the thesis's baselines do (Tables 4.1 and 4.2)."""
    return all(before > after for before, after in pairwise(errors))
