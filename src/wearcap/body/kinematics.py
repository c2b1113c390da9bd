"""Forward kinematics: fused kernels on the CPU, elsewhere vectorised over the levels of the skeleton's tree.

The kernels pass once over the joints of each sample, with a backward of their own. With R_j = R_p L_j and
t_j = t_p + R_p o_j (p the parent of j), and g the gradients, from the leaves to the root: g_L = R_pᵀ g_R,
g_o = R_pᵀ g_t, and the parent receives g_R L_jᵀ + g_t o_jᵀ and g_t.
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

from wearcap.body import kinematics_kernels
from wearcap.body.skeleton import Skeleton, levels_of
from wearcap.geometry.rigid import Rigid

_WORTH_THREADS = 1 << 16
"""Number of joints over all samples from which several threads save more than they cost."""


def forward_kinematics(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    t_world_root: Float[Tensor, "*batch 3"],
    t_parent_joint: Float[Tensor, "*#batch joint 3"] | None = None,
) -> Rigid:
    """Poses of all joints in the world: Rigid with R "*batch joint 3 3", t "*batch joint 3" (m).

    R_parent_joint's root entry is R_world_root. `t_parent_joint` replaces the skeleton's own offsets where
    a batch mixes subjects (its root row is not read). Second derivatives need `level_forward_kinematics`.
    """
    offsets = skeleton.t_parent_joint if t_parent_joint is None else t_parent_joint
    offsets = offsets.to(R_parent_joint)
    if not _can_fuse(R_parent_joint, t_world_root, offsets):
        return level_forward_kinematics(skeleton, R_parent_joint, t_world_root, offsets)
    if torch.compiler.is_dynamo_compiling():
        from wearcap.body.kinematics_uncompiled import fused  # importing the compiler takes longer than PyTorch

        return Rigid(*fused(skeleton, R_parent_joint, t_world_root, offsets))
    return Rigid(*fused_kinematics(skeleton, R_parent_joint, t_world_root, offsets))


def fused_kinematics(
    skeleton: Skeleton, R_parent_joint: Tensor, t_world_root: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """`forward_kinematics` by the kernels."""
    batch, joints = R_parent_joint.shape[:-3], len(skeleton)
    # Expanding raises on shapes that do not fit: the kernels check nothing.
    R_local, t_root = R_parent_joint.expand(*batch, joints, 3, 3), t_world_root.expand(*batch, 3)
    shared = offsets.numel() == 3 * joints
    rows = offsets if shared else offsets.expand(*batch, joints, 3)
    return _Fused.apply(R_local, t_root, rows, np.array(skeleton.parents))


def level_forward_kinematics(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    t_world_root: Float[Tensor, "*batch 3"],
    offsets: Float[Tensor, "*#batch joint 3"],
) -> Rigid:
    """Forward kinematics in plain tensor operations, one step per tree level: for any device, transform or compiler."""
    # An exporter's traced tensors must not be cached: they are placeholders.
    plan = _plan if torch.compiler.is_exporting() else _kept_plan
    levels, back = plan(skeleton.parents, R_parent_joint.device)
    offsets = offsets.expand(*R_parent_joint.shape[:-3], len(skeleton), 3)
    R_levels, t_levels = [R_parent_joint[..., :1, :, :]], [t_world_root[..., None, :]]
    for joints, parent in levels:
        R_parent, t_parent = R_levels[-1][..., parent, :, :], t_levels[-1][..., parent, :]
        R_levels.append(R_parent @ R_parent_joint[..., joints, :, :])
        t_levels.append(t_parent + (R_parent @ offsets[..., joints, :, None])[..., 0])
    return Rigid(torch.cat(R_levels, -3)[..., back, :, :], torch.cat(t_levels, -2)[..., back, :])


def _plan(parents: tuple[int, ...], device: torch.device) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """Per level below the root: its joints and their parents' positions in the level above; then the inverse order."""
    steps, levels = [], levels_of(parents)
    for above, joints in itertools.pairwise(levels):
        places = [above.index(parents[joint]) for joint in joints]
        steps.append((torch.tensor(joints, device=device), torch.tensor(places, device=device)))
    order = torch.tensor([joint for level in levels for joint in level])
    return steps, order.argsort().to(device)


_cached_plan = lru_cache(maxsize=64)(_plan)


def _kept_plan(parents: tuple[int, ...], device: torch.device) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """Index tensors per device: copying them to a GPU in every call would synchronise with it."""
    return _cached_plan(parents, device)


_kept_plan._dynamo_marked_constant = True  # pyright: ignore[reportFunctionMemberAccess]
"""`torch.compiler.assume_constant_result`, without importing the compiler."""


def site_positions(skeleton: Skeleton, T_world_joint: Rigid, names: tuple[str, ...]) -> Float[Tensor, "*batch site 3"]:
    """World positions (m) of named sites (heels, toe tips …), in the order of `names`."""
    sites = [skeleton.sites[name] for name in names]
    joints = [skeleton.index(site.joint) for site in sites]
    offset = torch.tensor([site.t_joint_site for site in sites]).to(T_world_joint.t)
    return (T_world_joint.R[..., joints, :, :] @ offset[..., None])[..., 0] + T_world_joint.t[..., joints, :]


def local_rotations(
    skeleton: Skeleton, R_world_joint: Float[Tensor, "*batch joint 3 3"]
) -> Float[Tensor, "*batch joint 3 3"]:
    """Local rotations R_parent_joint from world rotations; the root's entry stays R_world_root."""
    R_parent = R_world_joint[..., list(skeleton.parents[1:]), :, :]
    local = R_parent.transpose(-1, -2) @ R_world_joint[..., 1:, :, :]
    return torch.cat([R_world_joint[..., :1, :, :], local], -3)


def _can_fuse(*tensors: Tensor) -> bool:
    """Whether the kernels support the inputs: plain CPU tensors of one precision, outside exporters and transforms."""
    first = tensors[0]
    plain = all(
        tensor.device.type == "cpu" and tensor.dtype == first.dtype and type(tensor) in (Tensor, torch.nn.Parameter)
        for tensor in tensors
    )
    if not plain or first.dtype not in (torch.float32, torch.float64):
        return False
    if torch.compiler.is_dynamo_compiling() and not torch.compiler.is_exporting():
        return True
    # Inside torch.func's transforms tensors have no memory to hand to a kernel.
    transformed = torch._C._functorch.maybe_current_level() is not None  # pyright: ignore[reportAttributeAccessIssue]
    return not (torch.compiler.is_compiling() or torch.jit.is_tracing() or transformed)


class _Fused(torch.autograd.Function):
    """World rotations and positions (m) of all joints; differentiable once in all three inputs."""

    @staticmethod
    def forward(ctx, R_local: Tensor, t_root: Tensor, offsets: Tensor, parents: np.ndarray):
        R_local, t_root, offsets = R_local.contiguous(), t_root.contiguous(), offsets.contiguous()
        R, t = torch.empty_like(R_local), R_local.new_empty(R_local.shape[:-1])
        arrays = _flat(R_local, t_root, offsets, R, t)
        _in_parts(kinematics_kernels.forward, parents, arrays, torch.get_num_threads())
        ctx.save_for_backward(R_local, offsets, R)
        ctx.parents = parents
        return R, t

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_R: Tensor, grad_t: Tensor):
        R_local, offsets, R = ctx.saved_tensors
        grad_local, grad_root = torch.empty_like(R_local), R_local.new_empty((*R_local.shape[:-3], 3))
        wants_offsets = ctx.needs_input_grad[2]
        grad_offsets = torch.zeros_like(offsets) if wants_offsets else offsets.new_empty(0)
        inputs = (R_local, offsets, R, grad_R.contiguous(), grad_t.contiguous())
        arrays = _flat(*inputs, grad_local, grad_root, grad_offsets)
        all_add_to_one = wants_offsets and offsets.numel() == 3 * len(ctx.parents)
        threads = 1 if all_add_to_one else torch.get_num_threads()
        _in_parts(kinematics_kernels.backward, ctx.parents, arrays, threads)
        return grad_local, grad_root, grad_offsets if wants_offsets else None, None


def _flat(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().numpy().reshape(-1) for tensor in tensors]


def _in_parts(kernel: Callable, parents: np.ndarray, arrays: list[np.ndarray], threads: int) -> None:
    """Run kernel(start, stop, parents, *arrays) over all samples, in several threads for large batches."""
    samples = arrays[0].size // (9 * len(parents))
    threads = threads if samples * len(parents) >= _WORTH_THREADS else 1
    bounds = [samples * part // threads for part in range(threads + 1)]
    # The kernels release the interpreter's lock. The calling thread takes the last part.
    others = [_pool(os.getpid()).submit(kernel, *part, parents, *arrays) for part in itertools.pairwise(bounds[:-1])]
    kernel(bounds[-2], bounds[-1], parents, *arrays)
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Thread pool of this process: a forked process does not inherit its parent's threads."""
    return ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1), thread_name_prefix="kinematics")
