"""Checkpoints that carry the config they were trained with, read without executing anything from them.

Two kinds of file: a run's `.ckpt`, and the `.safetensors` that is shared: averaged weights and statistics, the model's
config as JSON in the metadata. Those of `checkpoints/` go by name.
"""

import ast
import json
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

import wearcap
from wearcap.errors import WearcapError, nearest
from wearcap.files import atomic_path, resource

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
"""How weights may be stored in a shared file."""

_PACKAGE = Path(wearcap.__file__).parent
_NAME = re.compile(r"[\w-]+")
_SUFFIX = ".safetensors"
_KEY = "wearcap_checkpoint"
_PARTS = re.compile(r"(wearcap\.(?:body|data|diffusion|models|scene|training)(?:\.[a-z]\w*)+)\.([A-Za-z]\w*)")
_OPTIMIZERS = re.compile(r"torch\.optim\.(lr_scheduler\.)?[A-Z][A-Za-z]+|prodigyopt\.Prodigy")
_FUNCTIONS = ("wearcap.body.skeleton", "wearcap.body.skeletons", "wearcap.training.schedules")
"""Modules whose functions, too, may be parts of a model; of all others, classes alone."""


def shared_checkpoints() -> dict[str, Path]:
    """Files of the checkpoints that come with the project, by name."""
    return {path.stem: path for path in sorted(resource("checkpoints", "checkpoints").glob(f"*{_SUFFIX}"))}


def checkpoint_file(path: str | Path) -> Path:
    """The file of a path, or of the name of a checkpoint in `checkpoints/`. Raises WearcapError for an unknown name."""
    path = Path(path)
    if path.exists() or not _NAME.fullmatch(str(path)):
        return path
    known = shared_checkpoints()
    if path.name not in known:
        raise WearcapError("no such checkpoint", where=path.name,
                           expected="a file, or the name of a checkpoint that comes with wearcap", fix=nearest(path.name, known))  # fmt: skip
    return known[path.name]


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(config, averaged weights) of a run's `.ckpt`, of a shared `.safetensors`, or of a name in `checkpoints/`.

    Weights stored in half the width come back as float32. Raises WearcapError when the file is missing, cut short or
    foreign, or when its model is to be made of anything but wearcap's networks.
    """
    path = checkpoint_file(path)
    if not path.is_file():
        raise WearcapError("no such checkpoint", where=path)
    config, state = _read_shared(path) if path.suffix == _SUFFIX else _read_run(path)
    for target in _targets(config.get("model")):
        if not _is_ours(target):
            raise WearcapError(f"the model is to be made of {target!r}, which is no part of wearcap's models", where=path,
                               expected="networks, features and optimisers of wearcap and PyTorch alone")  # fmt: skip
    return config, state


def _read_run(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise WearcapError("not a readable checkpoint", where=path,
                           expected="a complete .ckpt file of `wearcap train`, with tensors and plain values only",
                           ) from error  # fmt: skip
    try:
        saved = checkpoint if isinstance(checkpoint, dict) else {}
        return dict(json.loads(saved["wearcap"]["config"])), dict(saved["state_dict"])
    except (KeyError, TypeError, ValueError) as error:
        raise WearcapError("a checkpoint, but not of wearcap", where=path,
                           expected="a .ckpt file that `wearcap train` wrote") from error  # fmt: skip


def _read_shared(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safetensors.safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
        state = load_file(path)
    except (safetensors.SafetensorError, OSError, RuntimeError) as error:
        raise WearcapError(
            "not a readable checkpoint", where=path, expected="a complete .safetensors file"
        ) from error
    try:
        config = json.loads(metadata[_KEY])
    except KeyError as error:
        raise WearcapError("a .safetensors file, but not a checkpoint of wearcap", where=path,
                           expected="one that `wearcap export format=safetensors` wrote") from error  # fmt: skip
    except json.JSONDecodeError as error:
        raise WearcapError("the checkpoint's config cannot be read", where=path, expected="JSON in the metadata") from error  # fmt: skip
    if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
        raise WearcapError("a checkpoint without its model's config", where=path, expected="JSON with a key 'model'")  # fmt: skip
    halves = (torch.float16, torch.bfloat16)
    return config, {name: v.float() if v.dtype in halves else v for name, v in state.items()}


def _targets(config: Any) -> Iterator[str]:
    """What a config asks to be called, anywhere in it."""
    if isinstance(config, dict):
        if "_target_" in config:
            yield str(config["_target_"])
        for value in config.values():
            yield from _targets(value)
    elif isinstance(config, list):
        for value in config:
            yield from _targets(value)


def _is_ours(target: str) -> bool:
    """Whether a target is a class of the model's floors (or a function of `_FUNCTIONS`), defined where it says.

    Read from the source, not imported: a network is then loaded without what only its training needs.
    """
    if _OPTIMIZERS.fullmatch(target):
        return True
    named = _PARTS.fullmatch(target)
    if named is None:
        return False
    module, name = named.groups()
    source = _PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
    kinds = (ast.ClassDef, ast.FunctionDef) if module in _FUNCTIONS else ast.ClassDef
    body = ast.parse(source.read_text(encoding="utf-8")).body if source.is_file() else []
    return any(isinstance(part, kinds) and part.name == name for part in body)


def load_checkpoint(system: nn.Module, state: dict[str, Tensor], path: str | Path) -> None:
    """Load a checkpoint's weights into the model its config describes. Raises WearcapError when they do not fit."""
    own = system.state_dict()
    wrong = sorted(set(own) ^ set(state)) or [k for k in own if own[k].shape != state[k].shape]
    if wrong:
        raise WearcapError(f"{len(wrong)} weights do not fit this model, such as {wrong[0]!r}", where=path,
                           expected="a checkpoint of the same model", fix="Check which model it was trained for.")  # fmt: skip
    system.load_state_dict(state)


def share_checkpoint(source: str | Path, target: str | Path, dtype: str = "float32") -> None:
    """Write what of a checkpoint others need: averaged weights, statistics, the model's config, names of the data.

    Weights of two or more axes are stored as `dtype` (of `DTYPES`); biases, norms and statistics stay as they are.
    Folders of this machine are left out. Raises WearcapError for a source that `read_checkpoint` refuses, a target
    that is no `.safetensors` file, and weights that are not finite in that type.
    """
    if Path(target).suffix != _SUFFIX:
        raise WearcapError(
            "cannot share a checkpoint in this format", where=target, expected=f"NAME{_SUFFIX}"
        )
    if dtype not in DTYPES:
        raise WearcapError(
            f"no dtype {dtype!r}", expected=f"one of {', '.join(DTYPES)}", fix=nearest(dtype, DTYPES)
        )
    config, state = read_checkpoint(source)
    narrow = {
        name: value.to(DTYPES[dtype]) if value.dtype == torch.float32 and value.ndim > 1 else value
        for name, value in state.items()
    }
    for name, value in narrow.items():
        if value.is_floating_point() and not value.isfinite().all():
            raise WearcapError(f"weight {name!r} is not finite as {str(value.dtype).removeprefix('torch.')}", where=source,
                               expected="a trained model", fix="Choose dtype=float32, or another checkpoint.")  # fmt: skip
    with atomic_path(target) as temporary:
        tensors = {name: value.contiguous().clone() for name, value in narrow.items()}
        temporary.write_bytes(save(tensors, {_KEY: json.dumps(_shareable(config), sort_keys=True)}))


def _shareable(config: dict[str, Any]) -> dict[str, Any]:
    """Name and model of a config, and the data sets that are named relative to the working folder."""
    kept = {name: config[name] for name in ("name", "model") if name in config}
    data = config.get("data") or {}
    for key in ("sources", "val_sources"):
        roots = {name: {"root": source["root"]} for name, source in (data.get(key) or {}).items() if source}
        if roots and not any(Path(source["root"]).is_absolute() for source in roots.values()):
            kept.setdefault("data", {})[key] = roots
    return kept
