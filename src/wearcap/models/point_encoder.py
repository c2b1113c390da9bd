"""PointNeXt (Qian et al. 2022): the feature of an object's surface points that conditions ECHO.

Sampling and neighbourhoods are batched, exact, and independent of the points' order.
"""

import re
from collections.abc import Sequence
from math import prod
from pathlib import Path

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.weights import load_weights, read_weights

_LEAST_M = 1e-9
_LAST = 5
"""Index of the stage that pools all remaining points; 0 is the stem."""
_LAYER = {"0": "linear", "1": "norm"}
_HEAD = "prediction."
_NAME = re.compile(
    r"(?:encoder\.)?encoder\.(?P<stage>\d)\.0\.(?P<part>convs|skipconv)\.(?P<number>\d)(?:\.(?P<layer>[01]))?\.(?P<tensor>\w+)"
)


def bounds(points: Float[Tensor, "batch point 3"]) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 3"]]:
    """Half extents and centre of clouds' bounding boxes, in the points' unit; `PointNeXt`'s feature has neither."""
    low, high = points.amin(1), points.amax(1)
    return (high - low) / 2, (high + low) / 2


def to_unit_sphere(
    points: Float[Tensor, "batch point 3"],
) -> tuple[Float[Tensor, "batch point 3"], Float[Tensor, "batch"]]:
    """Clouds centred at their bounding boxes' centres and scaled to the unit sphere, and their radii before scaling."""
    centered = points - bounds(points)[1][:, None]
    radius = centered.norm(dim=-1).amax(1).clamp_min(_LEAST_M)
    return centered / radius[:, None, None], radius


@torch.no_grad()
def farthest_points(points: Float[Tensor, "batch point 3"], count: int) -> Int64[Tensor, "batch chosen"]:
    """Indices of `count` points, each the farthest from all before it; the first is the farthest from the origin.

    Its first n indices are the farthest-point sample of n. Points at equal positions are used once before any repeats.
    """
    x, y, z = (axis.contiguous() for axis in points.unbind(-1))
    chosen = torch.empty(len(points), count, dtype=torch.int64, device=points.device)
    apart = torch.full_like(x, torch.inf)
    latest = points.square().sum(-1).argmax(-1, keepdim=True)
    for number in range(count):
        chosen[:, number] = latest[:, 0]
        square = (x - x.gather(1, latest)).square_()
        square += (y - y.gather(1, latest)).square_()
        square += (z - z.gather(1, latest)).square_()
        apart = torch.minimum(apart, square)
        latest = apart.argmax(-1, keepdim=True)
    return chosen


@torch.no_grad()
def spread_first(points: Float[Tensor, "batch point 3"], count: int) -> Int64[Tensor, "batch point"]:
    """A permutation of all points that starts with the farthest-point sample of `count`."""
    chosen = farthest_points(points, count)
    rank = torch.full(points.shape[:2], count, dtype=torch.int64, device=points.device)
    rank.scatter_(1, chosen, torch.arange(count, device=points.device).expand_as(chosen))
    return rank.argsort(dim=1, stable=True)


@torch.no_grad()
def _ball_query(
    centers: Float[Tensor, "batch center 3"], points: Float[Tensor, "batch point 3"], radius: float, neighbours: int
) -> Int64[Tensor, "batch center neighbour"]:
    """Indices of the `neighbours` points nearest to each centre within a radius, filled up by the nearest one.

    The nearest point is included at any distance.
    """
    apart = torch.cdist(centers, points, compute_mode="donot_use_mm_for_euclid_dist")
    near, index = apart.topk(min(neighbours, points.shape[1]), largest=False)
    return torch.where(near <= radius, index, index[..., :1])


def _rows_at(
    values: Float[Tensor, "batch point feature"], index: Int64[Tensor, "batch *at"]
) -> Float[Tensor, "batch *at feature"]:
    """Gathers rows of a batch of tables by index."""
    batch, count, width = values.shape
    first = torch.arange(batch, device=index.device) * count
    flat = (index.flatten(1) + first[:, None]).flatten()
    return values.reshape(-1, width).index_select(0, flat).reshape(*index.shape, width)


class PointNeXt(nn.Module):
    """A sequence of set abstractions, then the maximum over the remaining points.

    The feature is invariant to the order of the points and to the cloud's translation and scale, not to rotation.
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
        much. `normalized`: positions in a ball are divided by its radius. `y_up`: the weights were trained on objects
        whose y axis points up instead of z. The defaults are PointNeXt-S for ModelNet40, 1024-d. Raises WearcapError for lists of different lengths.
        """
        super().__init__()
        if not len(strides) == len(blocks) == len(neighbours):
            what = f"{len(strides)} strides, {len(blocks)} numbers of blocks and {len(neighbours)} of neighbours"
            raise WearcapError(what, expected="one of each per stage")
        self.size, self.strides, self.y_up = width << len(strides), tuple(strides), y_up
        self.settings = {
            "width": width,
            "strides": list(strides),
            "blocks": list(blocks),
            "neighbours": list(neighbours),
            "radius": radius,
            "radius_scaling": radius_scaling,
            "expansion": expansion,
            "normalized": normalized,
            "y_up": y_up,
        }
        """Constructor arguments that make another encoder of the same kind."""
        self.stem = nn.Linear(3, width)
        stages = []
        for stage, (stride, count, most) in enumerate(zip(strides, blocks, neighbours)):
            narrow, near = width << stage, radius * radius_scaling**stage
            parts: list[nn.Module] = [_SetAbstraction(narrow, 2 * narrow, stride, near, most, normalized)]
            wider = near * radius_scaling
            parts += [_InvResMLP(2 * narrow, wider, most, normalized, expansion) for _ in range(count)]
            stages.append(nn.ModuleList(parts))
        self.stages = nn.ModuleList(stages)
        self.whole = nn.ModuleList([_Layer(self.size + 3, self.size), _Layer(self.size, self.size)])

    def forward(self, points: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch feature"]:
        """Features of clouds (m) in their objects' own axes. Raises WearcapError for too few points."""
        if points.shape[1] < prod(self.strides):
            expected = f"at least {prod(self.strides)}, such as 1500"
            raise WearcapError(f"clouds of {points.shape[1]} points", expected=expected)
        unit, _ = to_unit_sphere(points)
        if self.y_up:
            unit = torch.stack([unit[..., 0], unit[..., 2], -unit[..., 1]], -1)
        # A prefix of a farthest-point sample is one itself: later stages keep the first points.
        p = _rows_at(unit, spread_first(unit, unit.shape[1] // self.strides[0]))
        f = self.stem(p)
        for stage in self.stages:
            assert isinstance(stage, nn.ModuleList)
            for part in stage:
                p, f = part(p, f)
        f = torch.cat([p, f], -1)
        for layer in self.whole:
            f = F.relu(layer(f))
        return f.max(1).values


class _SetAbstraction(nn.Module):
    """Keeps the first points; each adds the maximum of an MLP over its ball to its feature."""

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
        index = _ball_query(p[:, :count], p, self.radius, self.neighbours)
        inside = self.second(F.relu(self.first(p, f, index)))
        return p[:, :count], F.relu(inside.max(2).values + self.skip(f[:, :count]))


class _InvResMLP(nn.Module):
    """A residual block: the maximum over each point's ball, then a wide MLP, added to the point's feature."""

    def __init__(self, width: int, radius: float, neighbours: int, normalized: bool, expansion: int):
        super().__init__()
        self.radius, self.neighbours = radius, neighbours
        self.ball = _BallLayer(width, width, radius if normalized else 1.0)
        self.widen, self.narrow = _Layer(width, expansion * width), _Layer(expansion * width, width)

    def forward(
        self, p: Float[Tensor, "batch point 3"], f: Float[Tensor, "batch point feature"]
    ) -> tuple[Float[Tensor, "batch point 3"], Float[Tensor, "batch point feature"]]:
        """The same positions with new features."""
        index = _ball_query(p, p, self.radius, self.neighbours)
        most = F.relu(self.ball(p, f, index)).max(2).values
        return p, F.relu(f + self.narrow(F.relu(self.widen(most))))


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

    The linear layer runs once per point, before gathering: W (p - c, f) = W (p, f) - W (c, 0).
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
        """Features of the first points' neighbours."""
        where = F.linear(p / self.unit, self.linear.weight[:, :3])
        what = where + F.linear(f, self.linear.weight[:, 3:])
        y = _rows_at(what, index) - where[:, : index.shape[1], None]
        return self.norm(y.flatten(0, -2)).reshape(y.shape)


class ObjectNetwork(nn.Module):
    """An encoder with its training heads: category, extents, and identity of the object."""

    def __init__(self, encoder: PointNeXt, classes: Sequence[str], projection: int = 64):
        """`projection` is the size of the embedding that distinguishes object instances."""
        super().__init__()
        self.encoder, self.classes = encoder, tuple(classes)
        self.category = nn.Linear(encoder.size, len(self.classes))
        self.extents = nn.Linear(encoder.size, 3)
        self.instance = nn.Linear(encoder.size, projection)


def load_openpoints(path: str | Path, normalized: bool = True) -> PointNeXt:
    """PointNeXt-S with the user's own weights: a `.pth` or `.safetensors` file that OpenPoints' training of its
    `cfgs/modelnet40ply2048/pointnext-s.yaml` wrote (ECHO says PointNeXt; which one is our reading), frozen.

    With C=64 the feature has 1024 numbers, with C=32 it has 512. Its classification head is left out. ModelNet40's objects have y up: ours are rotated to that. `normalized`: positions in a
    ball were divided by its radius in training, as published; false for a config without `normalize_dp: True`, to which
    the ModelNet40 file's `normalize_xyz` means nothing in newer OpenPoints. Raises WearcapError for a file of another
    format or with code in it, and for weights of another network.
    """
    tensors = {_own_name(name): value for name, value in read_weights(path).items() if not name.startswith(_HEAD)}
    stem = tensors.get("stem.weight")
    if stem is None or stem.ndim < 2 or stem.shape[1] != 3:
        given = "a tensor of other axes" if stem is not None else "nothing"
        what = f"these are not the weights of PointNeXt-S: encoder.encoder.0.0.convs.0.0.weight is {given}"
        expected = "a checkpoint of OpenPoints' cfgs/modelnet40ply2048/pointnext-s.yaml (in_channels: 3)"
        raise WearcapError(what, where=path, expected=expected)
    encoder = PointNeXt(width=len(stem), normalized=normalized, y_up=True)
    # The weights of a pointwise convolution are a matrix.
    pointwise = {name: value.ndim > 2 and value.shape[2:].numel() == 1 for name, value in tensors.items()}
    own = {name: value.flatten(1) if pointwise[name] else value for name, value in tensors.items()}
    load_weights(encoder, own, name="PointNeXt-S (ModelNet40)", where=path)
    return encoder.requires_grad_(False).eval()


def _own_name(name: str) -> str:
    """Our name of an OpenPoints tensor; unknown names stay."""
    found = _NAME.fullmatch(name)
    if found is None:
        return name
    stage, part, number, layer, tensor = found.group("stage", "part", "number", "layer", "tensor")
    if part == "skipconv":
        return f"stages.{int(stage) - 1}.0.skip.{tensor}"
    if int(stage) == 0:
        return f"stem.{tensor}"
    place = (
        f"whole.{number}" if int(stage) == _LAST else f"stages.{int(stage) - 1}.0.{('first', 'second')[number == '1']}"
    )
    return f"{place}.{_LAYER[layer or '0']}.{tensor}"
