"""Opens exported networks, each as a function from named tensors to a tensor."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.export.archive import check_archive

Run = Callable[..., Tensor]
"""Called with the network's arguments by name."""
_AGAIN = "Copy it again, or export it again with `wearcap export`."


def open_onnx(path: str | Path) -> Run:
    """An ONNX file in ONNX Runtime on the CPU. Raises WearcapError when it is missing or not readable."""
    try:
        import onnxruntime
    except ImportError as error:
        raise WearcapError("running ONNX files needs onnxruntime", fix='Run: pip install "wearcap[export]"') from error
    _require_file(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base of their own
        raise WearcapError(f"not a readable ONNX file ({_first_line(error)})", where=path, fix=_AGAIN) from error

    def run(**inputs: Tensor) -> Tensor:
        arrays = {name: value.contiguous().numpy() for name, value in inputs.items()}
        return torch.from_numpy(session.run(None, arrays)[0])

    return run


def open_pt2(path: str | Path) -> Run:
    """A torch.export archive on the CPU. Raises WearcapError when it is missing, not readable, or refused by
    `check_archive`: PyTorch by itself would run code from it.
    """
    _require_file(path)
    try:
        check_archive(path)
        module = torch.export.load(str(path)).module()
    except WearcapError:
        raise
    except Exception as error:  # PyTorch raises arbitrary exceptions on a graph that it did not write
        raise WearcapError(f"not a readable .pt2 archive ({_first_line(error)})", where=path, fix=_AGAIN) from error
    return lambda **inputs: module(**inputs)


def _require_file(path: str | Path) -> None:
    if not Path(path).is_file():
        raise WearcapError("no such exported model", where=path, fix="Make one with `wearcap export`.")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


RUN_BY_FORMAT: dict[str, Callable[[str | Path], Run]] = {"onnx": open_onnx, "pt2": open_pt2}


def open_exported(path: str | Path) -> Run:
    """An exported network of either format, chosen by the file's suffix."""
    format = Path(path).suffix.removeprefix(".")
    if format not in RUN_BY_FORMAT:
        raise WearcapError("not an exported model", where=path, expected="a file that ends in .onnx or .pt2")
    return RUN_BY_FORMAT[format](path)
