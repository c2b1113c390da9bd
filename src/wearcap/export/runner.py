"""Running an exported model on a recording, without Lightning, Hydra or the network's code.

    python -m wearcap.export.runner MODEL.onnx RECORDING.safetensors MOTION.safetensors

Windows, features and sampler are the eager pipeline's own: the same noise gives the same motion.
"""

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wearcap.data.features import HeadFeatures
from wearcap.export import command
from wearcap.export.exported import Run, open_exported
from wearcap.export.sidecar import SCHEDULES, part_path, read_sidecar, skeleton_from_json
from wearcap.models.denoiser import Conditions, LevelPlan, MotionDenoiser, Normalizer
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.pipelines.hmd2 import HMD2
from wearcap.recording import Recording
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.scene.voxels import VoxelGrid


class ExportedDenoiser(MotionDenoiser):
    """A `MotionDenoiser` whose weights live in exported files, run on the CPU."""

    def __init__(self, step: Run, conditions: Run, about: dict):
        """`about`: the sidecar."""
        nn.Module.__init__(self)  # no blocks of its own
        self._run = step, conditions
        self.window, self.condition_size = about["window"], about["condition_size"]
        self.points_size, self.image_size = about["points_size"], about["image_size"]
        self.self_conditioning = about["self_conditioning"]
        self.motion_size = len(about["motion_mean"])
        self.motion_normalizer = Normalizer(self.motion_size)
        self.motion_normalizer.set(torch.tensor(about["motion_mean"]), torch.tensor(about["motion_scale"]))

    def encode(
        self, conditions: Conditions, valid: Bool[Tensor, "batch time"]
    ) -> Float[Tensor, "batch token width"]:
        told = {"head": conditions.head, "valid": valid}
        if self.points_size:
            told |= {"points": conditions.points, "points_valid": conditions.points_valid}
        if self.image_size:
            told |= {"image": conditions.image, "image_valid": conditions.image_valid}
        return self._run[1](**told)

    def plan(self, level: Float[Tensor, "batch #time"]) -> LevelPlan:
        """The exported step takes the level itself."""
        return LevelPlan(level[..., None], ())

    def step(
        self,
        x_t: Float[Tensor, "batch time motion"],
        plan: LevelPlan,
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        told = {
            "x_t": x_t,
            "level": plan.worth[..., 0].expand(len(x_t), 1),
            "encoded": encoded,
            "valid": valid,
        }
        if self.self_conditioning:
            told["last"] = torch.zeros_like(x_t) if last is None else last
        return self._run[0](**told)


class ExportedPlaces(VoxelAutoencoder):
    """The encoder of the points around the body, its weights in an exported file."""

    def __init__(self, run: Run, grid: VoxelGrid, size: int):
        nn.Module.__init__(self)
        self._run, self.grid, self.size = run, grid, size

    def encode(self, grids: Float[Tensor, "*batch x y z"]) -> Float[Tensor, "*batch feature"]:
        flat = grids.reshape(-1, *grids.shape[-3:])
        return self._run(grids=flat).reshape(*grids.shape[:-3], self.size)


def load_exported(path: str | Path) -> HMD2:
    """The pipeline of an exported model, from the step's file (.onnx or .pt2) and what was written beside it.

    Raises WearcapError when one of the files is missing, unreadable, or does not belong to the others.
    """
    step = open_exported(path)
    about = read_sidecar(path, "denoiser")
    parts = {name: open_exported(part_path(path, name)) for name in about["parts"]}
    places = None
    if "places" in parts:
        places = ExportedPlaces(parts["places"], VoxelGrid(**about["grid"]), about["points_size"])
    schedule = dict(about["schedule"])
    return HMD2(
        net=ExportedDenoiser(step, parts["conditions"], about),
        features=HeadFeatures(**about["features"]),
        schedule=SCHEDULES[schedule.pop("name")](**schedule),
        skeleton=skeleton_from_json(about["skeleton"]),
        fps=about["fps"],
        place_encoder=places,
        image_encoder=about["image_encoder"],
        **about["sampler"],
    )


def main(arguments: list[str]) -> None:
    """Capture the motion of one recording with an exported model and write it as a recording."""
    parser = command.parser("runner", main.__doc__, "a head stream", "the motion (.safetensors)")
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
    command.run(main)
