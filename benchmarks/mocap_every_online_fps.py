"""MocapEvery online on this machine's CPU, frame by frame: frames per second, everything included.

The stride, lookahead and runtime of `pipeline=mocap_every_online`; head poses at 30 Hz and watch samples go in as they
come. Median over the frames once windows are full. baseline: real time, 30; ratio = value / baseline, to be at least
`goal` (300 frames/s on two cores).
"""

import statistics
import time

from mocap_every_runs import figure, pipeline_of, watched

from wearcap.geometry.rigid import Rigid
from wearcap.models.onnx_runner import undisturbed
from wearcap.pipelines.mocap_every_stream import MocapEverySession, WatchSample, Wearing


def measure(duration_s: float = 30.0) -> list[dict]:
    pipeline, recording = pipeline_of("mocap_every_online"), watched(duration_s)
    head = recording.head
    assert head is not None
    assert recording.motion is not None
    session = MocapEverySession(
        pipeline, Wearing(recording.motion.skeleton, head.R_head_device, head.t_head_device, floor_m=0.0)
    )
    seconds = []
    with undisturbed(pipeline.runtime == "onnx"):
        for number, moment in enumerate(head.timestamps.tolist()):
            begin = time.perf_counter()
            session.head(moment, Rigid(head.R_world_device[number], head.t_world_device[number]))
            for joint, stream in recording.imu.items():
                assert stream.R_world_imu is not None
                assert stream.acc_world is not None
                session.watch(
                    joint, [WatchSample(moment, stream.R_world_imu[number], stream.acc_world[number])]
                )
            session.poses()
            seconds.append(time.perf_counter() - begin)
    rate = 1 / statistics.median(seconds[2 * pipeline.net.window :])
    return [figure("mocap_every_online_fps", rate, 30.0, 10.0)]
