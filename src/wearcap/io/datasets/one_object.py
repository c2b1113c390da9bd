"""Common form of data sets of a person who handles one object: body, object trajectory and mesh on one clock."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Motion


@dataclass(frozen=True, eq=False)
class OneObject:
    """One take: the body, and the object that is handled throughout. Timestamps of both agree; they may have gaps."""

    name: str
    motion: Motion
    object_name: str
    """Name of the object in the data set."""
    path: Trajectory
    """Poses of the mesh's axes in the world."""
    mesh: Mesh
    """Mesh in metres, with the mean of its vertices at the origin."""
    shape: dict[str, float]
    subject: str
    activity: str
    location: str = ""

    def turned(self, R_new_old: Float[Tensor, "3 3"]) -> "OneObject":
        """The take in rotated world axes with the same origin."""
        R_joints = self.motion.R_parent_joint
        R_new = R_new_old.to(R_joints.dtype)
        R_joints = torch.cat([R_new @ R_joints[:, :1], R_joints[:, 1:]], 1)
        motion = replace(self.motion, R_parent_joint=R_joints, t_world_root=self.motion.t_world_root @ R_new.mT)
        path = self.path
        turned = Trajectory(path.timestamps, R_new @ path.R_world_body, path.t_world_body @ R_new.mT)
        return replace(self, motion=motion, path=turned)

    def frames(self, chosen: slice | Bool[Tensor, "time"]) -> "OneObject":
        """The take with the selected frames of body and object, by slice or mask."""
        rows = {name: getattr(self.motion, name)[chosen] for name in ("timestamps", "R_parent_joint", "t_world_root")}
        return replace(self, motion=replace(self.motion, **rows), path=self.path[chosen])
