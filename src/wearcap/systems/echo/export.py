"""ECHO's denoiser as exported graphs. Features, queue and guidance are the pipeline's own, and so is the small object
encoder, whose neighbour search exports poorly: its weights are written beside the model."""

from dataclasses import asdict
from typing import Any

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.body.contact_points import BODY_POINTS
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.data.features import LIMBS
from wearcap.errors import WearcapError
from wearcap.models.build import build
from wearcap.models.layers import Normalizer
from wearcap.models.point_encoder import PointNeXt
from wearcap.runtime.graphs import (
    ROT6D,
    Count,
    Exports,
    Graph,
    Rate,
    Run,
    SkeletonEntry,
    schedule_from_json,
    schedule_to_json,
    skeleton_to_json,
)
from wearcap.systems.echo.contacts import ContactUse, Guidance
from wearcap.systems.echo.features import POINTS, EchoFeatures
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser
from wearcap.systems.echo.pipeline import Echo, Sampling
from wearcap.systems.echo.queue import EchoModel
from wearcap.tracking.refinement import Refinement


def exports(pipeline: Echo) -> Exports:
    """The step, the levels' plan, the encoding of conditions, and the embedding of objects' codes, for full windows.

    Raises WearcapError for a network that is exported already, and for an unknown schedule.
    """
    model, guidance = pipeline.model, pipeline.contacts.guidance
    net, features, encoder = model.net, model.features, model.encoder
    if net.exported:
        raise WearcapError("a network that is exported already", expected="one of a checkpoint")
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
        "motion_channels": motion_channels(model.skeleton, features),
        "motion_mean": net.motion_normalizer.mean.tolist(),
        "motion_scale": net.motion_normalizer.scale.tolist(),
        "schedule": schedule_to_json(model.schedule),
        "settings": {
            "contacts": model.contacts,
            **vars(pipeline.sampling),
            "anchor": pipeline.anchor,
            "freedoms": pipeline.freedoms,
            "static_threshold": pipeline.contacts.static_threshold,
        },
        "guidance": None if guidance is None else asdict(guidance),
        "refinement": None if pipeline.refinement is None else asdict(pipeline.refinement),
        "skeleton": skeleton_to_json(model.skeleton),
        "encoder": None if encoder is None else encoder.settings,
    }
    return Exports("echo", net.graphs(), about, weights={} if encoder is None else {"encoder": encoder})


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
        *(f"{point}.seen" for point in POINTS[1:] if features.gaps),
    ]


def motion_channels(skeleton: Skeleton, features: EchoFeatures) -> list[str]:
    """Names of a frame's output channels in order; normalised by `motion_mean` and `motion_scale`."""
    pose = [*(f"_{axis}" for axis in "xyz"), *(f".{entry}" for entry in ROT6D)]
    return [
        *(f"root_{axis}" for axis in "xyz"),
        *(f"{joint}.{entry}" for joint in skeleton.joint_names for entry in ROT6D),
        *(f"object{entry}" for entry in pose),
        *(f"point_{k}.contact" for k in range(BODY_POINTS)),
        *(f"{patch}.contact" for patch in FOOT_PATCHES),
    ]


class _Embedding(nn.Module):
    """The embedding of objects' codes in an exported file, which takes full windows."""

    def __init__(self, run: Run, window: int):
        super().__init__()
        self._run, self._window = run, window

    def forward(self, codes: Float[Tensor, "*batch code"]) -> Float[Tensor, "*batch embedded"]:
        rows = codes.reshape(-1, codes.shape[-1])
        missing = -len(rows) % self._window
        whole = nn.functional.pad(rows, (0, 0, 0, missing)).unflatten(0, (-1, self._window))
        return self._run(input=whole).flatten(0, 1)[: len(rows)].reshape(*codes.shape[:-1], -1)


class _ExportedEchoDenoiser(EchoDenoiser):
    """A denoiser whose weights are in exported files, run on the CPU."""

    exported = True

    def __init__(self, runs: dict[str, Run], about: "Sidecar"):
        nn.Module.__init__(self)  # no blocks of its own
        self._runs, self.window, self.streams = (runs,), about.window, 1
        self.sizes = tuple(about.sizes[name] for name in MODALITIES)
        self.motion_normalizer = Normalizer(sum(self.sizes))
        self.motion_normalizer.set(torch.tensor(about.motion_mean), torch.tensor(about.motion_scale))
        self.object = _Embedding(runs["objects"], self.window)

    def graphs(self) -> dict[str, Graph]:
        runs = self._runs[0]
        return {
            name: Graph(runs[part], {}) for name, part in (("step", "model"), ("plan", "plan"), ("conditions",) * 2)
        }


class Sidecar(msgspec.Struct):
    """What running an exported model takes of its sidecar."""

    features: EchoFeatures
    window: Count
    fps: Rate
    sizes: dict[str, Count]
    motion_mean: list[float]
    motion_scale: list[float]
    schedule: dict[str, float | str]
    settings: dict[str, Any]
    skeleton: SkeletonEntry
    guidance: Guidance | None = None
    refinement: dict[str, Any] | None = None
    encoder: dict[str, Any] | None = None


def from_export(runs: dict[str, Run], weights: dict[str, dict[str, Tensor]], about: Sidecar) -> Echo:
    """The pipeline of an exported model."""
    encoder = None
    if about.encoder is not None:
        target = f"{PointNeXt.__module__}.{PointNeXt.__qualname__}"
        encoder: Any = build({**about.encoder, "_target_": target}, weights["encoder"], "the sidecar's encoder")
        encoder.requires_grad_(False)
    # Files of before these settings captured without them.
    settings = {"freedoms": False, "wrists": None, **about.settings}
    settings.setdefault("observed_length_scale", settings.pop("spread", None))  # its former name
    model = EchoModel(
        _ExportedEchoDenoiser(runs, about),
        about.features,
        schedule_from_json(about.schedule),
        about.skeleton.skeleton(),
        encoder,
        settings["contacts"],
    )
    use = ContactUse(about.guidance, settings["static_threshold"])
    sampling, refinement = msgspec.convert(settings, Sampling), Refinement.of(about.refinement)
    return Echo(model, sampling, use, settings["anchor"], refinement, freedoms=settings["freedoms"])
