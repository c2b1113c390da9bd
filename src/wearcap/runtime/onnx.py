"""A network in ONNX Runtime, made and opened within the process: weights packed, small operations fused."""

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
"""Called with the network's arguments in order; None for those that it does not have."""


def missing_libraries() -> list[str]:
    """What of ONNX Runtime and its exporter is not installed."""
    return [name for name in LIBRARIES if importlib.util.find_spec(name) is None]


def onnx_runner(
    net: nn.Module, example: dict[str, Tensor], *, fixed: tuple[str, ...] = (), int8: bool = False
) -> Runner:
    """The network on the CPU; its arguments have a leading batch axis of any length, but for those that are `fixed`.

    int8: weights as int8 per channel, activations scaled as they come. Weights are those of now.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    # Threads spin between the operations of a step; behind it they leave the cores to what else runs.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    lanes = {0: torch.export.Dim("batch", min=1)}
    dynamic = {name: None if name in fixed else lanes for name in example}
    with tempfile.TemporaryDirectory() as folder, quiet(), torch.no_grad():
        path = Path(folder) / "network.onnx"
        plain = copy.deepcopy(net).cpu().eval()
        program = torch.export.export(plain, (), example, dynamic_shapes=dynamic)
        torch.onnx.export(program, (), path, kwargs=example, dynamo=True, external_data=False)
        if int8:
            path = _narrowed(path)
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]

    def run(*told: Tensor | None) -> list[Tensor]:
        arrays = {name: value.contiguous().numpy() for name, value in zip(names, told) if value is not None}
        return [torch.from_numpy(value) for value in session.run(None, arrays)]

    return run


@contextlib.contextmanager
def undisturbed(onnx: bool = True) -> Iterator[None]:
    """For few small windows: PyTorch's threads, which wait by spinning, leave the cores to ONNX Runtime's."""
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
    """The exporters speak at length of optional libraries and of what they fold together."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(None):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
