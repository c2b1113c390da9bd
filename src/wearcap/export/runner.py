"""Running an exported model on a recording, without Lightning, Hydra or the network's code.

    python -m wearcap.export.runner MODEL.onnx RECORDING.safetensors MOTION.safetensors

Windows, features and sampler are the eager pipeline's own: the same noise gives the same motion.
"""

import argparse
import sys
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.data.features import HeadFeatures
from wearcap.errors import WearcapError
from wearcap.export.exported import Run, open_exported
from wearcap.export.sidecar import SCHEDULES, read_sidecar, skeleton_from_json
from wearcap.models.denoiser import MotionDenoiser, Normalizer
from wearcap.pipelines.hmd2 import HMD2
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording


class ExportedDenoiser(MotionDenoiser):
    """A `MotionDenoiser` whose weights live in an exported file, run on the CPU."""

    def __init__(self, run: Run, window: int, condition_size: int, motion_normalizer: Normalizer):
        nn.Module.__init__(self)  # no blocks of its own
        self._run = (run,)
        self.window, self.condition_size = window, condition_size
        self.motion_size = len(motion_normalizer.mean)
        self.motion_normalizer = motion_normalizer

    def forward(
        self,
        x_t: Float[Tensor, "batch time motion"],
        level: Float[Tensor, "batch #time"],
        condition: Float[Tensor, "batch time condition"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time motion"]:
        level = level.expand(valid.shape)
        x0_hat = self._run[0](x_t=x_t.cpu(), level=level.cpu(), condition=condition.cpu(), valid=valid.cpu())
        return x0_hat.to(x_t.device)


def load_exported(path: str | Path) -> HMD2:
    """The pipeline of an exported model, from the model file (.onnx or .pt2) and the sidecar beside it.

    Raises WearcapError when either is missing, unreadable, or does not belong to the other.
    """
    run = open_exported(path)
    about = read_sidecar(path, "denoiser")
    normalizer = Normalizer(len(about["motion_mean"]))
    normalizer.set(torch.tensor(about["motion_mean"]), torch.tensor(about["motion_scale"]))
    schedule = dict(about["schedule"])
    return HMD2(
        net=ExportedDenoiser(run, about["window"], about["condition_size"], normalizer),
        features=HeadFeatures(**about["features"]),
        schedule=SCHEDULES[schedule.pop("name")](**schedule),
        skeleton=skeleton_from_json(about["skeleton"]),
        fps=about["fps"],
        **about["sampler"],
    )


def main(arguments: list[str]) -> None:
    """Capture the motion of one recording with an exported model and write it as a recording."""
    parser = argparse.ArgumentParser(prog="python -m wearcap.export.runner", description=main.__doc__)
    parser.add_argument("model", type=Path, help="exported .onnx or .pt2 file, its .json beside it")
    parser.add_argument("recording", type=Path, help="recording (.safetensors) with a head stream")
    parser.add_argument("output", type=Path, help="where to write the motion (.safetensors)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sampler's noise (default 0)")
    options = parser.parse_args(arguments)
    recording = RecordingFile(options.recording).load()
    motion = load_exported(options.model)(recording, options.seed)
    captured = Recording(
        options.output.stem, motion=motion, skeleton=motion.skeleton, source=f"captured from {recording.name}"
    )
    save_recording(captured, options.output)
    print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
