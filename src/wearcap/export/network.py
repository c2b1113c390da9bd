"""Writes a network as ONNX or as a torch.export archive, after checking it against the eager network."""

import copy
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.export.exported import RUN_BY_FORMAT
from wearcap.files import atomic_path
from wearcap.runtime.onnx import quiet

TIMED_RUNS = 5


@dataclass(frozen=True)
class ExportReport:
    """Comparison of an exported network with the eager one on this machine's CPU."""

    path: str
    format: str
    bytes: int
    max_abs_error: float
    """Largest difference of any output over batches of one and of three windows."""
    latency_ms: float
    """Median time of the exported network for one window."""
    eager_latency_ms: float
    """Median time of the eager network for one window."""


def export_network(
    net: nn.Module, example: dict[str, Tensor], path: str | Path, format: str, max_error: float
) -> ExportReport:
    """Write `net` in a format, "onnx" or "pt2" (a torch.export archive), with a dynamic batch axis.

    example: the network's arguments by name, each with a leading batch axis of at least 2; all other axes become
    fixed. The file appears under its name only if its outputs differ from eager's by less than `max_error`.
    Raises WearcapError when they differ more, when the format is unknown, or when its libraries are missing.
    """
    _require_libraries(format)
    path, net = Path(path), copy.deepcopy(net).cpu().eval()
    if path.suffix != f".{format}":
        raise WearcapError(
            f"a file of format {format} cannot end in {path.suffix!r}",
            where=path,
            expected=f"a name that ends in .{format}",
        )
    dynamic = {name: {0: torch.export.Dim("batch", min=1)} for name in example}
    with atomic_path(path) as temporary, torch.inference_mode(), quiet():
        program = torch.export.export(net, (), example, dynamic_shapes=dynamic)
        if format == "pt2":
            program.example_inputs = None  # torch would pickle them into the archive
            torch.export.save(program, temporary)
        else:
            torch.onnx.export(program, (), temporary, kwargs=example, dynamo=True, external_data=False)
        run = RUN_BY_FORMAT[format](temporary)
        error = max(_difference(net, run, example, batch) for batch in (1, 3))
        if not error < max_error:
            raise WearcapError(
                f"the exported network differs from the eager one by {error:.2e}",
                where=path,
                expected=f"less than {max_error:.0e}",
                fix="Try the other format and report this model.",
            )
        window = _batch_of(example, 1)
        latency, eager = _milliseconds(run, window), _milliseconds(lambda **inputs: net(**inputs), window)
        size = temporary.stat().st_size
    return ExportReport(str(path), format, size, error, latency, eager)


def _require_libraries(format: str) -> None:
    if format not in RUN_BY_FORMAT:
        raise WearcapError(f"unknown export format {format!r}", expected=f"one of {', '.join(RUN_BY_FORMAT)}")
    needed = ("onnx", "onnxscript", "onnxruntime") if format == "onnx" else ()
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        raise WearcapError(f"export to ONNX needs {', '.join(missing)}", fix='Run: pip install "wearcap[export]"')


def _batch_of(example: dict[str, Tensor], batch: int) -> dict[str, Tensor]:
    """The example's first row, repeated `batch` times; floats are scaled differently in every row."""
    rows = {name: value[:1].repeat(batch, *[1] * (value.ndim - 1)) for name, value in example.items()}
    divisor = 1 + 0.1 * torch.arange(batch)
    return {
        name: value / divisor.reshape(-1, *[1] * (value.ndim - 1)) if value.is_floating_point() else value
        for name, value in rows.items()
    }


def _difference(net: nn.Module, run: Callable[..., Tensor], example: dict[str, Tensor], batch: int) -> float:
    inputs = _batch_of(example, batch)
    return (net(**inputs) - run(**inputs)).abs().max().item()


def _milliseconds(run: Callable[..., Tensor], inputs: dict[str, Tensor]) -> float:
    times = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        run(**inputs)
        times.append(time.perf_counter() - start)
    return sorted(times)[TIMED_RUNS // 2] * 1000
