"""Contents of a training run's checkpoints beside the weights, and how their files are written and read."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.checkpoint_io import CheckpointIO
from lightning.pytorch import Callback
from torch import Tensor

import wearcap
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.models.build import check_weights
from wearcap.models.checkpoint import read_run_file


class ConfigInCheckpoint(Callback):
    """Adds the composed config and the version to every checkpoint."""

    def __init__(self, config: dict[str, Any]):
        self.config = config

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict[str, Any]) -> None:
        checkpoint["wearcap"] = {"version": wearcap.__version__, "config": json.dumps(self.config)}


class RunCheckpointIO(CheckpointIO):
    """Writes checkpoints atomically (synced beside the target, then renamed): a killed run leaves the old or new file.

    Lightning's own writer copies over the old file when the folder of temporary files is on another file system.
    """

    def __init__(self, folder: str | Path):
        """`folder`: of the run; checkpoints elsewhere, which a file to resume from may name, are never removed."""
        self.folder = Path(folder).resolve()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint. Raises WearcapError when the disk is full or the folder cannot be written."""
        content = io.BytesIO()  # PyTorch's own writing to a file does not report why it failed
        torch.save(checkpoint, content)
        with atomic_path(path) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint onto the CPU. Raises WearcapError as `read_run_file` does."""
        return read_run_file(path)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a checkpoint of this run."""
        path = Path(path).resolve()
        if self.folder in path.parents and path.suffix == ".ckpt":
            path.unlink(missing_ok=True)


TRAINING_STATE = ("state_dict", "optimizer_states", "lr_schedulers", "loops", "epoch", "global_step")
"""Entries of a checkpoint that resuming a training requires."""


def require_resumable(path: str | Path, own: Mapping[str, Tensor]) -> None:
    """Raise WearcapError unless a file is a training run's checkpoint whose weights fit a model's own.

    Its config is not read: the command line defines the training.
    """
    saved = read_run_file(path)
    missing = [key for key in TRAINING_STATE if key not in saved]
    if missing or not isinstance(saved["state_dict"], dict):
        raise WearcapError(
            f"a checkpoint without {missing[0] if missing else 'weights'}",
            where=path,
            expected="a run's .ckpt file, as `wearcap train` writes it",
        )
    check_weights(own, saved["state_dict"], path)
