"""Checkpoints that carry the config they were trained with, read without executing anything from them.

Two kinds of file: a run's `.ckpt`, and the `.safetensors` that is shared: averaged weights and statistics, the model's
config as JSON in the metadata. Those of `checkpoints/registry.json` go by name. The shared one carries a checksum that every reading verifies, and is for
others; a `.ckpt` is the user's own (`wearcap.boundary.own`).
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict, TypeVar

import torch
from torch import Tensor, nn

from wearcap.boundary.opening import file_size
from wearcap.boundary.own import require_own
from wearcap.boundary.tensors import plain_tensors, read_tensors, read_torch, write_tensors
from wearcap.boundary.texts import parse_json, require_layout
from wearcap.errors import WearcapError, nearest
from wearcap.fetch import Remote, fetch
from wearcap.files import resource
from wearcap.models.build import brought_up_to_date, build, check_config
from wearcap.version import __version__

Network = TypeVar("Network", bound=nn.Module)

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
"""Number formats of weights in a shared file."""

_NAME = re.compile(r"[\w-]+")
_SUFFIX = ".safetensors"
_KEY = "wearcap_checkpoint"
_DIGEST = "sha256"
"""Key, beside the model's config, of the checksum of config and weights."""


def shared_checkpoints() -> dict[str, Remote]:
    """The checkpoints of the project's registry, by name. All are in a checkout; the wheel carries one, and the others are
    fetched when they are first used."""
    registry = json.loads((_folder() / "registry.json").read_text(encoding="utf-8"))
    found = {}
    for name, entry in registry["checkpoints"].items():
        urls = tuple(url.format(version=__version__, name=name) for url in registry["urls"])
        found[name] = Remote(f"{name}{_SUFFIX}", urls, f"sha256:{entry['sha256']}", entry["bytes"])
    return found


def _folder() -> Path:
    return resource("checkpoints", "checkpoints")


class _Source(TypedDict, total=False):
    root: str


class _Data(TypedDict, total=False):
    sources: dict[str, _Source | None] | None
    val_sources: dict[str, _Source | None] | None


class Training(TypedDict, total=False):
    """What a training has taken (`wearcap.training.run.RunRecord`)."""

    frames: float
    seconds: float
    core_seconds: float


class _Config(TypedDict):
    """What is read of a checkpoint's config, beside the model itself."""

    model: dict[str, Any]
    name: NotRequired[str]
    data: NotRequired[_Data | None]
    training: NotRequired[Training | None]
    sha256: NotRequired[str]


def checkpoint_file(path: str | Path) -> Path:
    """The file of a path, or of the name of a shared checkpoint, which is fetched if it is not here. Raises WearcapError for an
    unknown name, and as `fetch` does."""
    path = Path(path)
    if os.path.exists(path) or not _NAME.fullmatch(str(path)):
        return path
    if os.path.isfile(here := _folder() / f"{path.name}{_SUFFIX}"):
        return here
    shared = shared_checkpoints()
    if path.name not in shared:
        expected = "a file, or the name of a checkpoint that comes with wearcap"
        raise WearcapError("no such checkpoint", path.name[:80], expected, nearest(path.name[:80], shared))
    return fetch(shared[path.name])


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(config, averaged weights) of a run's `.ckpt`, of a shared `.safetensors`, or of a name in `checkpoints/`.

    The config is plain data, its `model` what `wearcap.models.build` accepts. Weights stored in half the width come
    back as float32. Raises WearcapError when the file is missing, damaged or foreign, when its checksum does not fit,
    when its model is to be made of anything but wearcap's networks, and for somebody else's `.ckpt`.
    """
    path = checkpoint_file(path)
    if path.suffix == _SUFFIX:
        metadata, state = read_tensors(path, "checkpoint")
        text = metadata.get(_KEY)
    else:
        saved = read_run_file(path)
        about, state = saved.get("wearcap"), saved.get("state_dict")
        text = about.get("config") if isinstance(about, dict) else None
    if not isinstance(text, str):
        expected = "one that `wearcap train` or `wearcap export format=safetensors` wrote"
        raise WearcapError("a file, but not a checkpoint of wearcap", path, expected)
    config, state = parse_json(text, path, "config"), plain_tensors(state, path)
    require_layout(config, _Config, path)
    if (digest := config.pop(_DIGEST, None)) is not None and digest != _digest(config, state):
        raise WearcapError("its checksum differs from its content", where=path, fix="Fetch the file again.")
    brought_up_to_date(config["model"])
    check_config(config["model"], path)
    features = config["model"].get("features")
    if isinstance(features, dict) and features.get("spread") is True:
        state.setdefault("joint_dof", torch.zeros(()))  # files of before were fitted without tails
    halves = (torch.float16, torch.bfloat16)
    return config, {name: v.float() if v.dtype in halves else v for name, v in state.items()}


def read_run_file(path: str | Path) -> dict[str, Any]:
    """The contents of a run's `.ckpt`: tensors and plain values only.

    Raises WearcapError as `read_torch` does, for somebody else's, and for anything that is no dictionary.
    """
    expected = "a complete .ckpt file of `wearcap train`, with tensors and plain values only"
    file_size(path, "checkpoint")
    require_own(path)
    saved = read_torch(path, "checkpoint", expected)
    if not isinstance(saved, dict):
        raise WearcapError(f"a {type(saved).__name__}, but no checkpoint", path, expected)
    return saved


def _digest(config: Mapping[str, Any], state: Mapping[str, Tensor]) -> str:
    """Hex SHA-256 of a config and of named tensors, as a shared file stores them."""
    digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode())
    for name, value in sorted(state.items()):
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def load_network(path: str | Path, kind: type[Network], experiment: str, *, part: str = "net") -> Network:
    """A network of a checkpoint's model with its weights, in evaluation mode.

    `part`: its key in the model's config and prefix in the names of the weights. Raises WearcapError as
    `read_checkpoint` and `build` do, and when the part is not of class `kind`.
    """
    config, state = read_checkpoint(path)
    found: Any = config["model"]
    for key in part.split("."):
        found = found.get(key) if isinstance(found, dict) else None
    target = found.get("_target_") if isinstance(found, dict) else None
    if target != f"{kind.__module__}.{kind.__qualname__}":
        what = f"a checkpoint of {target or 'another model'}, not of {kind.__qualname__}"
        raise WearcapError(what, where=path, expected=f"one of `wearcap train experiment={experiment}`")
    network = build({key: value for key, value in found.items() if key != "_partial_"}, state, path, prefix=f"{part}.")
    assert isinstance(network, kind)
    return network


def share_checkpoint(
    source: str | Path, target: str | Path, dtype: str = "float32", changed: Mapping[str, Tensor] | None = None
) -> None:
    """Write a shareable file of a checkpoint: averaged weights, statistics, the model's config, names of the data, and
    what the training took.

    Weights of two or more axes are stored as `dtype` (of `DTYPES`); biases, norms and statistics stay as they are.
    Folders of this machine are left out; `changed` tensors replace the checkpoint's by their names. Raises WearcapError for a source that `read_checkpoint` refuses, a target
    that is no `.safetensors` file, and weights that are not finite in that type.
    """
    if Path(target).suffix != _SUFFIX:
        raise WearcapError("cannot share a checkpoint in this format", where=target, expected=f"NAME{_SUFFIX}")
    if dtype not in DTYPES:
        raise WearcapError(f"no dtype {dtype!r}", expected=f"one of {', '.join(DTYPES)}", fix=nearest(dtype, DTYPES))
    config, state = read_checkpoint(source)
    narrow = {
        name: value.to(DTYPES[dtype]) if value.dtype == torch.float32 and value.ndim > 1 else value
        for name, value in (state | dict(changed or {})).items()
    }
    for name, value in narrow.items():
        if value.is_floating_point() and not value.isfinite().all():
            what = f"weight {name!r} is not finite as {str(value.dtype).removeprefix('torch.')}"
            fix = "Choose dtype=float32, or another checkpoint."
            raise WearcapError(what, where=source, expected="a trained model", fix=fix)
    shared = {name: config[name] for name in ("name", "model", "training") if name in config}
    data = config.get("data") or {}
    for key in ("sources", "val_sources"):
        roots = {name: {"root": source["root"]} for name, source in (data.get(key) or {}).items() if source}
        if roots and not any(Path(source["root"]).is_absolute() for source in roots.values()):
            shared.setdefault("data", {})[key] = roots
    about = json.dumps(shared | {_DIGEST: _digest(shared, narrow)}, sort_keys=True)
    write_tensors(target, narrow, {_KEY: about})


def load_trained(checkpoint: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """The trained module of a checkpoint (averaged weights, evaluation mode) and the config it was trained with.

    Raises WearcapError for a checkpoint that `wearcap train` did not write.
    """
    config, state = read_checkpoint(checkpoint)
    module = build(config["model"], state, checkpoint)
    if not hasattr(module, "training_step"):
        what = f"a checkpoint of {type(module).__name__} alone"
        raise WearcapError(what, where=checkpoint, expected="one of `wearcap train`")
    return module, config
