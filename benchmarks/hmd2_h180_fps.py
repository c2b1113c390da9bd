"""HMD² on a GPU at h = 180 (3 s latency), full model, batch 1: frames per second, everything included.

20 steps, compiled with CUDA graphs, bfloat16. baseline: the paper's 1350 on an A100 (thesis §6.4); ratio = value /
baseline, to be at least `goal` (on an H200). Without a CUDA device it is left out.
"""

from online import beside_paper


def measure(pushes: int = 100) -> list[dict]:
    return beside_paper("hmd2_h180_fps", 180, 1350.0, pushes)
