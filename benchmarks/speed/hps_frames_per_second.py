"""HPS, ours, on ten minutes at 30 Hz: frames per second of the optimisation, on all cores.

The energy and solver of conf/pipeline/hps.yaml on a simulated walk with a scanned floor; the map, the body and the
initialisation are made before. value: frames per second; baseline: the recording's own 30; ratio = value / baseline,
to be at least `goal` / 30.
"""

import time

from hydra.utils import instantiate

from benchmarks.speed.figures import figure
from benchmarks.speed.hps_solver_vs_best_adam import walk
from wearcap.cli.conf import compose


def measure(duration_s: float = 600.0) -> list[dict]:
    config = compose("capture", ["pipeline=hps", "recording=none"]).pipeline
    energy, solver = (instantiate(config[part], _convert_="all") for part in ("energy", "solver"))
    data = walk(duration_s)
    solver(energy, data[:2000])
    begin = time.perf_counter()
    solver(energy, data)
    value = len(data) / (time.perf_counter() - begin)
    return [figure("hps_frames_per_second", value, "frames/s", 30.0, value / 30.0, 100.0 / 30.0)]
