"""`wearcap export`: a checkpoint's network as ONNX or torch.export, checked against eager, or the checkpoint for sharing."""

from omegaconf import DictConfig
from rich import print as show

from wearcap.cli.conf import hydra_main
from wearcap.cli.load import load_pipeline, load_system
from wearcap.errors import WearcapError
from wearcap.export.contact import export_contact
from wearcap.export.echo import export_echo
from wearcap.export.hmd2 import export_hmd2
from wearcap.export.mocap_every import export_mocap_every
from wearcap.export.network import ExportReport
from wearcap.models.checkpoint import share_checkpoint
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.ireplica.contact_prediction import load_detector
from wearcap.systems.ireplica.training import ContactDetection
from wearcap.systems.mocap_every.pipeline import MocapEvery

HELP = "export a network: wearcap export checkpoint=… format=onnx|pt2|safetensors"


def run(config: DictConfig) -> dict[str, ExportReport]:
    """Export the networks with their sidecar; prints the errors against eager and both latencies.

    format=safetensors writes the checkpoint itself, averaged weights and config, for sharing.
    """
    if config.format == "safetensors":
        share_checkpoint(config.checkpoint, config.output, config.dtype)
        show(f"checkpoint: {config.output}")
        return {}
    if isinstance(load_system(config.checkpoint)[0], ContactDetection):
        reports = {"network": export_contact(load_detector(config.checkpoint), config.output, config.format)}
    else:
        pipeline = load_pipeline(config.checkpoint, config.pipeline, "cpu")
        if isinstance(pipeline, HMD2):
            reports = export_hmd2(pipeline, config.output, config.format)
        elif isinstance(pipeline, MocapEvery):
            reports = {"network": export_mocap_every(pipeline, config.output, config.format)}
        elif isinstance(pipeline, Echo):
            reports = {"network": export_echo(pipeline, config.output, config.format)}
        else:
            raise WearcapError(
                "this pipeline has no network to export",
                where=config.checkpoint,
                expected="HMD²'s, MocapEvery's or ECHO's: pipeline=hmd2, pipeline=mocap_every, pipeline=echo",
            )
    for name, report in reports.items():
        show(f"exported {name}: {report.path}\n{report}")
    return reports


def main(arguments: list[str]) -> None:
    hydra_main("export", run, arguments)
