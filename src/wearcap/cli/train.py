"""`wearcap train`: compose a config, instantiate it, fit."""

import warnings
from contextlib import nullcontext
from pathlib import Path

import lightning
from hydra.utils import instantiate
from lightning.pytorch.callbacks import EarlyStopping
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich import print as show

from wearcap.cli.conf import hydra_main
from wearcap.data.surroundings import embeddings_of
from wearcap.locks import folder_lock
from wearcap.recording.store import RecordingStore
from wearcap.training.run import ConfigInCheckpoint, RunCheckpointIO, fit, keep_freed_memory, record_run, resume_path

HELP = "train a model: wearcap train experiment=motion_diffusion_head data=cmu"


def train(config: DictConfig) -> float:
    """Train the config's model; returns the last validation loss (which a sweep minimises).

    Raises WearcapError when another process trains in the run's folder.
    """
    run = Path(config.paths.run)
    with folder_lock(run, "train") if rank_zero_only.rank == 0 else nullcontext():
        lightning.seed_everything(config.seed, workers=True, verbose=False)
        keep_freed_memory()
        surroundings = config.get("surroundings")
        if surroundings and surroundings.images and "surroundings" in config.data.dataset.get("content", {}):
            # The name and the dimension of the image embeddings are those in the data (`surroundings.images=clip`).
            stores = [RecordingStore.open(source.root) for source in config.data.sources.values() if source]
            surroundings.images, surroundings.image_size = embeddings_of(surroundings.images, stores)
        # Each run has its own folder; users cannot fix Lightning's internal deprecations.
        warnings.filterwarnings("ignore", "Experiment logs directory")
        warnings.filterwarnings("ignore", ".*LeafSpec")
        record_run(run, OmegaConf.to_yaml(config, resolve=True))
        resume = resume_path(config.resume, run, Path(config.paths.outputs) / "train" / config.name)
        data, system = instantiate(config.data, _convert_="all"), instantiate(config.model, _convert_="all")
        chosen = [callback for callback in config.callbacks.values() if callback and "_target_" in callback]
        callbacks = [instantiate(callback, _convert_="all") for callback in chosen]
        callbacks.insert(0, ConfigInCheckpoint(OmegaConf.to_container(config, resolve=True)))
        if config.early_stop:
            best = config.callbacks.checkpoint
            callbacks.append(EarlyStopping(best.monitor, mode=best.get("mode", "min"), patience=config.early_stop))
        loggers = [instantiate(logger, _convert_="all") for logger in (config.logger or {}).values() if logger]
        trainer: lightning.Trainer = instantiate(
            config.trainer, callbacks=callbacks, logger=loggers or False, plugins=[RunCheckpointIO(run)]
        )
        show(f"[bold]{config.name}[/bold] in {run}" + (f", going on from {resume}" if resume else ""))
        fit(system, data, trainer, resume)
        last = run / "checkpoints" / "last.ckpt"
        if trainer.is_global_zero:
            nothing_new = f"no step was left to make: {resume} has made {trainer.global_step}"
            show(f"checkpoint: {last}" if last.is_file() else nothing_new)
        return float(trainer.callback_metrics.get("val/loss", float("nan")))


def main(arguments: list[str]) -> None:
    hydra_main("train", train, arguments)
