"""Export of MocapEvery's estimator to ONNX or torch.export with a sidecar, and a pipeline that runs the exported file.

    python -m wearcap.export.mocap_every MODEL.onnx RECORDING.safetensors MOTION.safetensors

The file has the network alone; coordinate frames, floor and windows are the eager pipeline's.
"""

from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.export import command
from wearcap.export.exported import Run, open_exported
from wearcap.export.network import ExportReport, export_network
from wearcap.export.sidecar import header, read_sidecar, skeleton_from_json, skeleton_to_json, write_sidecar
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.systems.mocap_every.features import WatchFeatures
from wearcap.systems.mocap_every.model import FEET, Estimate, TrainedEstimator, WatchEstimator
from wearcap.systems.mocap_every.pipeline import MocapEvery

MAX_ERROR = 1e-4


class _Joined(nn.Module):
    """Motion and contact logits of the last frames, in one tensor."""

    def __init__(self, net: WatchEstimator):
        super().__init__()
        self.net = net

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Float[Tensor, "batch predicted value"]:
        output = self.net(features)
        return torch.cat([output.motion, output.contact_logit], -1)


def export_mocap_every(pipeline: MocapEvery, path: str | Path, format: str) -> ExportReport:
    """Write the estimator as `path` (.onnx or .pt2) and its sidecar as the same name with .json.

    Its input is unnormalised `features` "batch window feature", its output motion and contact logits
    "batch predicted motion+2". Raises what `export_network` raises.
    """
    net, features, random = pipeline.net, pipeline.features, torch.Generator().manual_seed(0)
    if not isinstance(net, TrainedEstimator):
        raise WearcapError("a network that is exported already", where=path, expected="one of a checkpoint")
    normalizer = net.feature_normalizer
    noise = torch.randn(2, net.window, features.size, generator=random)
    example = {"features": normalizer.mean.cpu() + normalizer.scale.cpu() * noise}
    report = export_network(_Joined(net), example, path, format, MAX_ERROR)
    about = {
        "features": asdict(features),
        "feature_size": features.size,
        "motion_size": features.motion_size,
        "window": net.window,
        "fps": pipeline.fps,
        "skeleton": skeleton_to_json(pipeline.skeleton),
        "stride": pipeline.stride,
        "lookahead": pipeline.lookahead,
        "floor": pipeline.floor,
        "anchor": pipeline.anchor,
    }
    write_sidecar(path, header("mocap_every", report) | about)
    return report


class ExportedEstimator(WatchEstimator):
    """An estimator whose weights are in an exported file, run on the CPU."""

    def __init__(self, run: Run, window: int):
        super().__init__()
        self._run, self.window = (run,), window

    def forward(self, features: Float[Tensor, "batch window feature"]) -> Estimate:
        output = self._run[0](features=features)
        return Estimate(output[..., :-FEET], output[..., -FEET:], None)


def load_exported_mocap_every(path: str | Path) -> MocapEvery:
    """The pipeline of an exported model (.onnx or .pt2) and the sidecar beside it.

    Raises WearcapError when either is missing, unreadable, or does not belong to the other.
    """
    run, about = open_exported(path), read_sidecar(path, "mocap_every")
    return MocapEvery(
        ExportedEstimator(run, about["window"]),
        WatchFeatures(**about["features"]),
        skeleton_from_json(about["skeleton"]),
        about["fps"],
        about["stride"],
        about["lookahead"],
        about["floor"],
        about["anchor"],
    )


def main(arguments: list[str]) -> None:
    """Capture one recording with an exported model."""
    parser = command.parser("mocap_every", main.__doc__, "a head and two watches", "the motion (.safetensors)")
    options = parser.parse_args(arguments)
    recording = RecordingFile(options.recording).load()
    motion = load_exported_mocap_every(options.model)(recording)
    save_recording(Recording(recording.name, motion=motion, skeleton=motion.skeleton), options.output)
    print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    command.run(main)
