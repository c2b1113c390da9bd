"""Named tensors in `.safetensors` files, with a description in JSON among their metadata, and those of strangers' PyTorch
files without running their code.
"""

import io
import pickle
import struct
import warnings
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch
from safetensors.torch import load_file, save

from wearcap.boundary.arrays import open_archive
from wearcap.boundary.limits import LIMITS, Budget
from wearcap.boundary.opening import explained, file_size
from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError
from wearcap.files import atomic_path

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


_CONVERT = "If you trust its origin, save its state_dict with safetensors.torch.save_file."


def open_tensors(path: str | Path, kind: str, fix: str = "") -> Any:
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
        return safetensors.safe_open(str(path), framework="pt")
    except _DAMAGE as error:
        raise WearcapError(f"not a readable {kind}", path, "a complete .safetensors file", fix) from error


def read_tensors(path: str | Path, kind: str, fix: str = "") -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """(metadata, tensors) of a whole `.safetensors` file. Raises WearcapError as `open_tensors` does."""
    metadata = open_tensors(path, kind, fix).metadata() or {}
    return metadata, load_file(path)


def open_described(path: str | Path, key: str, kind: str, writer: str, fix: str = "") -> tuple[Any, Any]:
    """(the open file, its description: content of the JSON text under `key` of its metadata).

    Raises WearcapError as `open_tensors` does, and for a file without it, which `writer` would have written.
    """
    file = open_tensors(path, kind, fix)
    if key not in (metadata := file.metadata() or {}):
        raise WearcapError(f"a .safetensors file, but not a {kind}", path, f"one that {writer} wrote")
    return file, parse_json(metadata[key], path)


def write_tensors(
    path: str | Path, tensors: Mapping[str, torch.Tensor | np.ndarray], description: Mapping[str, str] | None = None
) -> None:
    """Write named tensors, and a description by its key, atomically; equal content gives equal bytes.

    One key only: safetensors writes several in an order that changes from process to process.
    """
    whole = {
        name: (torch.tensor(value) if isinstance(value, np.ndarray) else value.detach().cpu().clone()).contiguous()
        for name, value in sorted(tensors.items())
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(whole, description and dict(description)))


def read_torch(path: str | Path, kind: str, expected: str) -> Any:
    """What a PyTorch file holds: tensors and plain values.

    PyTorch's reader is given a plain copy of the archive, in memory: it takes other directories and packings than Python's,
    and does not compare all checksums. Raises WearcapError when the file is missing, damaged, beyond the limits, or holds
    more than data.
    """
    size = file_size(path, kind)
    try:
        content = _plain_copy(path) if size and zipfile.is_zipfile(path) else path
        with torch.serialization.safe_globals(_NUMBERS), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of TorchScript archives, which are refused
            if isinstance(content, io.BytesIO):
                # PyTorch's own message about a name takes time in the square of its length.
                names = []
                with suppress(ValueError, RuntimeError):  # of a TorchScript archive
                    names = torch.serialization.get_unsafe_globals_in_checkpoint(content)
                if any(len(name) > 200 for name in names):
                    raise pickle.UnpicklingError
                content.seek(0)
            return torch.load(content, map_location="cpu", weights_only=True)
    except WearcapError:
        raise
    except pickle.UnpicklingError as error:
        what = "the file is damaged, or holds more than tensors and was not opened, since loading it would run its code"
        raise WearcapError(what, path, expected, _CONVERT) from error
    except Exception as error:  # torch.load may raise anything on damaged bytes
        what = f"not a readable {kind} ({' '.join(str(error).split())[:120] or type(error).__name__})"
        raise WearcapError(what, path, expected, _CONVERT if "TorchScript" in what else "") from error


def _plain_copy(path: str | Path) -> io.BytesIO:
    """An archive's parts as Python reads them, unpacked in a new archive."""
    copy = io.BytesIO()
    with open_archive(path, "weights", "a PyTorch file") as (archive, budget), zipfile.ZipFile(copy, "w") as plain:
        for entry in archive.infolist():
            budget.spend(entry.file_size)
            if entry.filename.endswith(".pkl"):
                budget.count(entry.file_size, "bytes that describe its tensors")
            plain.writestr(entry.filename, archive.read(entry))
    copy.seek(0)
    return copy


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
