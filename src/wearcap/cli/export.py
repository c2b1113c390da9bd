"""`wearcap export`: a checkpoint's network as ONNX or torch.export, checked against eager, as a page for the browser, or the
checkpoint for sharing."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich import print as show
from torch import Tensor

from wearcap.cli.conf import compose, hydra_application, load_pipeline, run_application, with_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.certainty import refitted
from wearcap.export.files import ExportReport, write_exports
from wearcap.export.web import fetched_libraries, page_exports, write_page
from wearcap.models.checkpoint import share_checkpoint
from wearcap.reading import read
from wearcap.recording import Recording, RecordingStore
from wearcap.runtime.system import System


def run(config: DictConfig) -> dict[str, ExportReport]:
    """Export the networks with their sidecar; prints the errors against eager and both latencies.

    format=safetensors writes the checkpoint itself, averaged weights and config, for sharing; with `fit` it is fitted anew how
    sure the network is of joints.
    """
    if config.format == "safetensors":
        share_checkpoint(config.checkpoint, config.output, config.dtype, _fitted(config))
        show(f"checkpoint: {config.output}")
        return {}
    if config.format != "web" and (config.libraries, config.recording) != (None, None):
        raise WearcapError(f"libraries=… or recording=… format={config.format}", expected="format=web")
    if config.fit is not None:
        raise WearcapError(f"fit=… format={config.format}", expected="format=safetensors, which is then exported")
    system = load_pipeline(config.checkpoint, config.pipeline, "cpu")
    if config.format == "web":
        return {"window": _page(system, config)}
    exports = system.exports()
    reports = write_exports(exports, config.output, config.format)
    for name, report in reports.items():
        show(
            f"exported {name}: {report.path}, {report.bytes / 1e6:.1f} MB of {report.format}, which differs from PyTorch by at "
            f"most {report.max_abs_error:.1g} and takes {report.latency_ms:.1f} ms (PyTorch {report.eager_latency_ms:.1f} ms)"
        )
    return reports


def _page(system: System, config: DictConfig) -> ExportReport:
    """Write the folder of a page, with a line on how to open it."""
    exports = page_exports(system)
    libraries = Path(config.libraries) if config.libraries else fetched_libraries()
    recording = simulated_sample() if config.recording is None else read(config.recording)
    report = write_page(exports, config.output, recording, libraries)
    show(
        f"page: {config.output}, whose network differs from PyTorch by at most {report.max_abs_error:.1g}\n"
        f"  python -m http.server --directory {config.output} 8000, then open http://localhost:8000"
    )
    return report


def simulated_sample() -> Recording:
    """A simulated wearer who walks and reaches, for 20 seconds."""
    from wearsim.recordings.simulate import SimulationConfig, simulate_recording

    activities = ("walk", "reach", "gesture")
    settings = SimulationConfig(duration_s=20.0, points=False, activities=activities, world="flat")
    return simulate_recording(settings, "simulated wearer", "test", 7)


def _fitted(config: DictConfig) -> dict[str, Tensor]:
    """Statistics of how sure the network is of joints, fitted to a data set's validation split, with a line on it."""
    if config.fit is None:
        return {}
    store, system = RecordingStore.open(config.fit), load_pipeline(config.checkpoint, config.pipeline, "cpu")
    fitted = refitted(system, config.checkpoint, store, store.names("val"))
    show(f"degrees of freedom: {fitted['joint_dof'].item():.2f} (0: normal)")
    return fitted


def with_page_pipeline(arguments: list[str]) -> list[str]:
    """A command's arguments with the pipeline of their checkpoint's system (`with_pipeline`): of a page the streaming one."""
    chosen = with_pipeline(arguments)
    if "format=web" not in arguments or chosen == arguments:
        return chosen
    systems, name = dict(compose("live").systems), chosen[0].removeprefix("pipeline=")
    return [f"pipeline={systems.get(name, name)}", *arguments]


def main(arguments: list[str], application: Callable[[], Any] | None = None) -> None:
    run_application("export", application or hydra_application("export", run), with_page_pipeline(arguments))
