"""Loading of a checkpoint's system by its own config, and of pipelines by a config, with or without a checkpoint."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console

from wearcap.errors import WearcapError
from wearcap.evaluation.realism import Realism
from wearcap.io.formats.environment import read_environment
from wearcap.models.build import build
from wearcap.models.checkpoint import read_checkpoint
from wearcap.recording.locate import dataset_folder
from wearcap.recording.recording import Recording
from wearcap.runtime.stages import StagedCapture, StagedPipeline
from wearcap.scene.environment import Environment
from wearcap.systems.echo.object_training import ObjectEncoding
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.training import EchoDiffusion
from wearcap.systems.hmd2.egoview_training import EgoView
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.point_codes_training import VoxelReconstruction
from wearcap.systems.hmd2.pose_regressor.pipeline import PoseRegressorCapture
from wearcap.systems.hmd2.pose_regressor.training import PoseRegression
from wearcap.systems.hmd2.training import MotionDiffusion
from wearcap.systems.ireplica.contact_prediction import ContactPredictor
from wearcap.systems.ireplica.training import ContactDetection
from wearcap.systems.mocap_every.energy import LatentSolver, LatentWeights
from wearcap.systems.mocap_every.manifold_training import ManifoldTraining
from wearcap.systems.mocap_every.pipeline import MocapEvery
from wearcap.systems.mocap_every.training import WatchRegression
from wearcap.systems.mocap_every.visual_cues import VisualCues
from wearcap.training.motion_autoencoder import MotionEncoding

System = (
    MotionDiffusion
    | ContactDetection
    | PoseRegression
    | WatchRegression
    | MotionEncoding
    | ManifoldTraining
    | VoxelReconstruction
    | ObjectEncoding
    | EchoDiffusion
    | EgoView
)
LearnedPipeline = HMD2 | PoseRegressorCapture | MocapEvery | Echo
"""Pipelines around one network, whole recordings at a time."""
NETWORKS: dict[str, tuple[type[System], str]] = {
    "HMD2": (MotionDiffusion, "experiment=hmd2"),
    "PoseRegressorCapture": (PoseRegression, "experiment=pose_regressor_head or pose_regressor_hands"),
    "MocapEvery": (WatchRegression, "experiment=mocap_every"),
    "Echo": (EchoDiffusion, "experiment=echo"),
}
"""System class that a learned pipeline's checkpoint must contain, and the experiment that trains one."""


def load_system(checkpoint: str | Path) -> tuple[System, dict[str, Any]]:
    """The trained system (averaged weights, evaluation mode) and the config it was trained with."""
    config, state = read_checkpoint(checkpoint)
    system = build(config["model"], state, checkpoint)
    if not isinstance(system, System):
        raise WearcapError(
            f"a checkpoint of {type(system).__name__} alone", where=checkpoint, expected="one of `wearcap train`"
        )
    return system, config


def load_pipeline(
    checkpoint: str | Path | Sequence[str] | None, pipeline: DictConfig, device: str
) -> LearnedPipeline | StagedPipeline:
    """The pipeline of a config group: with a checkpoint's network if it is learned (`_partial_`), else without one.

    iReplica takes several checkpoints of contact networks, one per class. Raises WearcapError for a learned pipeline
    without a checkpoint, and for a checkpoint that the pipeline cannot use.
    """
    learned, name = bool(pipeline.get("_partial_")), pipeline._target_.rpartition(".")[2]
    given = [checkpoint] if isinstance(checkpoint, str | Path) else list(checkpoint or ())
    if not learned and given:
        raise WearcapError(
            f"a checkpoint, but {name} has no network",
            where=given[0],
            fix="Leave checkpoint=… out, or choose another pipeline=….",
        )
    made = instantiate(pipeline, _convert_="all")
    if not learned:
        return made
    if not given:
        raise WearcapError(
            f"no checkpoint, but {name} needs a trained network",
            fix="Give checkpoint=…, or a pipeline without one, such as pipeline=hps.",
        )
    if name == "IReplica":
        return made(predictor=ContactPredictor.load(*given))
    system, _ = load_system(given[0])
    kind, experiment = NETWORKS[name]
    if not isinstance(system, kind):
        raise WearcapError(
            f"{name} cannot run {type(system).__name__}'s network",
            where=given[0],
            expected=f"a checkpoint of {experiment}",
        )
    return made(**system.pipeline_parts(), device=device)


def load_visual_cues(
    manifold: str,
    weights: LatentWeights | None = None,
    solver: LatentSolver | None = None,
    **settings: int | float | bool,
) -> VisualCues:
    """An editor in the manifold of a checkpoint of experiment=motion_manifold; see `VisualCues` for the settings."""
    system, _ = load_system(manifold)
    if not isinstance(system, ManifoldTraining):
        raise WearcapError(
            "cues need a motion manifold", where=manifold, expected="a checkpoint of experiment=motion_manifold"
        )
    return VisualCues(system.net, weights or LatentWeights(), solver or LatentSolver(), **settings)


def load_realism(checkpoint: str | Path, stride_s: float = 1.0) -> Realism:
    """Collector of FID and Diversity in the latent space of a motion autoencoder, over windows at a fixed stride."""
    system, _ = load_system(checkpoint)
    if not isinstance(system, MotionEncoding):
        raise WearcapError(
            "realism needs a motion autoencoder",
            where=checkpoint,
            expected="a checkpoint of experiment=motion_autoencoder",
        )
    return Realism(system.net, system.features, stride_s)


def staged(pipeline: StagedPipeline, config: DictConfig, data: str | Path, console: Console) -> StagedCapture:
    """A pipeline with stages bound to a data set: its folder, its cache, and the chosen scene."""
    scene, cache = (None if path is None else Path(path) for path in (config.scene, config.cache))
    return StagedCapture(pipeline, dataset_folder(data), scene, config.metres_per_unit, cache, console)


def trained_on(checkpoint: str | Path) -> tuple[list[str], str]:
    """(folders of the training data sets, folder of the validation data set) of a checkpoint.

    Raises WearcapError for a checkpoint that was shared without them.
    """
    data = read_checkpoint(checkpoint)[0].get("data", {})
    if not data.get("sources"):
        raise WearcapError(
            "this checkpoint does not name the data it was trained on",
            where=checkpoint,
            fix="Give dataset=DIR and baselines=false.",
        )
    sources = [source["root"] for source in data["sources"].values() if source]
    validated = [source["root"] for source in (data.get("val_sources") or data["sources"]).values() if source]
    return sources, validated[0]


def environment_of(recording: Recording, data: str | Path, given: str | Path | None) -> Environment | None:
    """Objects from a file, or from the environment file that a recording of DATASET/NAME names; None if it is missing."""
    if given is not None:
        return read_environment(given)
    path = dataset_folder(data) / recording.environment if recording.environment else None
    return read_environment(path) if path is not None and path.is_file() else None
