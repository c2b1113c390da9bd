"""What a training run puts into its checkpoints beside weights."""

import json
from typing import Any

from lightning.pytorch import Callback

import wearcap


class ConfigInCheckpoint(Callback):
    """Puts the composed config and the version into every checkpoint."""

    def __init__(self, config: dict[str, Any]):
        self.config = config

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict[str, Any]) -> None:
        checkpoint["wearcap"] = {"version": wearcap.__version__, "config": json.dumps(self.config)}
