"""Loading of systems: by a pipeline config, with the networks of checkpoints where it needs any."""

from collections.abc import Sequence
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig

from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import read_checkpoint
from wearcap.runtime.system import System


def load(
    pipeline: str, *overrides: str, checkpoint: str | Path | Sequence[str] | None = None, device: str = "cpu"
) -> System:
    """The system that `wearcap capture pipeline=… checkpoint=…` runs; without a checkpoint, the shared one's network.

    `overrides` are those of the command line ("pipeline.sampling.steps=20"). Raises WearcapError for an unknown pipeline or
    setting, and for a checkpoint that the pipeline cannot use.
    """
    config = compose("capture", [f"pipeline={pipeline}", *overrides, "recording=none"])
    return load_pipeline(checkpoint, config.pipeline, device, shared=True)


def load_pipeline(
    checkpoint: str | Path | Sequence[str] | None, pipeline: DictConfig, device: str, shared: bool = False
) -> System:
    """The system of a pipeline config; one with a network (`_partial_`) takes it from checkpoints.

    `shared`: without a checkpoint, the shared ones that the system names are used. Raises WearcapError for a system
    with a network without a checkpoint, and for a checkpoint that the system cannot use.
    """
    given = [checkpoint] if isinstance(checkpoint, str | Path) else list(checkpoint or ())
    return load_systems(given, pipeline, device, shared)[0]


def load_systems(given: Sequence[str | Path], pipeline: DictConfig, device: str, shared: bool = False) -> list[System]:
    """The system of a pipeline config with all checkpoints, or one system for each of them; raises as `load_pipeline`."""
    made = instantiate(pipeline, _convert_="all")
    if isinstance(made, System):
        if given:
            raise WearcapError(
                f"a checkpoint, but {type(made).__name__} has no network",
                where=given[0],
                fix="Leave checkpoint=… out, or choose another pipeline=….",
            )
        return [made]
    kind: type[System] = made.func
    given = given or (list(kind.shared) if shared else [])
    if not given:
        raise WearcapError(
            f"no checkpoint, but {kind.__name__} needs a trained network",
            fix="Give checkpoint=…, or a pipeline without one, such as pipeline=hps.",
        )
    together = [given] if kind.joins_checkpoints else [[checkpoint] for checkpoint in given]
    return [kind.trained(made, checkpoints, device) for checkpoints in together]


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
