"""Exported networks as files: written as ONNX or torch.export archives after a comparison with the eager networks, and opened
again, each graph as a function from named tensors to a tensor, or as the system that runs them.
"""

import copy
import importlib
import importlib.util
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from torch import Tensor, nn

from wearcap import extras
from wearcap.boundary.opening import file_size, understood
from wearcap.boundary.own import remember_own, require_own
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.boundary.texts import read_json_object, require_layout
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, sha256_of, write_text
from wearcap.runtime.graphs import Exports, Graph, Run, missing_libraries, open_onnx, program, quiet

VERSION = 6
"""Version of the sidecars: JSON files beside models with statistics, features, skeleton and more."""
TIMED_RUNS = 5


def open_pt2(path: str | Path) -> Run:
    """A torch.export archive of the user's own on the CPU.

    Raises WearcapError when it is missing, not readable, or somebody else's: PyTorch runs texts in it as code.
    """
    require_own(path)
    return _open_program(path)


def _open_program(path: str | Path) -> Run:
    file_size(path, "exported model")
    try:
        module = torch.export.load(str(path)).module()
    except Exception as error:  # PyTorch raises arbitrary exceptions on a graph that it did not write
        why = (str(error).splitlines() or [type(error).__name__])[0][:120]
        fix = "Copy it again, or export it again with `wearcap export`."
        raise WearcapError(f"not a readable .pt2 archive ({why})", where=path, fix=fix) from error
    return lambda **inputs: module(**inputs)


RUN_BY_FORMAT: dict[str, Callable[[str | Path], Run]] = {"onnx": open_onnx, "pt2": open_pt2}


def open_exported(path: str | Path) -> Run:
    """An exported network of either format, chosen by the file's suffix."""
    format = Path(path).suffix.removeprefix(".")
    if format not in RUN_BY_FORMAT:
        raise WearcapError("not an exported model", where=path, expected="a file that ends in .onnx or .pt2")
    return RUN_BY_FORMAT[format](path)


_Name = Annotated[str, msgspec.Meta(pattern=r"^\w{1,60}$")]


class _File(msgspec.Struct):
    """A file beside the sidecar, which is named as the part is."""

    sha256: str


class _Sidecar(msgspec.Struct):
    """What all sidecars have; each system's `export.Sidecar` has the rest."""

    wearcap_export: int
    network: Annotated[str, msgspec.Meta(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
    model: _File
    parts: dict[_Name, _File]
    weights: dict[_Name, _File]


def load_exported(path: str | Path) -> Any:
    """The system (for iReplica: the contact detector) of an exported model, from its files.

    Raises WearcapError when a file is missing, unreadable, of no known system, or does not belong to the others, for a
    sidecar of another layout, and for somebody else's .pt2.
    """
    file_size(path, "exported model")
    if Path(path).suffix == ".pt2":
        require_own(path)
    sidecar = sidecar_path(path)
    if not sidecar.exists():
        expected = "the .json file that `wearcap export` wrote beside the model"
        raise WearcapError("no such sidecar", where=sidecar, expected=expected, fix="Copy both files.")
    content = read_json_object(sidecar)
    if content.get("wearcap_export") != VERSION:
        raise WearcapError("not a sidecar of this version", where=sidecar, fix="Export the model again.")
    about = require_layout(content, _Sidecar, sidecar)
    name, package = about.network, f"wearcap.systems.{about.network}"
    if not all(map(importlib.util.find_spec, (package, f"{package}.export"))):
        raise WearcapError(f"a {name} network", where=path, expected="a known network")
    files = {Path(path): about.model}
    files |= {_file_of(path, part): entry for part, entry in about.parts.items()}
    files |= {_file_of(path, part, weights=True): entry for part, entry in about.weights.items()}
    for file, entry in files.items():
        if not file.is_file():
            what = "a part of the exported model is missing"
            raise WearcapError(what, where=file, fix="Copy all files of the export.")
        if entry.sha256 != sha256_of(file):
            raise WearcapError("its sidecar belongs to another model file", where=file, fix="Export the model again.")
    runs = {"model": open_exported(path)} | {name: open_exported(part_path(path, name)) for name in about.parts}
    weights = {name: read_tensors(_file_of(path, name, weights=True), "part of a model")[1] for name in about.weights}
    module = importlib.import_module(f"{package}.export")
    with understood(f"it describes no {name} network", sidecar, fix="Export the model again.", errors=_MISFIT):
        return module.from_export(runs, weights, require_layout(content, module.Sidecar, sidecar))


_MISFIT = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RuntimeError, MemoryError)
"""Exceptions of making a system of values that have the right types but do not fit each other."""


def part_path(path: str | Path, part: str) -> Path:
    """Path of another part's file, beside the model's own."""
    path = Path(path)
    return path.with_name(f"{path.stem}.{part}{path.suffix}")


def sidecar_path(path: str | Path) -> Path:
    return Path(path).with_suffix(".json")


def _file_of(path: str | Path, part: str, weights: bool = False) -> Path:
    file = part_path(path, Path(part).name)
    return file.with_suffix(".safetensors") if weights else file


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
        write_tensors(file, module.state_dict())
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
        raise extras.missing(missing[0], "export to ONNX")
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
        run = (_open_program if format == "pt2" else open_onnx)(temporary)
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
    if format == "pt2":
        remember_own(path)
    return ExportReport(str(path), format, size, error, latency, eager)


def _milliseconds(run: Callable[..., Tensor], inputs: dict[str, Tensor]) -> float:
    times = []
    for _ in range(TIMED_RUNS):
        start = time.perf_counter()
        run(**inputs)
        times.append(time.perf_counter() - start)
    return sorted(times)[TIMED_RUNS // 2] * 1000
