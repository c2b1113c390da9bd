"""Forward kinematics, vectorised over the levels of the skeleton's tree."""

import torch
from jaxtyping import Float
from torch import Tensor

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
    a batch mixes subjects (its root row is not read).
    """
    offsets = skeleton.t_parent_joint if t_parent_joint is None else t_parent_joint
    offsets = offsets.to(R_parent_joint).expand(*R_parent_joint.shape[:-3], len(skeleton), 3)
    R_levels, t_levels, order = [R_parent_joint[..., :1, :, :]], [t_world_root[..., None, :]], [0]
    for above, level in zip(skeleton.levels[:-1], skeleton.levels[1:]):
        parent = [above.index(skeleton.parents[joint]) for joint in level]
        R_parent, t_parent = R_levels[-1][..., parent, :, :], t_levels[-1][..., parent, :]
        joints = list(level)
        R_levels.append(R_parent @ R_parent_joint[..., joints, :, :])
        t_levels.append(t_parent + (R_parent @ offsets[..., joints, :, None])[..., 0])
        order += joints
    back = torch.tensor(order).argsort().to(R_parent_joint.device)
    return Rigid(torch.cat(R_levels, -3)[..., back, :, :], torch.cat(t_levels, -2)[..., back, :])


def site_positions(
    skeleton: Skeleton, T_world_joint: Rigid, names: tuple[str, ...]
) -> Float[Tensor, "*batch site 3"]:
    """World positions (m) of named sites (heels, toe tips …), in the order of `names`."""
    sites = [skeleton.sites[name] for name in names]
    joints = [skeleton.index(site.joint) for site in sites]
    offset = torch.tensor([site.t_joint_site for site in sites]).to(T_world_joint.t)
    return (T_world_joint.R[..., joints, :, :] @ offset[..., None])[..., 0] + T_world_joint.t[..., joints, :]


def local_rotations(
    skeleton: Skeleton, R_world_joint: Float[Tensor, "*batch joint 3 3"]
) -> Float[Tensor, "*batch joint 3 3"]:
    """The inverse of forward kinematics' rotations: R_parent_joint, the root's entry staying in the world."""
    R_parent = R_world_joint[..., list(skeleton.parents[1:]), :, :]
    local = R_parent.transpose(-1, -2) @ R_world_joint[..., 1:, :, :]
    return torch.cat([R_world_joint[..., :1, :, :], local], -3)
