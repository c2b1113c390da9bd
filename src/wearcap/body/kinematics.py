"""Forward kinematics: fused kernels on the CPU, elsewhere vectorised over the levels of the skeleton's tree."""

import itertools
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.fused_kinematics import can_fuse, fused_forward_kinematics
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid


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
    if can_fuse(R_parent_joint, t_world_root, offsets):
        return Rigid(*fused_forward_kinematics(skeleton, R_parent_joint, t_world_root, offsets))
    return level_forward_kinematics(skeleton, R_parent_joint, t_world_root, offsets)


def level_forward_kinematics(
    skeleton: Skeleton,
    R_parent_joint: Float[Tensor, "*batch joint 3 3"],
    t_world_root: Float[Tensor, "*batch 3"],
    offsets: Float[Tensor, "*#batch joint 3"],
) -> Rigid:
    """Forward kinematics in plain tensor operations, one step per tree level: for any device, transform or compiler."""
    # A compiler's traced tensors must not be cached: they are placeholders.
    plan = _plan if torch.compiler.is_compiling() else _kept_plan
    levels, back = plan(skeleton.levels, skeleton.parents, R_parent_joint.device)
    offsets = offsets.expand(*R_parent_joint.shape[:-3], len(skeleton), 3)
    R_levels, t_levels = [R_parent_joint[..., :1, :, :]], [t_world_root[..., None, :]]
    for joints, parent in levels:
        R_parent, t_parent = R_levels[-1][..., parent, :, :], t_levels[-1][..., parent, :]
        R_levels.append(R_parent @ R_parent_joint[..., joints, :, :])
        t_levels.append(t_parent + (R_parent @ offsets[..., joints, :, None])[..., 0])
    return Rigid(torch.cat(R_levels, -3)[..., back, :, :], torch.cat(t_levels, -2)[..., back, :])


def _plan(
    levels: tuple[tuple[int, ...], ...], parents: tuple[int, ...], device: torch.device
) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """Per level below the root: its joints and their parents' positions in the level above; then the inverse order."""
    steps = []
    for above, joints in itertools.pairwise(levels):
        places = [above.index(parents[joint]) for joint in joints]
        steps.append((torch.tensor(joints, device=device), torch.tensor(places, device=device)))
    order = torch.tensor([joint for level in levels for joint in level])
    return steps, order.argsort().to(device)


_kept_plan = lru_cache(maxsize=64)(_plan)
"""Index tensors per device: copying them to a GPU in every call would synchronise with it."""


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
