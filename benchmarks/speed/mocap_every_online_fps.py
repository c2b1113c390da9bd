"""MocapEvery online on this machine's CPU, frame by frame: frames per second, everything included.

The stride, lookahead and runtime of `pipeline=mocap_every_online`, and the same with a window for every frame; head poses
at 30 Hz, a SLAM's `NEW_POINTS` of the floor and the walls with each of them, and watch samples go in as they come; the
floor's height is followed. `…_given_floor_fps`: without points, as the clock ran before. Mean over all frames once windows
are full. baseline: real time, 30; ratio = value / baseline, to be at least `goal` (300 frames/s on two cores).
"""

import time
from dataclasses import replace

import numpy as np
import torch

from benchmarks.speed.figures import per_second
from benchmarks.speed.mocap_every_runs import pipeline_of, watched
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Recording
from wearcap.runtime.graphs import undisturbed
from wearcap.runtime.wearer import Wearer
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.stream import MocapEveryStream, WatchSample

NEW_POINTS = 150
"""Points per pose: Aria's semi-dense map has some 5,000 a second."""


def measure(duration_s: float = 30.0, repeats: int = 3) -> list[dict]:
    pipeline, recording, rows = pipeline_of("mocap_every_online"), watched(duration_s), []
    for name, stride, points in (
        ("", pipeline.overlap.stride, True),
        ("_each_frame", 1, True),
        ("_given_floor", pipeline.overlap.stride, False),
    ):
        stepping = replace(pipeline, overlap=replace(pipeline.overlap, stride=stride))
        with undisturbed(pipeline.runtime == "onnx"):
            rates = sorted(_rate(stepping, recording, points) for _ in range(repeats))
        rows.append(per_second(f"mocap_every_online{name}_fps", rates[repeats // 2], 30.0, 10.0))
    return rows


def _around(t_world_head: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Points of the floor (two thirds) and of walls within 3 m of a head."""
    place = rng.uniform(-3.0, 3.0, (NEW_POINTS, 3)) + t_world_head.numpy()
    place[:, 2] = np.where(
        rng.random(NEW_POINTS) < 2 / 3, rng.normal(0, 0.01, NEW_POINTS), rng.uniform(0, 2.4, NEW_POINTS)
    )
    return torch.from_numpy(place).float()


def _rate(pipeline: MocapEvery, recording: Recording, points: bool) -> float:
    head, rng = recording.head, np.random.default_rng(0)
    assert head is not None
    assert recording.motion is not None
    floor_m = None if points else 0.0
    session = MocapEveryStream(
        pipeline, Wearer(recording.motion.skeleton, head.R_head_device, head.t_head_device, floor_m=floor_m)
    )
    seen = [_around(t, rng) if points else None for t in head.t_world_device]
    full, begin = 2 * pipeline.model.net.window, 0.0
    for number, moment in enumerate(head.timestamps.tolist()):
        if number == full:
            begin = time.perf_counter()
        session.head(moment, Rigid(head.R_world_device[number], head.t_world_device[number]), seen[number])
        for joint, stream in recording.imu.items():
            assert stream.R_world_imu is not None
            assert stream.acc_world is not None
            session.watch(joint, [WatchSample(moment, stream.R_world_imu[number], stream.acc_world[number])])
        session.poses()
    return (len(head.timestamps) - full) / (time.perf_counter() - begin)
