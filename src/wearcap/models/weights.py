"""Reads the user's own weights without executing anything from the file, and checks them against the network."""

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from wearcap.errors import WearcapError

_SHOWN = 4
_NESTED = ("state_dict", "model_state_dict", "model")  # keys of the weights in the files of training scripts
# A score beside the weights, as training scripts save it, is a NumPy number: plain data, but unknown to torch.load.
_SCALAR = np.float64(0).__reduce__()[0]
_NUMBERS = [
    _SCALAR,
    (_SCALAR, "numpy.core.multiarray.scalar"),  # its place before NumPy 2
    np.dtype,
    np.dtypes.Float32DType,
    np.dtypes.Float64DType,
    np.dtypes.Int64DType,
]


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Named tensors of a `.safetensors` file, or of a PyTorch file (`.pth`, `.pt`, `.tar`) without code.

    A dictionary `state_dict` (or `model`) inside is opened, and the `module.` of DataParallel is taken out of the
    names. Raises WearcapError for a missing file, another format, or a pickle that asks for more than data.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise WearcapError("there is no such file of weights", where=path)
    if path.suffix == ".safetensors":
        try:
            return load_file(path)
        except (OSError, safetensors.SafetensorError) as error:
            raise WearcapError(f"not a readable safetensors file ({error})", where=path) from error
    try:
        with torch.serialization.safe_globals(_NUMBERS):
            content: object = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        what = "the file is damaged, or holds more than tensors and was not opened, since loading it would run its code"
        expected = "a .safetensors file, or a .pth file with tensors only"
        fix = "If you trust its origin, save its state_dict with safetensors.torch.save_file."
        raise WearcapError(what, where=path, expected=expected, fix=fix) from error
    except Exception as error:  # torch.load may raise anything on bytes of another format
        raise WearcapError("not a readable PyTorch file", where=path) from error
    for key in _NESTED:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if not isinstance(content, Mapping) or not all(isinstance(value, Tensor) for value in content.values()):
        what = "the file does not hold a network's named tensors"
        raise WearcapError(what, where=path, expected="a state_dict, alone or under the key state_dict")
    return {
        ".".join(part for part in str(name).split(".") if part != "module"): value for name, value in content.items()
    }


def load_weights(network: nn.Module, tensors: Mapping[str, Tensor], *, name: str, where: str | Path) -> None:
    """Fill `network` with `tensors`; all of its names, no others, in its shapes.

    Raises WearcapError that shows a few of the names or shapes that do not fit.
    """
    own = network.state_dict()
    missing, unexpected = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or unexpected:
        wrong = [
            f"{len(names)} {what} ({', '.join(names[:_SHOWN])}{', …' if len(names) > _SHOWN else ''})"
            for names, what in ((missing, "missing"), (unexpected, "unexpected"))
            if names
        ]
        what = f"these are not the weights of {name}: tensors {' and '.join(wrong)}"
        raise WearcapError(what, where=where, expected=f"{len(own)} tensors such as {next(iter(own))}")
    shapes = [
        f"{key} is {_shape(tensors[key])} and should be {_shape(value)}"
        for key, value in own.items()
        if tensors[key].shape != value.shape
    ]
    if shapes:
        more = f"; and {len(shapes) - _SHOWN} more" if len(shapes) > _SHOWN else ""
        what = f"the weights are those of another size of {name}: {'; '.join(shapes[:_SHOWN])}{more}"
        raise WearcapError(what, where=where)
    network.load_state_dict(dict(tensors))


def _shape(tensor: Tensor) -> str:
    return "×".join(str(size) for size in tensor.shape) or "a number"
