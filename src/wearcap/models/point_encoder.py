"""PointNeXt: the points of an object's surface as one feature vector (Qian et al. 2022; what ECHO is told of an object)."""

from collections.abc import Sequence
from math import prod
from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_network
from wearcap.models.point_sampling import ball_query, rows_at, spread_first

_LEAST_M = 1e-9


def bounds(
    points: Float[Tensor, "batch point 3"],
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 3"]]:
    """Half extents and centre of clouds' bounding boxes, in the points' unit."""
    low, high = points.amin(1), points.amax(1)
    return (high - low) / 2, (high + low) / 2


def cloud_extents(points: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch 6"]:
    """Half extents and centre along the clouds' axes (m): what `PointNeXt` does not tell."""
    return torch.cat(bounds(points), -1)


def to_unit_sphere(
    points: Float[Tensor, "batch point 3"],
) -> tuple[Float[Tensor, "batch point 3"], Float[Tensor, "batch"]]:
    """Clouds about their boxes' centres in the unit sphere, and the radius (in the points' unit) they had."""
    centered = points - bounds(points)[1][:, None]
    radius = centered.norm(dim=-1).amax(1).clamp_min(_LEAST_M)
    return centered / radius[:, None, None], radius


class PointNeXt(nn.Module):
    """Set abstraction after set abstraction, then the maximum over what points are left.

    Neither the order of the points nor where the cloud lies nor how large it is changes the feature; its turning does.
    """

    def __init__(
        self,
        width: int = 64,
        strides: Sequence[int] = (2, 2, 2, 2),
        blocks: Sequence[int] = (0, 0, 0, 0),
        neighbours: Sequence[int] = (32, 32, 32, 32),
        radius: float = 0.15,
        radius_scaling: float = 1.5,
        expansion: int = 4,
        normalized: bool = True,
        y_up: bool = False,
    ):
        """Each stage keeps one point of `strides`, doubles `width`, and adds `blocks` InvResMLPs.

        The first gathers `neighbours` within `radius` (of the unit sphere), later ones within `radius_scaling` times as
        much. `normalized`: positions in a ball are divided by its radius. `y_up`: the weights know objects whose y points
        up instead of z. The defaults are PointNeXt-S for ModelNet40, 1024-d. Raises WearcapError for lists of different lengths.
        """
        super().__init__()
        if not len(strides) == len(blocks) == len(neighbours):
            raise WearcapError(
                f"{len(strides)} strides, {len(blocks)} numbers of blocks and {len(neighbours)} of neighbours",
                expected="one of each per stage",
            )
        self.size, self.strides, self.y_up = width << len(strides), tuple(strides), y_up
        self.settings = {
            "width": width, "strides": list(strides), "blocks": list(blocks), "neighbours": list(neighbours), "radius": radius,
            "radius_scaling": radius_scaling, "expansion": expansion, "normalized": normalized, "y_up": y_up,
        }  # fmt: skip
        """That make another one like it."""
        self.stem = nn.Linear(3, width)
        stages = []
        for stage, (stride, count, most) in enumerate(zip(strides, blocks, neighbours)):
            narrow, near = width << stage, radius * radius_scaling**stage
            parts: list[nn.Module] = [SetAbstraction(narrow, 2 * narrow, stride, near, most, normalized)]
            wider = near * radius_scaling
            parts += [InvResMLP(2 * narrow, wider, most, normalized, expansion) for _ in range(count)]
            stages.append(_Stage(parts))
        self.stages = nn.ModuleList(stages)
        self.whole = nn.ModuleList([_Layer(self.size + 3, self.size), _Layer(self.size, self.size)])

    def forward(self, points: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch feature"]:
        """Features of clouds (m) in their objects' own axes. Raises WearcapError for too few points."""
        if points.shape[1] < prod(self.strides):
            raise WearcapError(
                f"clouds of {points.shape[1]} points", expected=f"at least {prod(self.strides)}, such as 1500"
            )
        unit, _ = to_unit_sphere(points)
        if self.y_up:
            unit = torch.stack([unit[..., 0], unit[..., 2], -unit[..., 1]], -1)
        # Whoever is farthest from each other of all is so, too, of the first: later stages keep the first ones.
        p = rows_at(unit, spread_first(unit, unit.shape[1] // self.strides[0]))
        f = self.stem(p)
        for stage in self.stages:
            p, f = stage(p, f)
        f = torch.cat([p, f], -1)
        for layer in self.whole:
            f = F.relu(layer(f))
        return f.max(1).values


class SetAbstraction(nn.Module):
    """Of the first points each takes the maximum over its ball, of an MLP, and adds it to what it was."""

    def __init__(self, width: int, wide: int, stride: int, radius: float, neighbours: int, normalized: bool):
        super().__init__()
        self.stride, self.radius, self.neighbours = stride, radius, neighbours
        self.skip = nn.Linear(width, wide)
        self.first = _BallLayer(width, wide // 2, radius if normalized else 1.0)
        self.second = _Layer(wide // 2, wide)

    def forward(
        self, p: Float[Tensor, "batch point 3"], f: Float[Tensor, "batch point feature"]
    ) -> tuple[Float[Tensor, "batch center 3"], Float[Tensor, "batch center wide"]]:
        """Positions, farthest from each other first, and features, of fewer points."""
        count = p.shape[1] // self.stride
        index = ball_query(p[:, :count], p, self.radius, self.neighbours)
        inside = self.second(F.relu(self.first(p, f, index)))
        return p[:, :count], F.relu(inside.max(2).values + self.skip(f[:, :count]))


class InvResMLP(nn.Module):
    """The maximum over each point's ball, then a wide MLP, added to what the point was."""

    def __init__(self, width: int, radius: float, neighbours: int, normalized: bool, expansion: int):
        super().__init__()
        self.radius, self.neighbours = radius, neighbours
        self.ball = _BallLayer(width, width, radius if normalized else 1.0)
        self.widen, self.narrow = _Layer(width, expansion * width), _Layer(expansion * width, width)

    def forward(
        self, p: Float[Tensor, "batch point 3"], f: Float[Tensor, "batch point feature"]
    ) -> tuple[Float[Tensor, "batch point 3"], Float[Tensor, "batch point feature"]]:
        """The same positions, and other features."""
        index = ball_query(p, p, self.radius, self.neighbours)
        most = F.relu(self.ball(p, f, index)).max(2).values
        return p, F.relu(f + self.narrow(F.relu(self.widen(most))))


class _Stage(nn.ModuleList):
    """A set abstraction and what follows it."""

    def forward(
        self, p: Float[Tensor, "batch point 3"], f: Float[Tensor, "batch point feature"]
    ) -> tuple[Float[Tensor, "batch center 3"], Float[Tensor, "batch center wide"]]:
        for part in self:
            p, f = part(p, f)
        return p, f


class _Layer(nn.Module):
    """Linear and batch norm, over the last axis."""

    def __init__(self, width: int, wide: int):
        super().__init__()
        self.linear = nn.Linear(width, wide, bias=False)
        self.norm = nn.BatchNorm1d(wide)

    def forward(self, x: Float[Tensor, "*batch feature"]) -> Float[Tensor, "*batch wide"]:
        y = self.linear(x)
        return self.norm(y.flatten(0, -2)).reshape(y.shape)


class _BallLayer(_Layer):
    """The same over each neighbour's relative position and feature.

    What is linear is done once per point, and gathered only then: W (p - c, f) = W (p, f) - W (c, 0).
    """

    def __init__(self, width: int, wide: int, unit: float):
        """Relative positions are divided by `unit`."""
        super().__init__(3 + width, wide)
        self.unit = unit

    def forward(
        self,
        p: Float[Tensor, "batch point 3"],
        f: Float[Tensor, "batch point feature"],
        index: Int64[Tensor, "batch center neighbour"],
    ) -> Float[Tensor, "batch center neighbour wide"]:
        """Of the first points' neighbours."""
        where = F.linear(p / self.unit, self.linear.weight[:, :3])
        what = where + F.linear(f, self.linear.weight[:, 3:])
        y = rows_at(what, index) - where[:, : index.shape[1], None]
        return self.norm(y.flatten(0, -2)).reshape(y.shape)


class ObjectNetwork(nn.Module):
    """An encoder, and what its feature is asked in training: the category, the extents, which object it was."""

    def __init__(self, encoder: PointNeXt, classes: Sequence[str], projection: int = 64):
        """Categories to tell apart; instances are told apart by `projection` numbers."""
        super().__init__()
        self.encoder, self.classes = encoder, tuple(classes)
        self.category = nn.Linear(encoder.size, len(self.classes))
        self.extents = nn.Linear(encoder.size, 3)
        self.instance = nn.Linear(encoder.size, projection)


def load_object_encoder(path: str | Path) -> PointNeXt:
    """The encoder of a checkpoint of experiment=object_encoder (a path, or a name in `checkpoints/`), frozen.

    Raises WearcapError when the checkpoint is missing, damaged or another network's.
    """
    return load_network(path, PointNeXt, "object_encoder", part="net.encoder").requires_grad_(False)
