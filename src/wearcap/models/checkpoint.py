"""Checkpoints that carry the config they were trained with, read without executing anything from them.

Two kinds of file: a run's `.ckpt`, and the `.safetensors` that is shared: averaged weights and statistics, the model's
config as JSON in the metadata. Those of `checkpoints/` go by name. Both carry checksums that every reading verifies.
"""

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from wearcap.boundary.texts import parse_json
from wearcap.errors import WearcapError, nearest
from wearcap.files import atomic_path, resource
from wearcap.models.build import build, check_config

Network = TypeVar("Network", bound=nn.Module)

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
"""Number formats of weights in a shared file."""

MAX_CONFIG_BYTES = 1 << 20
"""Longest config (1 MiB of JSON) that a checkpoint may carry; a training run's has 10 kB."""

_NAME = re.compile(r"[\w-]+")
_SUFFIX = ".safetensors"
_KEY = "wearcap_checkpoint"
_DIGEST = "sha256"
"""Key, beside the model's config, of the checksum of config and weights."""


def shared_checkpoints() -> dict[str, Path]:
    """Files of the checkpoints that come with the project, by name."""
    return {path.stem: path for path in sorted(resource("checkpoints", "checkpoints").glob(f"*{_SUFFIX}"))}


def checkpoint_file(path: str | Path) -> Path:
    """The file of a path, or of the name of a checkpoint in `checkpoints/`. Raises WearcapError for an unknown name."""
    path = Path(path)
    if path.exists() or not _NAME.fullmatch(str(path)):
        return path
    shared = shared_checkpoints()
    if path.name not in shared:
        expected = "a file, or the name of a checkpoint that comes with wearcap"
        raise WearcapError("no such checkpoint", where=path.name, expected=expected, fix=nearest(path.name, shared))
    return shared[path.name]


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(config, averaged weights) of a run's `.ckpt`, of a shared `.safetensors`, or of a name in `checkpoints/`.

    The config is plain data, its `model` what `wearcap.models.build` accepts. Weights stored in half the width come
    back as float32. Raises WearcapError when the file is missing, damaged or foreign, when its checksums do not fit,
    and when its model is to be made of anything but wearcap's networks.
    """
    path = checkpoint_file(path)
    if not path.is_file():
        raise WearcapError("no such checkpoint", where=path)
    text, state = _read_shared(path) if path.suffix == _SUFFIX else _read_run(path)
    if len(text) > MAX_CONFIG_BYTES:
        raise WearcapError(f"a config of {len(text)} bytes", where=path, expected=f"{MAX_CONFIG_BYTES} at most")
    config = parse_json(text, path)
    if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
        raise WearcapError("a checkpoint without its model's config", where=path, expected="JSON with a key 'model'")
    if (digest := config.pop(_DIGEST, None)) is not None and digest != _digest(config, state):
        raise WearcapError("its checksum differs from its content", where=path, fix="Fetch the file again.")
    check_config(config["model"], path)
    halves = (torch.float16, torch.bfloat16)
    return config, {name: v.float() if v.dtype in halves else v for name, v in state.items()}


def read_run_file(path: str | Path) -> dict[str, Any]:
    """The contents of a run's `.ckpt`: tensors and plain values only.

    Raises WearcapError for a file that is damaged (by the checksums of its parts), compressed or no checkpoint, and for
    a pickle that asks for anything but data.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise ValueError("compressed parts")
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"{damaged} is damaged")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(saved, dict):
            raise ValueError("no dictionary")
        return saved
    except PermissionError as error:
        raise WearcapError("no permission to read it", where=path) from error
    except Exception as error:  # zipfile and torch.load may raise anything for damaged bytes
        what = f"not a readable checkpoint ({' '.join(str(error).split())[:120] or type(error).__name__})"
        expected = "a complete .ckpt file of `wearcap train`, with tensors and plain values only"
        raise WearcapError(what, where=path, expected=expected) from error


def _read_run(path: Path) -> tuple[str, dict[str, Tensor]]:
    saved = read_run_file(path)
    about, state = saved.get("wearcap"), saved.get("state_dict")
    text = about.get("config") if isinstance(about, dict) else None
    # A weight's memory is in the file: no expansion of a few numbers to any size.
    plain = isinstance(state, dict) and all(
        isinstance(name, str)
        and isinstance(value, Tensor)
        and value.device.type == "cpu"
        and value.layout == torch.strided
        and not value.is_quantized
        and value.numel() * value.element_size() <= value.untyped_storage().nbytes()
        for name, value in state.items()
    )
    if not isinstance(text, str) or not isinstance(state, dict) or not plain:
        expected = "a .ckpt file that `wearcap train` wrote"
        raise WearcapError("a checkpoint, but not of wearcap", where=path, expected=expected)
    return text, dict[str, Tensor](state)


def _read_shared(path: Path) -> tuple[str, dict[str, Tensor]]:
    try:
        with safetensors.safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
        state = load_file(path)
    except PermissionError as error:
        raise WearcapError("no permission to read it", where=path) from error
    except (safetensors.SafetensorError, OSError, RuntimeError, ValueError, KeyError) as error:
        raise WearcapError("not a readable checkpoint", where=path, expected="a complete .safetensors file") from error
    if _KEY not in metadata:
        what = "a .safetensors file, but not a checkpoint of wearcap"
        raise WearcapError(what, where=path, expected="one that `wearcap export format=safetensors` wrote")
    return metadata[_KEY], state


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


def share_checkpoint(source: str | Path, target: str | Path, dtype: str = "float32") -> None:
    """Write a shareable file of a checkpoint: averaged weights, statistics, the model's config, names of the data, and
    what the training took.

    Weights of two or more axes are stored as `dtype` (of `DTYPES`); biases, norms and statistics stay as they are.
    Folders of this machine are left out. Raises WearcapError for a source that `read_checkpoint` refuses, a target
    that is no `.safetensors` file, and weights that are not finite in that type.
    """
    if Path(target).suffix != _SUFFIX:
        raise WearcapError("cannot share a checkpoint in this format", where=target, expected=f"NAME{_SUFFIX}")
    if dtype not in DTYPES:
        raise WearcapError(f"no dtype {dtype!r}", expected=f"one of {', '.join(DTYPES)}", fix=nearest(dtype, DTYPES))
    config, state = read_checkpoint(source)
    narrow = {
        name: value.to(DTYPES[dtype]) if value.dtype == torch.float32 and value.ndim > 1 else value
        for name, value in state.items()
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
    with atomic_path(target) as temporary:
        tensors = {name: value.contiguous().clone() for name, value in narrow.items()}
        temporary.write_bytes(save(tensors, {_KEY: about}))


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
