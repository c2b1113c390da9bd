"""HPS online after 30 s without localisation: the root's error from the third second on, once the camera is found.

Simulated sessions with typical sensors, people and sites of the test split; pieces of half a second, clocks shared.
value: mean error (cm) of the seconds 3 to 12 after the camera is found again; baseline: of the 40 s before it was
lost. ratio = value / baseline; it shall be at most `goal`.
"""

from dataclasses import replace

import numpy as np
import torch
from hydra.utils import instantiate
from jaxtyping import Float, Float64
from torch import Tensor

from benchmarks.speed.figures import figure
from benchmarks.tables.hps_outages import with_outage
from benchmarks.tables.hps_sessions import TrueClock
from wearcap.cli.conf import compose
from wearcap.recording.recording import Localization
from wearcap.recording.timing import at_times
from wearcap.scene.scan import Scan
from wearcap.systems.hps.stream import HpsStream
from wearsim.recordings.hps import HpsConfig, Protocol, simulate_hps
from wearsim.recordings.localization_noise import LocalizationNoise
from wearsim.rendering.scan import scan_world
from wearsim.rendering.views import Scenery
from wearsim.sensors.suit import SuitNoise

LOST_S, OUTAGE_S, END_S = 60.0, 30.0, 105.0
BEFORE_S, AFTER_S = (20.0, 60.0), (93.0, 102.0)
PIECE_S, SPACING_M = 0.5, 0.04


def errors_cm(split: str, seed: int) -> tuple[Float64[Tensor, "time"], Float[Tensor, "time"]]:
    """Times (s) and the root's errors (cm) of what a stream returned of a session."""
    suit, localization = SuitNoise.preset("typical"), LocalizationNoise.preset("typical")
    config = HpsConfig(protocol=Protocol(returns_m=(), end_m=130.0), suit=suit, localization=localization)
    session = simulate_hps(config, f"{split}-{seed}", split, seed)
    scan = scan_world(Scenery.of(session.world), SPACING_M, np.random.default_rng([31, seed]))
    recording, clock = session.recording, TrueClock.of(session.recording)
    assert recording.localization is not None
    assert recording.suit is not None
    assert recording.motion is not None
    on_suit = (recording.localization.timestamps - clock.offset_s) / clock.rate
    seen = with_outage(replace(recording.localization, timestamps=on_suit), LOST_S, OUTAGE_S)
    pipeline = ["pipeline=hps", "checkpoint=null", "recording=null", "pipeline.synchronization.clock=shared"]
    hps = instantiate(compose("capture", pipeline).pipeline, _convert_="all")
    stream, found = HpsStream(hps, recording, Scan(scan.points, scan.colors)), []
    for start in np.arange(float(recording.suit.timestamps[0]), END_S, PIECE_S):
        ends = torch.tensor([start, start + PIECE_S], dtype=torch.float64)
        first, stop = torch.searchsorted(recording.suit.timestamps, ends).tolist()
        here = slice(*torch.searchsorted(seen.timestamps, ends).tolist())
        parts = (seen.timestamps, seen.R_world_cam, seen.t_world_cam, seen.confidence)
        motion = stream.push(recording.suit.sliced(first, stop), Localization(*(part[here] for part in parts)))
        if motion is not None:
            found.append(motion)
    times = torch.cat([motion.timestamps for motion in found])
    path = torch.cat([motion.t_world_root for motion in found])
    return times, 100 * (path - at_times(recording.motion, times).t_world_root).norm(dim=-1)


def measure(split: str = "test", seeds: int = 3) -> list[dict]:
    means = torch.zeros(seeds, 2)
    for seed in range(seeds):
        times, error = errors_cm(split, seed)
        for column, (start, stop) in enumerate((AFTER_S, BEFORE_S)):
            means[seed, column] = error[(times >= start) & (times < stop)].mean()
    value, baseline = means.mean(0).tolist()
    return [figure("hps_online_recovery", value, "cm", baseline, value / baseline, 2.0)]
