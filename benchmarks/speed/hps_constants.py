"""HPS with further constants of the suit estimated: joints' error beside that of the default's constants.

Simulated sessions of 110 m with typical sensors, people and sites of the validation split. The constants are legs' length
("height") and errors of segments ("segments"), alone and together, besides the bones' scale. value: mean joint error (cm);
baseline: with the scale alone. ratio = value / baseline. A constant is worth its time below `goal`.
"""

from dataclasses import replace

import numpy as np
import torch
from hydra.utils import instantiate

from benchmarks.speed.figures import figure
from benchmarks.tables.hps_sessions import TrueClock
from wearcap.cli.conf import compose
from wearcap.metrics.table import evaluate_motion
from wearcap.recording.timing import resampled
from wearcap.runtime.system import CaptureInput
from wearcap.scene.scan import Scan
from wearcap.systems.hps.camera import on_one_clock
from wearcap.systems.hps.constants import ConstantsPrior
from wearsim.recordings.hps import HpsConfig, Protocol, simulate_hps
from wearsim.rendering.scan import scan_world
from wearsim.rendering.views import Scenery

PRIORS = {
    "scale": ConstantsPrior(scale=0.02, mount_m=0.0, height_m=0.0, segments_deg=0.0),
    "height": ConstantsPrior(scale=0.02, mount_m=0.0, height_m=0.02, segments_deg=0.0),
    "segments": ConstantsPrior(scale=0.02, mount_m=0.0, height_m=0.0, segments_deg=3.0),
    "both": ConstantsPrior(scale=0.02, mount_m=0.0, height_m=0.02, segments_deg=3.0),
}
SPACING_M = 0.02


def errors_cm(split: str, seed: int) -> list[float]:
    """Mean joint error of one session with each of `PRIORS`."""
    config = HpsConfig(protocol=Protocol(returns_m=(70.0,), end_m=110.0))
    session = simulate_hps(config, f"{split}-{seed}", split, seed)
    points = scan_world(Scenery.of(session.world), SPACING_M, np.random.default_rng([31, seed])).points
    recording, scan = session.recording, Scan(points)
    claps = TrueClock.of(recording).heard_s(recording, seed)
    chosen = ["pipeline=hps", "checkpoint=null", "recording=null", f"pipeline.synchronization.camera_claps_s={claps}"]
    hps = instantiate(compose("capture", chosen).pipeline, _convert_="all")
    results = replace(hps, constants=None).results(CaptureInput(recording, scan=scan))
    data = hps.problem(on_one_clock(recording, results), results["align"], results["initialize"], scan)
    assert recording.motion is not None
    true = resampled(recording.motion, hps.fps)
    found = []
    for prior in PRIORS.values():
        constants = replace(hps, constants=prior).estimate(data)
        motion = hps.motion(results["initialize"], hps.optimize(data, constants), constants)
        found.append(float(evaluate_motion(motion, true)["mpjpe_cm"]))
    return found


def measure(split: str = "val", seeds: int = 3) -> list[dict]:
    baseline, *values = torch.tensor([errors_cm(split, seed) for seed in range(seeds)]).mean(0).tolist()
    return [
        figure(f"hps_constants_{name}", value, "cm", baseline, value / baseline, 0.98)
        for name, value in zip(list(PRIORS)[1:], values)
    ]
