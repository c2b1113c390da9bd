"""A flat's points as tracking maps it in 15 minutes, and someone who walks there: for benchmarks of speed."""

import math

import torch

from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid

SIZE_M = torch.tensor([12.0, 9.0, 2.5])
_WALLS_X, _WALLS_Y = torch.tensor([0.0, 4.0, 8.0, 12.0]), torch.tensor([0.0, 4.5, 9.0])


def flat(count: int, seed: int = 0) -> torch.Tensor:
    """Points (m): 15 % on the floor, 5 % on the ceiling, 45 % on the walls of six rooms, 35 % on 24 pieces of furniture."""
    random = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=random) * SIZE_M
    kind = torch.rand(count, generator=random)
    points[kind < 0.15, 2] = 0.0
    points[(kind >= 0.15) & (kind < 0.2), 2] = SIZE_M[2]
    for axis, walls, low, high in ((0, _WALLS_X, 0.2, 0.425), (1, _WALLS_Y, 0.425, 0.65)):
        rows = (kind >= low) & (kind < high)
        points[rows, axis] = walls[torch.randint(len(walls), (int(rows.sum()),), generator=random)]
    rows = kind >= 0.65
    place = torch.rand(24, 3, generator=random) * SIZE_M
    place[:, 2] = 0.4
    side = torch.randn(int(rows.sum()), 3, generator=random)
    side /= side.abs().amax(1, keepdim=True)
    points[rows] = place[torch.randint(24, (len(side),), generator=random)] + side * torch.tensor([0.4, 0.3, 0.4])
    return points + 0.01 * torch.randn(count, 3, generator=random)


def stroll(frames: int, fps: float = 60.0) -> Rigid:
    """Devices at head height on a path through all rooms, looking around; five minutes to a round."""
    t = torch.arange(frames) / fps
    turn = 2 * math.pi * t / 300
    place = torch.stack([6 + 5 * torch.sin(7 * turn), 4.5 + 3.5 * torch.sin(9 * turn + 1), 1.6 + 0 * t], -1)
    return Rigid(rotation.about_axis("z", 3 * torch.sin(15 * turn)), place)
