"""What a .glb shows of a body: its skin, or sticks for its bones where there is no body."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError

_STICK_M = 0.018
"""Half the thickness of a stick."""

_OCTAHEDRON = np.array(
    [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]
)


@dataclass(frozen=True)
class SkinnedMesh:
    """Vertices (m, our axes, root at the origin) at rest, and up to four joints with weights per vertex."""

    vertices: Float32[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    joints: Int[np.ndarray, "vertex 4"]
    weights: Float32[np.ndarray, "vertex 4"]
    rest_joints: Float[Tensor, "joint 3"]

    @property
    def normals(self) -> Float32[np.ndarray, "vertex 3"]:
        """Unit normals, each the mean of its faces' by area; upwards where a vertex has no face."""
        corners = self.vertices[self.faces].astype(np.float64)
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        total = np.zeros((len(self.vertices), 3))
        for corner in range(3):
            np.add.at(total, self.faces[:, corner], area)
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        return np.where(length > 1e-12, total / np.maximum(length, 1e-12), [0.0, 0.0, 1.0]).astype(np.float32)


def skin_of(body: BodyModel, skeleton: Skeleton) -> SkinnedMesh:
    """A body model's skin. Raises WearcapError when the motion's skeleton has other joints than the body."""
    if body.skeleton.joint_names != skeleton.joint_names:
        raise WearcapError(f"the motion has skeleton {skeleton.name!r}, the body {body.skeleton.name!r}",
                           expected="the same joints", fix="Make the body for the motion's skeleton, or retarget.")  # fmt: skip
    weights = body.skin_weights.float().numpy()
    weights = weights / weights.sum(-1, keepdims=True)
    return SkinnedMesh(
        body.rest_vertices.float().numpy(), body.faces.numpy(), np.where(weights > 0, body.skin_joints.numpy(), 0),
        weights, body.skeleton.rest_joints,
    )  # fmt: skip


def sticks(skeleton: Skeleton) -> SkinnedMesh:
    """A slim octahedron along every bone and out to every site; each moves with the joint it starts from."""
    bones = [
        (parent, skeleton.t_parent_joint[joint]) for joint, parent in enumerate(skeleton.parents) if joint
    ]
    bones += [
        (skeleton.index(site.joint), torch.tensor(site.t_joint_site)) for site in skeleton.sites.values()
    ]
    bones = [(joint, way.double().numpy()) for joint, way in bones if way.norm() > 1e-4]
    bones = bones or [(0, np.array([0.0, 0.0, 0.1]))]
    starts = skeleton.rest_joints.double().numpy()
    vertices = np.concatenate([starts[joint] + _stick(way) for joint, way in bones]).astype(np.float32)
    faces = np.concatenate([_OCTAHEDRON + 6 * k for k in range(len(bones))])
    joints = np.zeros((len(vertices), 4), dtype=np.int64)
    joints[:, 0] = np.repeat([joint for joint, _ in bones], 6)
    weights = np.zeros((len(vertices), 4), dtype=np.float32)
    weights[:, 0] = 1
    return SkinnedMesh(vertices, faces, joints, weights, skeleton.rest_joints)


def _stick(way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 3"]:
    """Tail, a ring of four a seventh of the way along, tip."""
    along = way / np.linalg.norm(way)
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    other = np.cross(along, across)
    ring = [way / 7 + _STICK_M * side for side in (across, other, -across, -other)]
    return np.stack([0 * way, *ring, way])
