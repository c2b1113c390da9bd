"""Runs a network in ONNX Runtime, exported and loaded within the process."""

import contextlib
import copy
import importlib.util
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

LIBRARIES = ("onnx", "onnxscript", "onnxruntime")
Runner = Callable[..., list[Tensor]]
"""Called with the network's arguments in order, None for those it does not take; returns its outputs."""


def missing_libraries() -> list[str]:
    """Names of the packages for ONNX Runtime and its exporter that are not installed."""
    return [name for name in LIBRARIES if importlib.util.find_spec(name) is None]


def onnx_runner(
    net: nn.Module, example: dict[str, Tensor], *, fixed: tuple[str, ...] = (), int8: bool = False
) -> Runner:
    """The network on the CPU with its current weights.

    All arguments except those in `fixed` have a leading batch axis of any length. int8: weights are quantised to int8
    per channel, activations dynamically.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    # Threads spin between the operations of a step; after it they yield the cores to other work.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    batch_axis = {0: torch.export.Dim("batch", min=1)}
    dynamic = {name: None if name in fixed else batch_axis for name in example}
    with tempfile.TemporaryDirectory() as folder, quiet(), torch.no_grad():
        path = Path(folder) / "network.onnx"
        plain = copy.deepcopy(net).cpu().eval()
        program = torch.export.export(plain, (), example, dynamic_shapes=dynamic)
        torch.onnx.export(program, (), path, kwargs=example, dynamo=True, external_data=False)
        if int8:
            path = _narrowed(path)
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]

    def run(*inputs: Tensor | None) -> list[Tensor]:
        arrays = {name: value.contiguous().numpy() for name, value in zip(names, inputs) if value is not None}
        return [torch.from_numpy(value) for value in session.run(None, arrays)]

    return run


@contextlib.contextmanager
def undisturbed(onnx: bool = True) -> Iterator[None]:
    """A context for small batches in which PyTorch's spinning threads leave the cores to ONNX Runtime's."""
    threads = torch.get_num_threads()
    if onnx:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _narrowed(path: Path) -> Path:
    from onnxruntime.quantization import QuantType, quantize_dynamic

    narrow = path.with_name("network8.onnx")
    quantize_dynamic(path, narrow, weight_type=QuantType.QInt8, per_channel=True, reduce_range=True)
    return narrow


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """A context that silences the exporters' messages about optional libraries and constant folding."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(None):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
