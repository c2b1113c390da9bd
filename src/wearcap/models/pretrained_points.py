"""PointNeXt-S with the user's own weights: OpenPoints' checkpoints of its ModelNet40 config (ECHO says
PointNeXt; which one is our reading).

Of `cfgs/modelnet40ply2048/pointnext-s.yaml`; with C=64 the feature has 1024 numbers, with C=32 it has 512.
"""

import re
from pathlib import Path

from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.models.point_encoder import PointNeXt
from wearcap.models.weights import load_weights, read_weights

_LAST = 5
"""Index of the stage that pools all remaining points; 0 is the stem."""
_LAYER = {"0": "linear", "1": "norm"}
_HEAD = "prediction."
_NAME = re.compile(
    r"(?:encoder\.)?encoder\.(?P<stage>\d)\.0\.(?P<part>convs|skipconv)\.(?P<number>\d)(?:\.(?P<layer>[01]))?\.(?P<tensor>\w+)"
)


def load_openpoints(path: str | Path, normalized: bool = True) -> PointNeXt:
    """The encoder of a `.pth` or `.safetensors` file that OpenPoints' training wrote, in evaluation mode, frozen.

    Its classification head is left out. ModelNet40's objects have y up: ours are rotated to that. `normalized`: positions in a
    ball were divided by its radius in training, as published; false for a config without `normalize_dp: True`, to which
    the ModelNet40 file's `normalize_xyz` means nothing in newer OpenPoints. Raises WearcapError for a file of another
    format or with code in it, and for weights of another network.
    """
    tensors = {_own_name(name): value for name, value in read_weights(path).items() if not name.startswith(_HEAD)}
    stem = tensors.get("stem.weight")
    if stem is None or stem.ndim < 2 or stem.shape[1] != 3:
        given = "a tensor of other axes" if stem is not None else "nothing"
        raise WearcapError(
            f"these are not the weights of PointNeXt-S: encoder.encoder.0.0.convs.0.0.weight is {given}",
            where=path,
            expected="a checkpoint of OpenPoints' cfgs/modelnet40ply2048/pointnext-s.yaml (in_channels: 3)",
        )
    encoder = PointNeXt(width=len(stem), normalized=normalized, y_up=True)
    own = {name: _flat(value) for name, value in tensors.items()}
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


def _flat(value: Tensor) -> Tensor:
    """The weights of a pointwise convolution as a matrix."""
    return value.flatten(1) if value.ndim > 2 and value.shape[2:].numel() == 1 else value
