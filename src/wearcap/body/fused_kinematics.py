"""Forward kinematics in one pass over the joints of each sample, with a backward of its own, on the CPU.

With R_j = R_p L_j and t_j = t_p + R_p o_j (p the parent of j), and g the gradients, from the leaves to the root:
g_L = R_pᵀ g_R, g_o = R_pᵀ g_t, and the parent receives g_R L_jᵀ + g_t o_jᵀ and g_t.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.geometry.compiled import compiled


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
        R = torch.empty_like(R_local)
        t = R_local.new_empty((*R_local.shape[:2], 3))
        _forward(
            R_local.detach().numpy(),
            t_root.detach().numpy(),
            offsets.detach().numpy(),
            parents,
            R.numpy(),
            t.numpy(),
        )
        ctx.save_for_backward(R_local, offsets, R)
        ctx.parents = parents
        return R, t

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_R: Tensor, grad_t: Tensor):
        R_local, offsets, R = ctx.saved_tensors
        # Copies: the kernel adds the children's gradients to their parents' in place.
        grad_R, grad_t = (
            grad_R.clone(memory_format=torch.contiguous_format),
            grad_t.clone(memory_format=torch.contiguous_format),
        )
        grad_local = torch.empty_like(R_local)
        grad_offsets = torch.zeros_like(offsets)
        _backward(
            R_local.detach().numpy(), offsets.detach().numpy(), ctx.parents, R.numpy(),
            grad_R.numpy(), grad_t.numpy(), grad_local.numpy(), grad_offsets.numpy(),
        )  # fmt: skip
        return grad_local, grad_t[:, 0], grad_offsets, None


@compiled
def _forward(R_local, t_root, offsets, parents, R, t):
    for sample in range(len(R_local)):
        own = sample if len(offsets) > 1 else 0
        R[sample, 0] = R_local[sample, 0]
        t[sample, 0] = t_root[sample]
        for joint in range(1, len(parents)):
            parent = parents[joint]
            ox, oy, oz = offsets[own, joint, 0], offsets[own, joint, 1], offsets[own, joint, 2]
            for row in range(3):
                a, b, c = R[sample, parent, row, 0], R[sample, parent, row, 1], R[sample, parent, row, 2]
                for column in range(3):
                    R[sample, joint, row, column] = (
                        a * R_local[sample, joint, 0, column]
                        + b * R_local[sample, joint, 1, column]
                        + c * R_local[sample, joint, 2, column]
                    )
                t[sample, joint, row] = t[sample, parent, row] + a * ox + b * oy + c * oz


@compiled
def _backward(R_local, offsets, parents, R, grad_R, grad_t, grad_local, grad_offsets):
    for sample in range(len(R_local)):
        own = sample if len(offsets) > 1 else 0
        for joint in range(len(parents) - 1, 0, -1):
            parent = parents[joint]
            for row in range(3):
                a, b, c = R[sample, parent, 0, row], R[sample, parent, 1, row], R[sample, parent, 2, row]
                for column in range(3):
                    grad_local[sample, joint, row, column] = (
                        a * grad_R[sample, joint, 0, column]
                        + b * grad_R[sample, joint, 1, column]
                        + c * grad_R[sample, joint, 2, column]
                    )
                grad_offsets[own, joint, row] += (
                    a * grad_t[sample, joint, 0] + b * grad_t[sample, joint, 1] + c * grad_t[sample, joint, 2]
                )
            for row in range(3):
                a, b, c = (
                    grad_R[sample, joint, row, 0],
                    grad_R[sample, joint, row, 1],
                    grad_R[sample, joint, row, 2],
                )
                d = grad_t[sample, joint, row]
                for column in range(3):
                    grad_R[sample, parent, row, column] += (
                        a * R_local[sample, joint, column, 0]
                        + b * R_local[sample, joint, column, 1]
                        + c * R_local[sample, joint, column, 2]
                        + d * offsets[own, joint, column]
                    )
                grad_t[sample, parent, row] += d
        for row in range(3):
            for column in range(3):
                grad_local[sample, 0, row, column] = grad_R[sample, 0, row, column]
