"""Converts recordings to flat tensors plus JSON and back: the content of one `.safetensors` file.

A tree of known dataclasses becomes `{"head.R_world_device": tensor, …}` and a JSON skeleton in which every
tensor is a reference. Only the classes in `KNOWN` are restored; nothing in a file is ever executed.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from torch import Tensor

from wearcap.body.skeleton import Site, Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import recording as parts
from wearcap.recording.motion import Interactions, Motion

_PARTS = {name: cls for name, cls in vars(parts).items() if getattr(cls, "__module__", "") == parts.__name__}
KNOWN: dict[str, type] = _PARTS | {
    cls.__name__: cls for cls in (Motion, Skeleton, Site, Camera, Trajectory, Interactions)
}
"""Classes of recordings: those of `recording.py`, and what they consist of."""


def flatten(value: Any, key: str = "") -> tuple[Any, dict[str, Tensor]]:
    """Return (JSON tree, tensors by dotted key). Parts that are None or empty are omitted."""
    if isinstance(value, Tensor):
        return {"$tensor": key}, {key: value.detach().cpu()}
    if dataclasses.is_dataclass(value):
        items = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        tree: dict[str, Any] = {"$type": type(value).__name__}
    elif isinstance(value, dict):
        items, tree = value, {}
    elif isinstance(value, tuple):
        return {"$tuple": list(value)}, {}
    else:
        return value, {}
    tensors: dict[str, Tensor] = {}
    for name, item in items.items():
        if item is None or (isinstance(item, dict | str) and not item):
            continue
        tree[name], inner = flatten(item, f"{key}.{name}" if key else name)
        tensors |= inner
    return tree, tensors


def unflatten(tree: Any, fetch, known: dict[str, type] = KNOWN) -> Any:
    """Inverse of `flatten`; `fetch(key)` returns a tensor, and only classes in `known` are restored."""
    if not isinstance(tree, dict):
        return tree
    if "$tensor" in tree:
        return fetch(tree["$tensor"])
    if "$tuple" in tree:
        return tuple(tree["$tuple"])
    items = {name: unflatten(item, fetch, known) for name, item in tree.items() if name != "$type"}
    if "$type" not in tree:
        return items
    if tree["$type"] not in known:
        raise WearcapError(f"unknown part {tree['$type']!r}", expected=f"one of {', '.join(sorted(known))}")
    kind = known[tree["$type"]]
    first: dict[str, tuple[int, str]] = {}
    """Size of each axis by its name, and the field that it was found in."""
    for name, item in items.items():
        require_part(kind, name, item)
    for name, axes in _axes(kind).items():
        item = items.get(name)
        for axis, size in zip(axes, item.shape) if isinstance(item, Tensor) else ():
            expected, other = first.setdefault(axis, (size, name))
            if size != expected:
                what = f"{kind.__name__}.{name} has {size} rows for {expected} {other}"
                raise WearcapError(what, expected=f"one size of the axis {axis!r}")
    return kind(**items)


def require_part(kind: type, name: str, value: Any) -> None:
    """Raise WearcapError unless a value matches the annotation of a dataclass field (tensors: type and shape)."""
    hint = _hints(kind).get(name)
    # Embeddings alone are stored in 16 bits; poses of several formats do not compute with each other.
    narrow = isinstance(value, Tensor) and value.dtype.itemsize < 4 and value.is_floating_point()
    narrow = narrow and not name.startswith("embedding")
    if hint is not None and (narrow or not _fits(value, hint)):
        found = f"{value.dtype} of shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise WearcapError(f"{kind.__name__}.{name} is a {found}", expected=str(hint)[:120])


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value read from a file has an annotated type, including the items of containers."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in inner)
    if origin is tuple:
        items = inner[:1] * len(value) if isinstance(value, tuple) and inner[1:] == (...,) else inner
        return isinstance(value, tuple) and len(items) == len(value) and all(map(_fits, value, items))
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(_fits(item, inner[1]) for item in value.values())
    if hint in (int, float):
        return isinstance(value, int | hint) and not isinstance(value, bool)
    return isinstance(value, origin or hint)


@functools.cache
def _axes(kind: type) -> dict[str, list[str]]:
    """Names of the annotated axes of the fields that are tensors."""
    shapes = {
        name: [getattr(part, "dim_str", "") for part in (get_args(hint) or (hint,))]
        for name, hint in _hints(kind).items()
    }
    return {name: dims.split() for name, found in shapes.items() for dims in found if dims}


def dumps(tree: Any) -> str:
    """JSON with sorted keys and no spaces, so that equal content has equal bytes."""
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False)
