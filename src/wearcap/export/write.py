"""Writes networks as ONNX or as torch.export archives, after checking them against the eager networks."""

import copy
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.export.read import RUN_BY_FORMAT, VERSION, part_path, sidecar_path
from wearcap.files import atomic_path, sha256_of, write_text
from wearcap.runtime.graphs import Exports, Graph, missing_libraries, program, quiet

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


def write_exports(exports: Exports, path: str | Path, format: str) -> dict[str, ExportReport]:
    """Write a system's graphs in a format, "onnx" or "pt2", and a sidecar of `path`'s name with .json.

    The first graph is `path`; the others are files of its name with theirs (NAME.plan.onnx). Returns the reports by the
    graphs' names. Raises what `export_network` raises.
    """
    path, first = Path(path), next(iter(exports.graphs))
    reports = {
        name: export_network(graph, path if name == first else part_path(path, name), format, exports.max_error)
        for name, graph in exports.graphs.items()
    }
    weights = {}
    for name, module in exports.weights.items():
        file = part_path(path, name).with_suffix(".safetensors")
        with atomic_path(file) as temporary:
            temporary.write_bytes(save({key: value.cpu() for key, value in module.state_dict().items()}))
        weights[name] = {"file": file.name, "sha256": sha256_of(file)}
    files = {
        name: {"file": Path(report.path).name, "sha256": sha256_of(report.path)} for name, report in reports.items()
    }
    parts = {name: files[name] | asdict(report) for name, report in reports.items()}
    about = {"wearcap_export": VERSION, "network": exports.network, "model": parts.pop(first), "parts": parts}
    write_text(sidecar_path(path), json.dumps(about | {"weights": weights} | exports.about, indent=1) + "\n")
    return reports


def export_network(graph: Graph, path: str | Path, format: str, max_error: float) -> ExportReport:
    """Write a graph in a format, "onnx" or "pt2" (a torch.export archive), with a dynamic batch axis.

    The file appears under its name only if its outputs differ from eager's by less than `max_error`. Raises
    WearcapError when they differ more, when the format is unknown, or when its libraries are missing.
    """
    if format not in RUN_BY_FORMAT:
        raise WearcapError(f"unknown export format {format!r}", expected=f"one of {', '.join(RUN_BY_FORMAT)}")
    if missing := missing_libraries() if format == "onnx" else []:
        raise WearcapError(f"export to ONNX needs {', '.join(missing)}", fix='Run: pip install "wearcap[export]"')
    assert isinstance(graph.module, nn.Module)
    path, net = Path(path), copy.deepcopy(graph.module).cpu().eval()
    if path.suffix != f".{format}":
        what = f"a file of format {format} cannot end in {path.suffix!r}"
        raise WearcapError(what, where=path, expected=f"a name that ends in .{format}")
    exported = program(graph)
    with atomic_path(path) as temporary, torch.inference_mode(), quiet():
        if format == "pt2":
            exported.example_inputs = None  # torch would pickle them into the archive
            torch.export.save(exported, temporary)
        else:
            torch.onnx.export(exported, (), temporary, kwargs=graph.inputs, dynamo=True, external_data=False)
        run = RUN_BY_FORMAT[format](temporary)
        # The example's first row, repeated; floats are scaled differently in every row.
        windows: dict[int, dict[str, Tensor]] = {1: {}, 3: {}}
        for batch, window in windows.items():
            for name, value in graph.inputs.items():
                if name not in graph.shared:
                    axes = [1] * (value.ndim - 1)
                    value = value[:1].repeat(batch, *axes)
                    if value.is_floating_point():
                        value = value / (1 + 0.1 * torch.arange(batch)).reshape(-1, *axes)
                window[name] = value
        error = max((net(**inputs) - run(**inputs)).abs().max().item() for inputs in windows.values())
        if not error < max_error:
            what = f"the exported network differs from the eager one by {error:.2e}"
            fix = "Try the other format and report this model."
            raise WearcapError(what, where=path, expected=f"less than {max_error:.0e}", fix=fix)
        latency, eager = _milliseconds(run, windows[1]), _milliseconds(net, windows[1])
        size = temporary.stat().st_size
    return ExportReport(str(path), format, size, error, latency, eager)


def _milliseconds(run: Callable[..., Tensor], inputs: dict[str, Tensor]) -> float:
    times = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        run(**inputs)
        times.append(time.perf_counter() - start)
    return sorted(times)[TIMED_RUNS // 2] * 1000
