"""Reads the user's own weights without executing anything from the file, and checks them against the network."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from wearcap.boundary.tensors import plain_tensors, read_tensors, read_torch
from wearcap.errors import WearcapError

_SHOWN = 4
_NESTED = (
    "state_dict",
    "model_state_dict",
    "model",
    "extractor",
)  # keys of the weights in the files of training scripts


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Named tensors of a `.safetensors` file, or of a PyTorch file (`.pth`, `.pt`, `.tar`) without code.

    A dictionary `state_dict` (or `model`) inside is opened, and the `module.` of DataParallel is taken out of the
    names. Raises WearcapError for a missing file, another format, and what `read_torch` refuses.
    """
    path = Path(path).expanduser()
    if path.suffix == ".safetensors":
        return read_tensors(path, "file of weights")[1]
    content = read_torch(path, "file of weights", "a .safetensors file, or a .pth file with tensors only")
    for key in _NESTED:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    tensors = plain_tensors(content, path)
    return {".".join(part for part in name.split(".") if part != "module"): value for name, value in tensors.items()}


def load_weights(network: nn.Module, tensors: Mapping[str, Tensor], *, name: str, where: str | Path) -> None:
    """Fill `network` with `tensors`. Raises WearcapError as `check_weights` does."""
    check_weights(network.state_dict(), tensors, name, where)
    network.load_state_dict(dict(tensors))


def check_weights(own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], name: str, where: str | Path) -> None:
    """Raise WearcapError unless the tensors of a file have the names and shapes of a model's own; it shows a few of those
    that do not fit."""
    missing, unexpected = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    wrong = [
        f"{len(names)} {what} ({', '.join(each[:80] for each in names[:_SHOWN])}{', …' if len(names) > _SHOWN else ''})"
        for names, what in ((missing, "missing"), (unexpected, "unexpected"))
        if names
    ]
    if wrong:
        what = f"these are not the weights of {name}: tensors {' and '.join(wrong)}"
        raise WearcapError(what, where=where, expected=f"{len(own)} tensors such as {next(iter(own), '')}")
    shapes = [
        f"{key} is {_shape(tensors[key])} and should be {_shape(value)}"
        for key, value in own.items()
        if tensors[key].shape != value.shape
    ]
    if shapes:
        more = f"; and {len(shapes) - _SHOWN} more" if len(shapes) > _SHOWN else ""
        what = f"the weights are those of another size of {name}: {'; '.join(shapes[:_SHOWN])}{more}"
        raise WearcapError(what, where=where)


def _shape(tensor: Tensor) -> str:
    return "×".join(str(size) for size in tensor.shape) or "a number"
