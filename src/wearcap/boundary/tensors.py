"""Tensors of strangers' `.safetensors` files, and of the user's own PyTorch files without code."""

import pickle
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch
from safetensors.torch import load_file

from wearcap.boundary.limits import LIMITS, Budget
from wearcap.boundary.opening import explained, file_size
from wearcap.boundary.own import require_own
from wearcap.errors import WearcapError

_DAMAGE = (safetensors.SafetensorError, OSError, RuntimeError, ValueError, LookupError, TypeError)
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


def open_tensors(path: str | Path, kind: str, fix: str = "", framework: str = "pt") -> Any:
    """An open `.safetensors` file, memory-mapped, as `safetensors.safe_open` gives it.

    `kind` names in messages what it should be ("recording"). Raises WearcapError when it is missing, no regular file,
    damaged, or its header is beyond the limits.
    """
    size = file_size(path, kind)
    with explained(path, kind), open(path, "rb") as file:
        begin = file.read(8)
        length = struct.unpack("<Q", begin)[0] if len(begin) == 8 else size
        budget = Budget(path, "tensors")
        if 8 + length <= size:
            budget.spend(length)
            budget.count(file.read(length).count(b"{"), "tensors")
    try:
        return safetensors.safe_open(str(path), framework=framework)
    except _DAMAGE as error:
        raise WearcapError(f"not a readable {kind}", path, "a complete .safetensors file", fix) from error


def read_tensors(path: str | Path, kind: str, fix: str = "") -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """(metadata, tensors) of a whole `.safetensors` file. Raises WearcapError as `open_tensors` does."""
    metadata = open_tensors(path, kind, fix).metadata() or {}
    return metadata, load_file(path)


def read_torch(path: str | Path, kind: str, expected: str) -> Any:
    """What a PyTorch file of the user's own holds: tensors and plain values.

    Raises WearcapError when it is missing, somebody else's (`require_own`), damaged, or holds more than data.
    """
    file_size(path, kind)
    require_own(path)
    try:
        with torch.serialization.safe_globals(_NUMBERS):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        what = "the file is damaged, or holds more than data and was not opened, since loading it would run its code"
        fix = "If you trust its origin, save its state_dict with safetensors.torch.save_file."
        raise WearcapError(what, path, expected, fix) from error
    except Exception as error:  # torch.load may raise anything on damaged bytes
        what = f"not a readable {kind} ({' '.join(str(error).split())[:120] or type(error).__name__})"
        raise WearcapError(what, path, expected) from error


def plain_tensors(state: Any, where: str | Path) -> dict[str, torch.Tensor]:
    """Named weights on the CPU, whose memory is in the file: no expansion of a few numbers to any size.

    Raises WearcapError for anything else.
    """
    if not isinstance(state, Mapping) or not all(
        isinstance(name, str)
        and isinstance(value, torch.Tensor)
        and value.device.type == "cpu"
        and value.layout == torch.strided
        and not value.is_quantized
        and value.numel() * value.element_size() <= value.untyped_storage().nbytes()
        for name, value in state.items()
    ):
        raise WearcapError("the file does not hold a network's named tensors", where, "a state_dict")
    if len(state) > LIMITS["tensors"].items:
        raise WearcapError(f"{len(state)} tensors", where, f"at most {LIMITS['tensors'].items}")
    return dict(state)
