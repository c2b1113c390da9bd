"""MocapEvery online on this machine's CPU, frame by frame: frames per second, everything included.

The stride, lookahead and runtime of `pipeline=mocap_every_online`, and the same with a window for every frame; head poses
at 30 Hz and watch samples go in as they come. Mean over all frames once windows are full. baseline: real time, 30;
ratio = value / baseline, to be at least `goal` (300 frames/s on two cores).
"""

import time
from dataclasses import replace

from mocap_every_runs import figure, pipeline_of, watched

from wearcap.geometry.rigid import Rigid
from wearcap.recording import Recording
from wearcap.runtime.graphs import undisturbed
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.stream import MocapEveryStream, WatchSample, Wearing


def measure(duration_s: float = 30.0, repeats: int = 3) -> list[dict]:
    pipeline, recording = pipeline_of("mocap_every_online"), watched(duration_s)
    rows = []
    for name, stride in (("mocap_every_online_fps", pipeline.stride), ("mocap_every_online_each_frame_fps", 1)):
        stepping = replace(pipeline, stride=stride)
        with undisturbed(pipeline.runtime == "onnx"):
            rates = sorted(_rate(stepping, recording) for _ in range(repeats))
        rows.append(figure(name, rates[repeats // 2], 30.0, 10.0))
    return rows


def _rate(pipeline: MocapEvery, recording: Recording) -> float:
    head = recording.head
    assert head is not None
    assert recording.motion is not None
    session = MocapEveryStream(
        pipeline, Wearing(recording.motion.skeleton, head.R_head_device, head.t_head_device, floor_m=0.0)
    )
    full, begin = 2 * pipeline.model.net.window, 0.0
    for number, moment in enumerate(head.timestamps.tolist()):
        if number == full:
            begin = time.perf_counter()
        session.head(moment, Rigid(head.R_world_device[number], head.t_world_device[number]))
        for joint, stream in recording.imu.items():
            assert stream.R_world_imu is not None
            assert stream.acc_world is not None
            session.watch(joint, [WatchSample(moment, stream.R_world_imu[number], stream.acc_world[number])])
        session.poses()
    return (len(head.timestamps) - full) / (time.perf_counter() - begin)
