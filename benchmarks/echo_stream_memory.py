"""ECHO while it happens, for half an hour: whether memory stays as it is, and a frame of a long stream costs what one of
a short stream does.

A small network (one layer) with the windows of `pipeline=echo_online` follows a walk there and back; a box is
taken up and laid down all the time. memory: peak (MiB) after the whole stream; baseline: after its first tenth; ratio =
value / baseline. time: CPU seconds per frame of the whole; baseline: of its first tenth; ratio = value / baseline. Both
are to be at most `goal`.
"""

import resource
import time

from echo_runs import FPS, Streamed, figure, pipeline_of

TINY = ("model.net.width=32", "model.net.layers=1", "model.net.heads=2", "model.net.feedforward=64")


def measure(minutes: float = 30.0) -> list[dict]:
    stream = Streamed(pipeline_of("echo_online", overrides=TINY, runtime="eager")).fill()
    filled, frames = stream.outputs, round(60 * FPS * minutes)
    memory, seconds = [], []
    begin = time.process_time()
    for number in range(1, frames + 1):
        stream.step()
        if number in (frames // 10, frames):
            memory.append(_peak_mib())
            seconds.append((time.process_time() - begin) / number)
    assert stream.outputs == filled + frames
    (early, late), (short, long) = memory, seconds
    return [
        figure("echo_stream_memory", late, "MiB", early, late / early, 1.05),
        figure("echo_stream_time", long, "s/frame", short, long / short, 1.1),
    ]


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
