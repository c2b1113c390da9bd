"""Time that a live capture computes for a piece of final poses, by runtime and number format.

    python -m benchmarks.speed.live_runtimes [SYSTEM ...] [--seconds 20] [--threads 1]

A recording is pushed sample by sample into the online pipeline's session; the calls that return poses are timed, without the
first two seconds. Prints one JSON line per system and runtime: milliseconds of a piece (median, 95th percentile), frames of
a piece, times real time, and the mean distance (cm) of joints from those of eager float32.
"""

import argparse
import json
import time

import numpy as np
import torch

from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.cli.conf import compose, load_pipeline
from wearcap.reading import read
from wearcap.recording.timing import first_seconds, joined
from wearcap.runtime.wearer import Wearer

SYSTEMS = ("hmd2", "mocap_every", "echo")
RUNTIMES = (("eager", "float32"), ("onnx", "float32"), ("onnx", "int8"))


def timed(system: str, runtime: str, precision: str, where: str, seconds: float):
    """(ms of each piece, its frames, the motion, frames per second) of a session."""
    overrides = [f"pipeline={system}_online", f"pipeline.runtime={runtime}", f"pipeline.precision={precision}"]
    pipeline = load_pipeline(None, compose("live", ["recording=x", *overrides]).pipeline, "cpu", True)
    source = ReplaySource(first_seconds(read(where), seconds), pipeline.session_class())
    setup = source.setup
    assert setup is not None
    head = setup.seats["head"]
    wearer = Wearer(setup.skeleton, head.R_joint_device, head.t_joint_device, floor_m=setup.floor_m)
    session = pipeline.session_class().of_wearers(pipeline, [wearer])
    pieces, times, begin_s = [], [], None
    for sent_s, _, sample in source.events():
        start = time.perf_counter()
        session.push([[sample]])
        motion = session.poses()[0]
        if motion is not None:
            pieces.append(motion)
            begin_s = sent_s if begin_s is None else begin_s
            if sent_s > begin_s + 2.0:
                times.append((1000 * (time.perf_counter() - start), len(motion)))
    whole = joined(pieces)
    assert whole is not None
    return np.array([ms for ms, _ in times]), np.array([frames for _, frames in times]), whole, pipeline.fps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", default=SYSTEMS, metavar="SYSTEM", help=", ".join(SYSTEMS))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--recording", default="datasets/simulated/sim-test-0-0000")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for system in options.systems:
        plain = None
        for runtime, precision in RUNTIMES:
            ms, frames, motion, fps = timed(system, runtime, precision, options.recording, options.seconds)
            plain = motion if plain is None else plain
            off = (motion.T_world_joint.t - plain.T_world_joint.t).norm(dim=-1).mean().item()
            row = {
                "name": f"live_{system}_{runtime}_{precision}",
                "median_ms": round(float(np.median(ms)), 1),
                "p95_ms": round(float(np.quantile(ms, 0.95)), 1),
                "frames": int(np.median(frames)),
                "real_time": round(float(frames.sum() / fps / (ms.sum() / 1000)), 1),
                "off_cm": round(100 * off, 2),
                "threads": options.threads,
            }
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
