"""`wearcap train`: compose a config, instantiate it, fit."""

import logging
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import lightning
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Callback, EarlyStopping
from lightning.pytorch.utilities import rank_zero_only
from lightning_utilities.core import rank_zero
from omegaconf import DictConfig, OmegaConf
from rich import print as show

from wearcap.cli import evaluate
from wearcap.cli.conf import compose, explained, hydra_application, run_application, trained_on, with_pipeline
from wearcap.data.surroundings import embeddings_of
from wearcap.errors import WearcapError
from wearcap.locks import folder_lock
from wearcap.recording.store import RecordingStore
from wearcap.training.run import (
    RunCheckpointIO,
    RunRecord,
    affordable_precision,
    fit,
    keep_freed_memory,
    last_checkpoint,
    record_run,
    require_accelerator,
    resume_path,
    run_to_continue,
)


def train(config: DictConfig) -> float:
    """Train the config's model; returns the last validation loss (which a sweep minimises).

    Raises WearcapError when another process trains in the run's folder, and for settings that exclude each other.
    """
    run = Path(config.paths.run)
    require_accelerator(str(config.trainer.accelerator))
    with folder_lock(run, "train") if rank_zero_only.rank == 0 else nullcontext():
        lightning.seed_everything(config.seed, workers=True, verbose=False)
        keep_freed_memory()
        _name_embeddings(config)
        # Each run has its own folder; users cannot fix Lightning's internal deprecations.
        warnings.filterwarnings("ignore", "Experiment logs directory")
        warnings.filterwarnings("ignore", ".*LeafSpec")
        rank_zero.log.addFilter(_no_advertisement)
        record = OmegaConf.to_yaml(config, resolve=True)
        resume = resume_path(config.resume, run, record)
        if resume and config.init and config.resume != "auto":
            raise WearcapError(f"resume={resume} and init={config.init}", expected="one of them")
        data, system = instantiate(config.data, _convert_="all"), instantiate(config.model, _convert_="all")
        if config.test and system.system is None:
            raise WearcapError(f"test=true, but no pipeline captures with {type(system).__name__}", fix="Leave it out.")
        loggers = [instantiate(logger, _convert_="all") for logger in (config.logger or {}).values() if logger]
        precision = affordable_precision(str(config.trainer.precision), str(config.trainer.accelerator))
        more = {"callbacks": _callbacks(config), "logger": loggers or False, "plugins": [RunCheckpointIO(run)]}
        trainer: lightning.Trainer = instantiate(config.trainer, precision=precision, **more)
        record_run(run, record)
        start = f", going on from {resume}" if resume else f", from the weights of {config.init}" if config.init else ""
        show(f"[bold]{config.name}[/bold] in {run}{start}")
        if precision != str(config.trainer.precision):
            show(
                f"trainer.precision={precision}, not {config.trainer.precision}: this CPU computes bfloat16 in software"
            )
        fit(system, data, trainer, resume, config.init)
        last = last_checkpoint(run)
        if trainer.is_global_zero:
            nothing_new = f"no step was left to make: {resume} has made {trainer.global_step}"
            show(f"checkpoint: {last}" if last.is_file() else nothing_new)
            if config.test:
                _test(config, run, str(trainer.strategy.root_device))
        return float(trainer.callback_metrics.get("val/loss", float("nan")))


def _no_advertisement(record: logging.LogRecord) -> bool:
    """Whether a message of Lightning is none of its tips to install other products."""
    return "💡 Tip:" not in record.getMessage()


def _name_embeddings(config: DictConfig) -> None:
    """Set name and dimension of the image embeddings to those in the data (`surroundings.windows.image.encoder=clip`)."""
    windows = config.get("surroundings", {}).get("windows", {}).get("image")
    if windows and windows.get("size") is None and "conditions" in config.data.dataset.get("content", {}):
        stores = [RecordingStore.open(source.root) for source in config.data.sources.values() if source]
        windows.encoder, config.surroundings.network.image.size = embeddings_of(windows.encoder, stores)


def _callbacks(config: DictConfig) -> list[Callback]:
    """The config's callbacks, after the one that records the run."""
    chosen = [callback for callback in config.callbacks.values() if callback and "_target_" in callback]
    composed: Any = OmegaConf.to_container(config, resolve=True)
    callbacks: list[Callback] = [RunRecord(composed)]
    callbacks += [instantiate(callback, _convert_="all") for callback in chosen]
    if config.early_stop:
        best = config.callbacks.checkpoint
        callbacks.append(
            EarlyStopping(best.monitor, mode=best.get("mode", "min"), patience=config.early_stop, strict=False)
        )
    return callbacks


def _test(config: DictConfig, run: Path, device: str) -> None:
    """Score the best checkpoint on the test split, as `wearcap evaluate` does, in test.json."""
    best = run / "checkpoints" / "best.ckpt"
    checkpoint = best if best.is_file() else last_checkpoint(run)
    places = {"checkpoint": checkpoint, "dataset": trained_on(checkpoint)[1], "output": run / "test.json"}
    given = [f"{key}='{path}'" for key, path in (places | {"paths.run": run}).items()]
    settings = compose("evaluate", with_pipeline([*given, f"device={device}"]))
    if config.pipeline.get("_target_") == settings.pipeline._target_:
        settings.pipeline = config.pipeline  # as its settings were chosen for the training's captures
    evaluate.run(settings)


def _in_own_folder(arguments: list[str]) -> list[str]:
    """Arguments that continue the folder of an earlier run with the same config for resume=auto, if there is one."""
    own = ("-", "hydra.run.dir=", "paths.run=")  # a sweep's runs and those with a folder of their own go on in theirs
    if "resume=auto" not in arguments or any(argument.startswith(own) for argument in arguments):
        return arguments
    config = compose("train", [*arguments, "paths.run=RUN"])
    _name_embeddings(config)
    runs = Path(config.paths.outputs) / "train" / config.name
    run = run_to_continue(runs, OmegaConf.to_yaml(config, resolve=True))
    return arguments if run is None else [*arguments, f"hydra.run.dir='{run}'"]


def main(arguments: list[str], application: Callable[[], Any] | None = None) -> None:
    with explained("train", arguments):
        arguments = _in_own_folder(arguments)
    run_application("train", application or hydra_application("train", train), arguments)
