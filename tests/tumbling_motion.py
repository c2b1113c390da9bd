"""Random motion of any skeleton with a door that moves on its own clock, and a random skin: for writers of files."""

import torch

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion


def sample(frames: int = 8, skeleton: Skeleton | None = None) -> Motion:
    skeleton = skeleton or xsens23()
    generator = torch.Generator().manual_seed(1)
    turns = 0.25 * torch.randn(frames, len(skeleton), 3, generator=generator).cumsum(0)
    door = Trajectory(torch.arange(4, dtype=torch.float64) / 10 + 99.9, rotation.exp(turns[:4, 0]), turns[:4, 1])
    return Motion(
        torch.arange(frames, dtype=torch.float64) / 30 + 100,
        skeleton,
        rotation.exp(turns),
        torch.randn(frames, 3, generator=generator),
        object_motion={"door": door},
        provenance={"pipeline": "test"},
    )


def blob(skeleton: Skeleton, vertices: int = 40) -> BodyModel:
    """Something with a body model's fields: random vertices, each hanging on up to four joints."""
    generator = torch.Generator().manual_seed(4)
    weights = torch.rand(vertices, 4, generator=generator)
    weights[:, 3] = 0
    return BodyModel(
        skeleton=skeleton,
        rest_vertices=torch.randn(vertices, 3, generator=generator),
        faces=torch.randint(0, vertices, (60, 3), generator=generator),
        skin_joints=torch.randint(0, len(skeleton), (vertices, 4), generator=generator),
        skin_weights=weights / weights.sum(-1, keepdim=True),
    )
