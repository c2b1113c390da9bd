"""HMD² on a GPU at h = 10 (0.17 s latency), full model, batch 1: frames per second, everything included.

20 steps, compiled with CUDA graphs, bfloat16. baseline: the paper's 70 on an A100 (thesis §6.4); ratio = value /
baseline, to be at least `goal` (on an H200). Without a CUDA device it is left out.
"""

from online import beside_paper


def measure(pushes: int = 100) -> list[dict]:
    return beside_paper("hmd2_h10_fps", 10, 70.0, pushes)
