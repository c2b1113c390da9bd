"""Checkpoints that carry the config they were trained with, read without executing anything from them."""

import json
import pickle
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from wearcap.errors import WearcapError
from wearcap.files import atomic_path


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(config, averaged weights) of a checkpoint. Raises WearcapError when it is missing, cut short or foreign."""
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise WearcapError("no such checkpoint", where=path) from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise WearcapError("not a readable checkpoint", where=path,
                           expected="a complete .ckpt file of `wearcap train`, with tensors and plain values only",
                           ) from error  # fmt: skip
    if not isinstance(checkpoint, dict) or "wearcap" not in checkpoint:
        raise WearcapError("a checkpoint, but not of wearcap", where=path,
                           expected="a .ckpt file that `wearcap train` wrote")  # fmt: skip
    return json.loads(checkpoint["wearcap"]["config"]), checkpoint["state_dict"]


def load_checkpoint(system: nn.Module, state: dict[str, Tensor], path: str | Path) -> None:
    """Load a checkpoint's weights into the model its config describes. Raises WearcapError when they do not fit."""
    own = system.state_dict()
    wrong = sorted(set(own) ^ set(state)) or [k for k in own if own[k].shape != state[k].shape]
    if wrong:
        raise WearcapError(f"{len(wrong)} weights do not fit this model, such as {wrong[0]!r}", where=path,
                           expected="a checkpoint of the same model", fix="Check which model it was trained for.")  # fmt: skip
    system.load_state_dict(state)


def share_checkpoint(source: str | Path, target: str | Path) -> None:
    """Write what of a run's checkpoint others need: averaged weights, the model's config, and nothing of the machine.

    Raises WearcapError for a source that `read_checkpoint` refuses.
    """
    config, state = read_checkpoint(source)
    kept = {name: config[name] for name in ("name", "model") if name in config}
    with atomic_path(target) as temporary:
        torch.save({"wearcap": {"config": json.dumps(kept)}, "state_dict": state}, temporary)
