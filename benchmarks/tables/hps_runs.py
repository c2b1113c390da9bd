"""One simulated session captured by every row of HPS' tables, with and without outages of localisation, and scored."""

import gc
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate

from benchmarks.rivals import compose
from benchmarks.rivals.foot_surface import FootSurface
from benchmarks.rivals.hps_scores import HpsScores, HpsTruth, score_hps
from benchmarks.tables.hps_outages import Outage, disturbance, planted_outages, with_outage
from benchmarks.tables.hps_sessions import Session, SessionSettings, TrueClock, load_session
from wearcap.recording import Motion
from wearcap.runtime.stages import run_stages
from wearcap.runtime.system import CaptureInput

ROWS = {
    "IMU": ("baseline/hps_suit", "pipeline.kind=imu"),
    "IMU + Cam": ("baseline/hps_suit", "pipeline.kind=imu_cam"),
    "IMU + Cam (filtered)": ("baseline/hps_suit", "pipeline.kind=imu_cam_filtered"),
    "HPS w/o scene": ("paper/hps_without_scene",),
    "HPS": ("paper/hps_released",),
    "ours": ("hps",),
}
"""The papers' rows, as the authors' code computes them, and ours: names of pipeline configs, with overrides."""
PRINTED = {"HPS as printed": ("paper/hps",)}
"""The paper's own energy and solver, which take some ten minutes for three of recording."""
DISTURBED = ("IMU + Cam (filtered)", "HPS", "ours")
OUTAGES_S = (30.0, 60.0)
TRUTH = "the truth itself"
"""What a perfect capture scores: the rig's and the metric's own floor."""


@dataclass(frozen=True)
class SeedRun:
    """What one seed is run with; picklable."""

    settings: SessionSettings
    seed: int
    cache: Path
    solver_jobs: int
    rows: dict[str, tuple[str, ...]]
    """Rows and their pipelines."""


def run_seed(run: SeedRun) -> dict[str, Any]:
    """Everything measured on one session, ready for JSON."""
    torch.set_num_threads(1)
    tell = Teller(f"seed {run.seed}")
    tell("session …")
    session = load_session(run.settings, run.seed, run.cache)
    clock = TrueClock.of(session.recording)
    truth = HpsTruth.of(session.recording, session.scan, session.visits)
    tell(f"session of {truth.motion.timestamps[-1]:.0f} s")
    scores, motions, seconds, clock_error = {}, {}, {}, 0.0
    for row, pipeline in run.rows.items():
        motions[row], seconds[row], clock_error = _captured(session, pipeline, run)
        scores[row] = _plain(score_hps(motions[row], truth))
        tell(f"{row}: {_short(scores[row])}")
    outages = _outages(session, truth, motions, run, tell)
    scores[TRUTH] = _plain(score_hps(truth.motion, truth))
    recording = session.recording
    assert recording.intervals is not None
    assert recording.localization is not None
    gc.collect()
    return {
        "seed": run.seed,
        "subject": recording.subject,
        "location": recording.location,
        "seconds": recording.duration_s,
        "frames": len(truth.motion),
        "scan_points": len(session.scan.points),
        "visits": [
            {"name": name, "distance_m": float(distance)}
            for name, distance in zip(recording.intervals.names, recording.intervals.distance_m)
        ],
        "localized": float((recording.localization.confidence > 0).float().mean()),
        "clock_error_ms": 1000 * clock_error,
        "clock_rate_ms_per_h": 3.6e6 * (clock.rate - 1),
        "rig_error_cm": [100 * error for error in session.rig_error_m],
        "scores": scores,
        "outages": outages,
        "stage_seconds": seconds,
    }


class Teller:
    """Lines on stderr with the time since the start."""

    def __init__(self, who: str):
        self.who, self.begin = who, time.perf_counter()

    def __call__(self, line: str) -> None:
        print(f"[{self.who}, {time.perf_counter() - self.begin:4.0f} s] {line}", file=sys.stderr, flush=True)


def _captured(session: Session, pipeline: tuple[str, ...], run: SeedRun) -> tuple[Motion, dict[str, float], float]:
    """The motion, seconds per stage, and the largest error of the clock that was found (s)."""
    clock = TrueClock.of(session.recording)
    overrides = [
        f"pipeline={pipeline[0]}",
        *pipeline[1:],
        "checkpoint=null",
        "recording=null",
        f"pipeline.synchronization.camera_claps_s={clock.heard_s(session.recording, run.seed)}",
    ]
    config = compose("capture", overrides).pipeline
    if "solver" in config and "jobs" in config.solver:
        config.solver.jobs = run.solver_jobs
    made = instantiate(config, _convert_="all")
    results, stages = run_stages(made.stages(CaptureInput(session.recording, scan=session.scan)))
    error = clock.error_s(results["synchronize"])
    return made.motion_of(results), {stage["stage"]: stage["seconds"] for stage in stages}, error


def _outages(
    session: Session, truth: HpsTruth, motions: dict[str, Motion], run: SeedRun, tell: Teller
) -> dict[str, Any]:
    """Both outages planted in one recording: errors within each, and over all of it, against those without."""
    recording = session.recording
    assert recording.localization is not None
    assert recording.intervals is not None
    planted = planted_outages(recording.intervals, float(truth.motion.timestamps[-1]), OUTAGES_S)
    clock, localization = TrueClock.of(recording), recording.localization
    for outage in planted:
        start = float(clock.to_camera(torch.tensor(outage.start_s, dtype=torch.float64)))
        localization = with_outage(localization, start, outage.length_s)
    disturbed = replace(session, recording=replace(recording, localization=localization))
    everywhere = torch.ones(len(truth.motion), dtype=torch.bool)
    found: dict[str, Any] = {}
    for row in DISTURBED:
        motion, _, _ = _captured(disturbed, ROWS[row], run)
        parts = {_name(outage): outage.frames(truth.motion.timestamps) for outage in planted}
        found[row] = {}
        for name, frames in {**parts, "whole recording": everywhere}.items():
            result = disturbance(motion, motions[row], truth.motion, frames)
            found[row][name] = asdict(result) | {"root_ratio": result.root_ratio, "joint_ratio": result.joint_ratio}
        worst = {name: f"{part['root_cm']:.1f} ({part['root_ratio']:.1f}x)" for name, part in found[row].items()}
        tell(f"{row}, with outages: root {worst}")
    return {"planted": [asdict(outage) for outage in planted], "rows": found}


def _name(outage: Outage) -> str:
    return f"within {outage.length_s:.0f} s"


def _plain(scores: HpsScores) -> dict[str, Any]:
    """Scores as JSON holds them, Chamfer with both directions and their mean."""
    tree = asdict(scores)
    for form in ("literal", "surface"):
        tree[form] = [asdict(part) | {"mean_cm": part.mean_cm} for part in vars(scores)[form]]
    return tree


def _short(scores: dict[str, Any]) -> str:
    """A line of progress."""
    feet: FootSurface | dict[str, Any] = scores["feet"]
    chamfer = " ".join(f"{part['mean_cm']:.1f}" for part in scores["literal"])
    return (
        f"Chamfer {chamfer} cm, root {scores['joints']['root_cm']:.1f} cm, "
        f"surface {feet['distance_cm']:.2f} cm, sliding {feet['sliding_cm']:.2f} cm"
    )
