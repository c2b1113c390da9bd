"""Export of ECHO's denoiser to ONNX or torch.export with a sidecar, and a pipeline that runs the exported files.

    python -m wearcap.export.echo MODEL.onnx RECORDING.safetensors MOTION.safetensors

One graph has the denoiser: unnormalised conditions, x_t and noise levels go in, x̂0 comes out. Features, queue and
guidance are the eager pipeline's, and so is the small object encoder: its neighbour search exports poorly. Its
weights are beside the model, in NAME.objects.safetensors.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError
from wearcap.export import command
from wearcap.export.exported import Run, open_exported
from wearcap.export.network import ExportReport, export_network
from wearcap.export.sidecar import (
    ROT6D,
    SCHEDULES,
    header,
    read_sidecar,
    skeleton_from_json,
    skeleton_to_json,
    write_sidecar,
)
from wearcap.files import atomic_path, sha256_of
from wearcap.io.formats.environment import read_environment
from wearcap.models.layers import Normalizer
from wearcap.models.point_encoder import PointNeXt
from wearcap.recording import Recording
from wearcap.recording.locate import dataset_folder
from wearcap.recording.store import RecordingFile, save_recording
from wearcap.systems.echo.features import POINTS, EchoFeatures
from wearcap.systems.echo.guidance import Guidance
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser, EchoPlan
from wearcap.systems.echo.pipeline import Echo

MAX_ERROR = 1e-4
_CONVEYOR = ("context", "per_frame", "spacing", "eta", "step", "rewindow", "anchor", "static_threshold")


class _DenoiserGraph(nn.Module):
    """Normalised x̂0 of windows, from raw conditions, x_t and levels."""

    def __init__(self, net: EchoDenoiser):
        super().__init__()
        self.net = net

    def forward(
        self,
        condition: Float[Tensor, "batch time condition"],
        object_code: Float[Tensor, "batch time code"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
        x_t: Float[Tensor, "batch time feature"],
        level: Float[Tensor, "batch time modality"],
    ) -> Float[Tensor, "batch time feature"]:
        return self.net(x_t, level, self.net.encode(condition, self.net.object(object_code), has_object, valid), valid)


def export_echo(pipeline: Echo, path: str | Path, format: str) -> ExportReport:
    """Write the denoiser as `path` (.onnx or .pt2), its sidecar as the same name with .json, and the weights of the
    objects' encoder beside them.

    The graph takes full windows, whose padding frames are not `valid`. Raises what `export_network` raises.
    """
    net, features, schedule = pipeline.net, pipeline.features, pipeline.schedule
    if isinstance(net, ExportedEchoDenoiser):
        raise WearcapError("a network that is exported already", where=path, expected="one of a checkpoint")
    if type(schedule).__name__ not in SCHEDULES:
        raise WearcapError(
            f"schedule {type(schedule).__name__} cannot be exported", expected=f"one of {', '.join(SCHEDULES)}"
        )
    report = export_network(_DenoiserGraph(net), _example(net, features), path, format, MAX_ERROR)
    guidance = pipeline.guidance
    about = {
        "features": asdict(features),
        "window": net.window,
        "fps": pipeline.fps,
        "sizes": dict(zip(MODALITIES, net.sizes)),
        "condition_channels": condition_channels(features),
        "object_channels": [
            *(f"class.{name}" for name in features.classes),
            *(f"half_extent_{axis}" for axis in "xyz"),
            *(f"middle_{axis}" for axis in "xyz"),
            *(f"shape.{k}" for k in range(features.shape_size)),
        ],
        "motion_channels": motion_channels(pipeline.skeleton),
        "motion_mean": net.motion_normalizer.mean.tolist(),
        "motion_scale": net.motion_normalizer.scale.tolist(),
        "schedule": {"name": type(schedule).__name__, **vars(schedule)},
        "contacts": pipeline.contacts,
        "conveyor": {name: getattr(pipeline, name) for name in _CONVEYOR},
        "guidance": None if guidance is None else asdict(guidance),
        "skeleton": skeleton_to_json(pipeline.skeleton),
        "encoder": _write_encoder(pipeline.encoder, path),
    }
    write_sidecar(path, header("echo", report) | about)
    return report


def _example(net: EchoDenoiser, features: EchoFeatures) -> dict[str, Tensor]:
    random, shape = torch.Generator().manual_seed(0), (2, net.window)
    normalizer = net.condition_normalizer
    noise = torch.randn(*shape, features.condition_size, generator=random)
    return {
        "condition": normalizer.mean.cpu() + normalizer.scale.cpu() * noise,
        "object_code": torch.randn(*shape, features.object_condition_size, generator=random),
        "has_object": torch.rand(shape, generator=random) < 0.7,
        "valid": torch.arange(net.window).expand(shape) < net.window - 3,
        "x_t": torch.randn(*shape, sum(net.sizes), generator=random),
        "level": torch.rand(*shape, len(MODALITIES), generator=random),
    }


def condition_channels(features: EchoFeatures) -> list[str]:
    """Names of a frame's condition channels in order; they enter the network unnormalised."""
    heading = [f"heading_{axis}" for axis in "xy"] if features.frame == "own" else []
    wearer = ["height", *(f"size.{limb}" for limb in LIMBS)] if features.body else []
    return [
        *(f"{point}.{entry}" for point in POINTS for entry in ROT6D),
        *(f"{point}.turn.{entry}" for point in POINTS for entry in ROT6D),
        *(f"{point}.place_{axis}" for point in POINTS for axis in "xyz"),
        *(f"{point}.velocity_{axis}" for point in POINTS for axis in "xyz"),
        *heading,
        *wearer,
    ]


def motion_channels(skeleton: Skeleton) -> list[str]:
    """Names of a frame's output channels in order; normalised by `motion_mean` and `motion_scale`."""
    return [
        *(f"root_{axis}" for axis in "xyz"),
        *(f"{joint}.{entry}" for joint in skeleton.joint_names for entry in ROT6D),
        *(f"object_{axis}" for axis in "xyz"),
        *(f"object.{entry}" for entry in ROT6D),
        *(f"point_{k}.contact" for k in range(BODY_POINTS)),
        *(f"{patch}.contact" for patch in FOOT_PATCHES),
    ]


def encoder_path(path: str | Path) -> Path:
    """Path of the object encoder's file beside a model."""
    path = Path(path)
    return path.with_name(f"{path.stem}.objects.safetensors")


def _write_encoder(encoder: PointNeXt | None, path: str | Path) -> dict[str, Any] | None:
    if encoder is None:
        return None
    file = encoder_path(path)
    with atomic_path(file) as temporary:
        temporary.write_bytes(save({name: value.cpu() for name, value in encoder.state_dict().items()}))
    return {"file": file.name, "sha256": sha256_of(file), "settings": encoder.settings}


def _read_encoder(about: dict[str, Any] | None, path: str | Path) -> PointNeXt | None:
    if about is None:
        return None
    file = encoder_path(path)
    if not file.is_file():
        raise WearcapError("a part of the exported model is missing", where=file, fix="Copy all files of the export.")
    if about["sha256"] != sha256_of(file):
        raise WearcapError("it belongs to another exported model", where=file, fix="Export the model again.")
    encoder = PointNeXt(**about["settings"])
    encoder.load_state_dict(load_file(file))
    return encoder.requires_grad_(False).eval()


class ExportedEchoDenoiser(EchoDenoiser):
    """A denoiser whose weights are in an exported file, run on the CPU; it encodes the condition in every step."""

    def __init__(self, run: Run, about: dict[str, Any]):
        """`about`: the sidecar."""
        nn.Module.__init__(self)  # no blocks of its own
        self._run, self.window, self.streams = (run,), about["window"], 1
        self.sizes = tuple(about["sizes"][name] for name in MODALITIES)
        self.motion_normalizer = Normalizer(sum(self.sizes))
        self.motion_normalizer.set(torch.tensor(about["motion_mean"]), torch.tensor(about["motion_scale"]))
        self.object = nn.Identity()
        self._input_sizes = len(about["condition_channels"]), len(about["object_channels"]), 1

    def encode(
        self,
        condition: Float[Tensor, "batch time condition"],
        scene_object: Float[Tensor, "batch time embedded"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time width"]:
        """The raw conditions, concatenated: the exported network embeds and encodes them itself."""
        return torch.cat([condition, scene_object, has_object[..., None].to(condition.dtype)], -1)

    def plan(self, level: Float[Tensor, "batch time modality"]) -> EchoPlan:
        """The level itself."""
        return EchoPlan((level,), ())

    def step(
        self,
        x_t: Float[Tensor, "batch time feature"],
        plan: EchoPlan,
        encoded: Float[Tensor, "batch time width"],
        valid: Bool[Tensor, "batch time"],
    ) -> Float[Tensor, "batch time feature"]:
        batch, count, _ = x_t.shape
        condition, object_code, has_object = encoded.split(self._input_sizes, -1)
        level = plan.worth[0].expand(batch, -1, -1)
        inputs = {
            "condition": condition,
            "object_code": object_code,
            "has_object": has_object[..., 0] > 0,
            "valid": valid,
            "x_t": x_t,
            "level": level,
        }
        missing = self.window - count
        whole = {name: F.pad(value, (0, 0) * (value.ndim - 2) + (0, missing)) for name, value in inputs.items()}
        return self._run[0](**whole)[:, :count]


def load_exported_echo(path: str | Path) -> Echo:
    """The pipeline of an exported model (.onnx or .pt2) and the files beside it.

    Raises WearcapError when a file is missing, unreadable, or does not belong to the others.
    """
    run, about = open_exported(path), read_sidecar(path, "echo")
    schedule, guidance = dict(about["schedule"]), about["guidance"]
    return Echo(
        ExportedEchoDenoiser(run, about),
        EchoFeatures(**about["features"]),
        SCHEDULES[schedule.pop("name")](**schedule),
        skeleton_from_json(about["skeleton"]),
        _read_encoder(about["encoder"], path),
        about["contacts"],
        **about["conveyor"],
        guidance=None if guidance is None else Guidance(**guidance),
    )


def main(arguments: list[str]) -> None:
    """Capture one recording and its objects with an exported model."""
    parser = command.parser("echo", main.__doc__, "a head and two wrists", "the motion (.safetensors)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise (default 0)")
    options = parser.parse_args(arguments)
    recording, environment = RecordingFile(options.recording).load(), None
    if recording.environment is not None:
        environment = read_environment(dataset_folder(options.recording) / recording.environment)
    pipeline = load_exported_echo(options.model)
    motion = pipeline.capture_scenarios([pipeline.scenario(recording, environment)], [options.seed])[0]
    captured = Recording(
        recording.name, motion=motion, skeleton=motion.skeleton, object_motion=motion.object_motion or {}
    )
    save_recording(captured, options.output)
    print(f"{len(motion)} frames at {motion.fps:.0f} Hz: {options.output}")


if __name__ == "__main__":
    command.run(main)
