"""Forward kinematics, fused with its own backward, against one torch step per joint.

24 joints, batch 4096, CPU, 2 threads, single precision. Both sides take turns in one run, in blocks of two calls to
warm up and ten that are timed: so each runs on caches and memory of its own, as in a program that calls it again and
again, and a slower spell of the machine meets both. value and baseline: median ms of all timed calls.
ratio = baseline / value, to be at least `goal`.
"""

import statistics
import time

import torch
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.body.skeletons import smpl24
from wearcap.geometry import rotation

BATCH = 4096


def joint_loop(skeleton: Skeleton, R_parent_joint: Tensor, t_world_root: Tensor) -> tuple[Tensor, Tensor]:
    """The baseline: one joint after the other."""
    R, t = [R_parent_joint[:, 0]], [t_world_root]
    for joint in range(1, len(skeleton)):
        parent = skeleton.parents[joint]
        R.append(R[parent] @ R_parent_joint[:, joint])
        t.append(t[parent] + R[parent] @ skeleton.t_parent_joint[joint])
    return torch.stack(R, 1), torch.stack(t, 1)


def fused(skeleton: Skeleton, R_parent_joint: Tensor, t_world_root: Tensor) -> tuple[Tensor, Tensor]:
    T_world_joint = forward_kinematics(skeleton, R_parent_joint, t_world_root)
    return T_world_joint.R, T_world_joint.t


def measure(batch: int = BATCH, blocks: int = 8) -> list[dict]:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        torch.manual_seed(0)
        skeleton = smpl24()
        R = rotation.exp(0.5 * torch.randn(batch, len(skeleton), 3))
        t = torch.randn(batch, 3)
        for ours, theirs in zip(fused(skeleton, R, t), joint_loop(skeleton, R, t)):
            torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
        forward = _medians_ms([lambda: fused(skeleton, R, t), lambda: joint_loop(skeleton, R, t)], blocks)
        leaves = [R.clone().requires_grad_(), t.clone().requires_grad_()]
        seeds = [torch.randn(batch, len(skeleton), 3, 3), torch.randn(batch, len(skeleton), 3)]
        both = _medians_ms(
            [
                lambda: torch.autograd.grad(fused(skeleton, *leaves), leaves, seeds),
                lambda: torch.autograd.grad(joint_loop(skeleton, *leaves), leaves, seeds),
            ],
            blocks,
        )
    finally:
        torch.set_num_threads(threads)
    return [
        {
            "name": "fk_vs_joint_loop",
            "value": value,
            "unit": unit,
            "baseline": baseline,
            "ratio": baseline / value,
            "goal": goal,
        }
        for (value, baseline), unit, goal in ((forward, "ms forward", 10.0), (both, "ms forward + backward", 5.0))
    ]


def _medians_ms(sides: list, blocks: int, warm_up: int = 2, timed: int = 10) -> list[float]:
    times: list[list[float]] = [[] for _ in sides]
    for _ in range(blocks):
        for side, own in zip(sides, times):
            for call in range(warm_up + timed):
                begin = time.perf_counter()
                side()
                if call >= warm_up:
                    own.append(time.perf_counter() - begin)
    return [1000 * statistics.median(own) for own in times]
