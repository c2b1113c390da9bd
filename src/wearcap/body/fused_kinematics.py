"""Forward kinematics in one pass over the joints of each sample, with a backward of its own, on the CPU.

With R_j = R_p L_j and t_j = t_p + R_p o_j (p the parent of j), and g the gradients, from the leaves to the root:
g_L = R_pᵀ g_R, g_o = R_pᵀ g_t, and the parent receives g_R L_jᵀ + g_t o_jᵀ and g_t.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry.compiled import compiled

_WORTH_THREADS = 1 << 14
"""Joints of all samples together from which another thread saves more than it costs."""


def can_fuse(*tensors: Tensor) -> bool:
    """Whether the kernels serve these: plain CPU tensors of one precision, outside compilers and transforms."""
    first = tensors[0]
    plain = all(
        tensor.device.type == "cpu"
        and tensor.dtype == first.dtype
        and type(tensor) in (Tensor, torch.nn.Parameter)
        for tensor in tensors
    )
    traced = torch.compiler.is_compiling() or torch.jit.is_tracing()
    # Inside torch.func's transforms tensors have no memory to hand to a kernel.
    transformed = torch._C._functorch.maybe_current_level() is not None  # pyright: ignore[reportAttributeAccessIssue]
    return plain and first.dtype in (torch.float32, torch.float64) and not traced and not transformed


def fused_forward_kinematics(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    t_world_root: Float[Tensor, "*batch 3"],
    offsets: Float[Tensor, "*#batch joint 3"],
) -> tuple[Float[Tensor, "*batch joint 3 3"], Float[Tensor, "*batch joint 3"]]:
    """World rotations and positions (m) of all joints; differentiable once in all three inputs."""
    batch, joints = R_parent_joint.shape[:-3], len(skeleton)
    shared = offsets.ndim == 2 or offsets.shape[:-2].numel() == 1
    rows = (
        offsets.reshape(1, joints, 3) if shared else offsets.expand(*batch, joints, 3).reshape(-1, joints, 3)
    )
    parents = np.array(skeleton.parents, dtype=np.int64)
    R, t = _Fused.apply(R_parent_joint.reshape(-1, joints, 3, 3), t_world_root.reshape(-1, 3), rows, parents)
    return R.reshape(*batch, joints, 3, 3), t.reshape(*batch, joints, 3)


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(ctx, R_local: Tensor, t_root: Tensor, offsets: Tensor, parents: np.ndarray):
        R_local, t_root, offsets = R_local.contiguous(), t_root.contiguous(), offsets.contiguous()
        R, t = torch.empty_like(R_local), R_local.new_empty((*R_local.shape[:2], 3))
        arrays = [x.detach().numpy() for x in (R_local, t_root, offsets, R, t)]
        _in_parts(lambda start, stop: _forward(start, stop, parents, *arrays), *R_local.shape[:2])
        ctx.save_for_backward(R_local, offsets, R)
        ctx.parents = parents
        return R, t

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_R: Tensor, grad_t: Tensor):
        R_local, offsets, R = ctx.saved_tensors
        grad_local, grad_root = torch.empty_like(R_local), R_local.new_empty(len(R_local), 3)
        grad_offsets, wants_offsets = torch.zeros_like(offsets), ctx.needs_input_grad[2]
        given = (R_local, offsets, R, grad_R.contiguous(), grad_t.contiguous())
        arrays = [x.detach().numpy() for x in (*given, grad_local, grad_root, grad_offsets)]
        kernel = lambda start, stop: _backward(start, stop, ctx.parents, *arrays, wants_offsets)  # noqa: E731
        if wants_offsets and len(offsets) == 1:  # all samples add to one gradient
            kernel(0, len(R_local))
        else:
            _in_parts(kernel, *R_local.shape[:2])
        return grad_local, grad_root, grad_offsets, None


def _in_parts(kernel: Callable[[int, int], None], samples: int, joints: int) -> None:
    """Run kernel(start, stop) over all samples, in as many threads as torch uses where there is enough to do."""
    threads = torch.get_num_threads() if samples * joints >= _WORTH_THREADS else 1
    bounds = [samples * part // threads for part in range(threads + 1)]
    # The kernels release the interpreter's lock. The calling thread takes the last part.
    others = [_pool(os.getpid()).submit(kernel, *part) for part in itertools.pairwise(bounds[:-1])]
    kernel(bounds[-2], bounds[-1])
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of this process: a forked one has none of its parent's."""
    return ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1), thread_name_prefix="kinematics")


@compiled
def _forward(start, stop, parents, R_local, t_root, offsets, R, t):
    for sample in range(start, stop):
        own = sample if len(offsets) > 1 else 0
        for row in range(3):
            t[sample, 0, row] = t_root[sample, row]
            for column in range(3):
                R[sample, 0, row, column] = R_local[sample, 0, row, column]
        for joint in range(1, len(parents)):
            parent = parents[joint]
            # Named one by one: from the array they would be read again after every store.
            xx, xy, xz = R[sample, parent, 0, 0], R[sample, parent, 0, 1], R[sample, parent, 0, 2]
            yx, yy, yz = R[sample, parent, 1, 0], R[sample, parent, 1, 1], R[sample, parent, 1, 2]
            zx, zy, zz = R[sample, parent, 2, 0], R[sample, parent, 2, 1], R[sample, parent, 2, 2]
            for column in range(3):
                a, b, c = (
                    R_local[sample, joint, 0, column],
                    R_local[sample, joint, 1, column],
                    R_local[sample, joint, 2, column],
                )
                R[sample, joint, 0, column] = xx * a + xy * b + xz * c
                R[sample, joint, 1, column] = yx * a + yy * b + yz * c
                R[sample, joint, 2, column] = zx * a + zy * b + zz * c
            a, b, c = offsets[own, joint, 0], offsets[own, joint, 1], offsets[own, joint, 2]
            t[sample, joint, 0] = t[sample, parent, 0] + xx * a + xy * b + xz * c
            t[sample, joint, 1] = t[sample, parent, 1] + yx * a + yy * b + yz * c
            t[sample, joint, 2] = t[sample, parent, 2] + zx * a + zy * b + zz * c


@compiled
def _backward(
    start,
    stop,
    parents,
    R_local,
    offsets,
    R,
    grad_R,
    grad_t,
    grad_local,
    grad_root,
    grad_offsets,
    wants_offsets,
):
    # One sample's gradients, to which the children add on the way to the root; they stay in the cache.
    g, h = np.empty((len(parents), 3, 3), R.dtype), np.empty((len(parents), 3), R.dtype)
    for sample in range(start, stop):
        own = sample if len(offsets) > 1 else 0
        for joint in range(len(parents)):
            for row in range(3):
                h[joint, row] = grad_t[sample, joint, row]
                for column in range(3):
                    g[joint, row, column] = grad_R[sample, joint, row, column]
        for joint in range(len(parents) - 1, 0, -1):
            parent = parents[joint]
            for row in range(3):
                a, b, c = R[sample, parent, 0, row], R[sample, parent, 1, row], R[sample, parent, 2, row]
                for column in range(3):
                    grad_local[sample, joint, row, column] = (
                        a * g[joint, 0, column] + b * g[joint, 1, column] + c * g[joint, 2, column]
                    )
                if wants_offsets:
                    grad_offsets[own, joint, row] += a * h[joint, 0] + b * h[joint, 1] + c * h[joint, 2]
            for row in range(3):
                a, b, c, d = g[joint, row, 0], g[joint, row, 1], g[joint, row, 2], h[joint, row]
                for column in range(3):
                    g[parent, row, column] += (
                        a * R_local[sample, joint, column, 0]
                        + b * R_local[sample, joint, column, 1]
                        + c * R_local[sample, joint, column, 2]
                        + d * offsets[own, joint, column]
                    )
                h[parent, row] += d
        for row in range(3):
            grad_root[sample, row] = h[0, row]
            for column in range(3):
                grad_local[sample, 0, row, column] = g[0, row, column]
