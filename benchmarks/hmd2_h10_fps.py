"""HMD² on a GPU at h = 10 (0.17 s latency), full model, batch 1: frames per second, everything included.

20 steps, compiled with CUDA graphs, bfloat16. baseline: the document's 70 on an A100 (thesis §6.4); ratio = value /
baseline, to be at least `goal` (on an H200). Without a CUDA device it is left out.
"""

from online import figure, frames_per_second, pipeline_of, without_cuda

DOCUMENT = 70.0


def measure(pushes: int = 100) -> list[dict]:
    if without_cuda("hmd2_h10_fps"):
        return []
    pipeline = pipeline_of("full", "cuda", stride=10, steps=20, spacing=1.0, runtime="auto", precision="auto")
    return [figure("hmd2_h10_fps", frames_per_second(pipeline, pushes), DOCUMENT, 10.0)]
