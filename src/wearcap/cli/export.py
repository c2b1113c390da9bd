"""`wearcap export`: a checkpoint's network as ONNX or torch.export, checked against eager, or the checkpoint for sharing."""

from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig
from rich import print as show
from torch import Tensor

from wearcap.cli.conf import hydra_application, load_pipeline, run_application, with_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.certainty import refitted
from wearcap.export.files import ExportReport, write_exports
from wearcap.models.checkpoint import share_checkpoint
from wearcap.recording import RecordingStore


def run(config: DictConfig) -> dict[str, ExportReport]:
    """Export the networks with their sidecar; prints the errors against eager and both latencies.

    format=safetensors writes the checkpoint itself, averaged weights and config, for sharing; with `fit` it is fitted anew how
    sure the network is of joints.
    """
    if config.format == "safetensors":
        share_checkpoint(config.checkpoint, config.output, config.dtype, _fitted(config))
        show(f"checkpoint: {config.output}")
        return {}
    if config.fit is not None:
        raise WearcapError(f"fit=… format={config.format}", expected="format=safetensors, which is then exported")
    exports = load_pipeline(config.checkpoint, config.pipeline, "cpu").exports()
    reports = write_exports(exports, config.output, config.format)
    for name, report in reports.items():
        show(
            f"exported {name}: {report.path}, {report.bytes / 1e6:.1f} MB of {report.format}, which differs from PyTorch by at "
            f"most {report.max_abs_error:.1g} and takes {report.latency_ms:.1f} ms (PyTorch {report.eager_latency_ms:.1f} ms)"
        )
    return reports


def _fitted(config: DictConfig) -> dict[str, Tensor]:
    """Statistics of how sure the network is of joints, fitted to a data set's validation split, with a line on it."""
    if config.fit is None:
        return {}
    store, system = RecordingStore.open(config.fit), load_pipeline(config.checkpoint, config.pipeline, "cpu")
    fitted = refitted(system, config.checkpoint, store, store.names("val"))
    show(f"degrees of freedom: {fitted['joint_dof'].item():.2f} (0: normal)")
    return fitted


def main(arguments: list[str], application: Callable[[], Any] | None = None) -> None:
    run_application("export", application or hydra_application("export", run), with_pipeline(arguments))
