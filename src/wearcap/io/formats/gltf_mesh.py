"""Mesh of a body in a .glb: its skin, or sticks for its bones if there is no body model."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh, capsules

_THICK_M, _THIN_M = 0.022, 0.012
"""Radii (m) of a stick at its start and its end."""

_GREY = np.full(3, 0.7, np.float32)


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh in the rest pose (m, wearcap's axes, root at the origin), with up to four weighted joints per vertex."""

    mesh: Mesh
    joints: Int[np.ndarray, "vertex 4"]
    weights: Float32[np.ndarray, "vertex 4"]
    rest_joints: Float[Tensor, "joint 3"]

    @property
    def normals(self) -> Float32[np.ndarray, "vertex 3"]:
        """Unit normals; upwards at vertices without a face, for glTF wants every one of unit length."""
        normals = self.mesh.vertex_normals
        loose = np.linalg.norm(normals, axis=-1, keepdims=True) < 0.5
        return np.where(loose, np.float32([0, 0, 1]), normals).astype(np.float32)


def skin_of(body: BodyModel, skeleton: Skeleton) -> SkinnedMesh:
    """A body model's skin. Raises WearcapError when the motion's skeleton has other joints than the body."""
    if body.skeleton.joint_names != skeleton.joint_names:
        raise WearcapError(
            f"the motion has skeleton {skeleton.name!r}, the body {body.skeleton.name!r}",
            expected="the same joints",
            fix="Make the body for the motion's skeleton, or retarget.",
        )
    mesh = Mesh(body.rest_vertices.float().numpy(), body.faces.int().numpy(), _GREY, smooth=True)
    weights = body.skin_weights.float().numpy()
    # Joints without weight must be named as joint 0.
    joints = np.where(weights > 0, body.skin_joints.numpy(), 0)
    return SkinnedMesh(mesh, joints, weights / weights.sum(-1, keepdims=True), body.skeleton.rest_joints)


def sticks(skeleton: Skeleton) -> SkinnedMesh:
    """A rounded stick along every bone and out to every site; each moves with the joint it starts from."""
    bones = [(parent, skeleton.t_parent_joint[joint]) for joint, parent in enumerate(skeleton.parents) if joint]
    bones += [(skeleton.index(site.joint), torch.tensor(site.t_joint_site)) for site in skeleton.sites.values()]
    bones.append((0, torch.zeros(3)))
    owners = np.array([joint for joint, _ in bones])
    start = skeleton.rest_joints.double().numpy()[owners]
    end = start + torch.stack([offset for _, offset in bones]).double().numpy()
    mesh = capsules(
        start, end, np.full(len(bones), _THICK_M), np.full(len(bones), _THIN_M), np.tile(_GREY, (len(bones), 1)), 8
    )
    joints = np.zeros((len(mesh.vertices), 4), dtype=np.int64)
    joints[:, 0] = np.repeat(owners, len(mesh.vertices) // len(bones))
    weights = np.zeros((len(mesh.vertices), 4), dtype=np.float32)
    weights[:, 0] = 1
    return SkinnedMesh(mesh, joints, weights, skeleton.rest_joints)
