"""Saving and loading an HMD² session; files are untrusted and checked completely."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import Tensor

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.files import atomic_path, parse_json
from wearcap.recording.serialize import KNOWN, flatten, unflatten
from wearcap.sensors.packets import AGREEING
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.wearer import Wearer, WearerState

_KEY = "wearcap_stream"
_DAMAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError)
"""Exceptions that reading a damaged file may raise."""
_DOUBLE, _FLOAT, _BOOL = torch.float64, torch.float32, torch.bool
_ALWAYS = {
    "track.numbers": (_DOUBLE, "6"),
    "track.times": (_DOUBLE, "pose"),
    "track.R": (_FLOAT, "pose 3 3"),
    "track.t": (_FLOAT, "pose 3"),
    "places.points": (_FLOAT, "point 3"),
    "places.seen": (_DOUBLE, "point"),
    "places.known": (torch.int64, "2"),
    "places.center": (_FLOAT, "center"),
    "places.floor.heights": (_DOUBLE, "height"),
    "places.floor.path": (_DOUBLE, "step 3"),
    "places.floor.now": (_DOUBLE, "2"),
    "waiting.times": (_DOUBLE, "unsent"),
    "pictures.time": (_DOUBLE, "picture"),
    "pictures.embedding": (_FLOAT, "picture image_size"),
    "floors.known": (_DOUBLE, "floor 2"),
    "door.numbers": (_DOUBLE, "door"),
}
_SAMPLER = {
    "size": (_FLOAT, "limb"),
    "random": (torch.uint8, "random"),
    "noise": (_FLOAT, "1 frame steps motion_size"),
    "given": (torch.int64, ""),
    "R_parent_joint": (_FLOAT, "1 frame joints 3 3"),
    "foot_contact": (_FLOAT, "1 frame foot"),
    "R_world_head": (_FLOAT, "1 frame 3 3"),
    "t_world_head": (_FLOAT, "1 frame 3"),
    "floor_height": (_FLOAT, "1 frame"),
    "points": (_FLOAT, "1 frame points_size"),
    "points_valid": (_BOOL, "1 frame"),
    "image": (_FLOAT, "1 frame image_size"),
    "image_valid": (_BOOL, "1 frame"),
    "valid": (_BOOL, "1 frame"),
}
_WAITING = {
    "timestamp": (_DOUBLE, ""),
    "R": (_FLOAT, "3 3"),
    "t": (_FLOAT, "3"),
    "points": (_FLOAT, "any 3"),
    "embedding": (_FLOAT, "image_size"),
    "height": (_DOUBLE, ""),
}


class Saved(NamedTuple):
    """The contents of a session file."""

    wearers: list[WearerState]
    memory: Memory
    embedded: bool


def write(path: str | Path, pipeline: HMD2, wearers: Sequence[WearerState], embedded: bool) -> None:
    """Write everything that future poses depend on, except the pipeline."""
    tensors, about = {}, []
    for i, wearer in enumerate(wearers):
        tree, own = flatten(wearer.wearer, f"{i}.wearer")
        about.append({"wearer": tree, "seed": wearer.seed, "refused": dict(wearer.door.refused)})
        tensors |= own | {f"{i}.{name}": part for name, part in wearer.state().items()}
    memory = wearers[0].memory
    head = {
        "wearers": about,
        "pipeline": _settings(pipeline),
        "embedded": embedded,
        "radius_m": memory.radius_m,
        "max_points": memory.max_points,
    }
    with atomic_path(path) as temporary:
        tensors = {name: value.contiguous().clone() for name, value in tensors.items()}
        temporary.write_bytes(save(tensors, {_KEY: json.dumps(head)}))


def read(path: str | Path, pipeline: HMD2) -> Saved:
    """Read a session for the pipeline that it ran with.

    Raises WearcapError for a file that is no session or is damaged, and for a pipeline with other settings.
    """
    try:
        with safetensors.safe_open(str(path), framework="pt") as file:
            head = parse_json((file.metadata() or {})[_KEY], path)
        tensors = load_file(path)
        ours, theirs = _settings(pipeline), dict(head["pipeline"])
        wrong = [name for name, value in theirs.items() if ours.get(name) != value]
        if not wrong and theirs.keys() == ours.keys():
            memory = Memory(float(head["radius_m"]), int(head["max_points"]))
            wearers = [_restored(i, about, tensors, pipeline, memory) for i, about in enumerate(head["wearers"])]
            _require(len(wearers) > 0, "no wearers")
            return Saved(wearers, memory, bool(head["embedded"]))
    except (OSError, safetensors.SafetensorError, WearcapError, *_DAMAGE) as error:
        raise WearcapError(
            "not a saved session", where=path, expected="a whole .safetensors file of Session.save"
        ) from error
    name = wrong[0] if wrong else min(ours.keys() ^ theirs.keys())
    raise WearcapError(
        f"a session with {name} {theirs.get(name)}, not {ours.get(name)}",
        where=path,
        fix="Load it with the pipeline it ran with.",
    )


def _restored(number: int, about: Any, tensors: dict[str, Tensor], pipeline: HMD2, memory: Memory) -> WearerState:
    """Restore one wearer; raises one of `_DAMAGE` when something is missing or has another shape."""
    wearer = unflatten(about["wearer"], tensors.__getitem__, KNOWN | {"Wearer": Wearer})
    _require(isinstance(wearer, Wearer) and isinstance(wearer.skeleton, Skeleton), "no wearer")
    _require_shapes(
        {"R": wearer.R_head_device, "t": wearer.t_head_device, "joints": wearer.skeleton.t_parent_joint},
        {"R": (_FLOAT, "3 3"), "t": (_FLOAT, "3"), "joints": (_FLOAT, "joints 3")},
        {"joints": pipeline.features.joints},
    )
    _require(type(about["seed"]) is int, "no seed")
    counts = {str(reason): int(count) for reason, count in about["refused"].items()}
    own = {name.partition(".")[2]: part for name, part in tensors.items() if name.startswith(f"{number}.")}
    own = {name: part for name, part in own.items() if not name.startswith("wearer.")}
    _require_state(own, pipeline)
    restored = WearerState(pipeline, wearer, about["seed"], memory)
    restored.door.refused.update(counts)
    restored.restore(own)
    return restored


def _require_state(state: dict[str, Tensor], pipeline: HMD2) -> None:
    """Raise ValueError unless these are valid tensors of `WearerState.state`."""
    net = pipeline.net
    sizes = {
        "joints": pipeline.features.joints,
        "steps": pipeline.steps,
        "motion_size": net.motion_size,
        "points_size": net.points_size,
        "image_size": net.image_size,
    }
    expected = dict(_ALWAYS)
    if any(name.startswith("sampler.") for name in state):
        expected |= {f"sampler.{name}": kind for name, kind in _SAMPLER.items()}
    for k in range(AGREEING):
        expected |= {n: kind for name, kind in _WAITING.items() if (n := f"door.{k}.{name}") in state}
    _require(state.keys() == expected.keys(), "missing or foreign tensors")
    _require_shapes(state, expected, sizes)
    _require(0 <= state["places.known"][0] <= len(state["places.points"]), "more tracked points than there are")
    _require(len(state["places.center"]) in (0, 3), "no place")
    _require(len(state["door.numbers"]) in (4, 7), "no place")
    _require(state.get("sampler.noise", torch.zeros(1, 0)).shape[1] <= net.window, "a longer window")


def _require_shapes(
    tensors: dict[str, Tensor], kinds: dict[str, tuple[torch.dtype, str]], sizes: dict[str, int]
) -> None:
    """Raise ValueError unless tensors have these types and shapes; axes with the same name have equal lengths."""
    sizes = dict(sizes)
    for name, (dtype, axes) in kinds.items():
        shape, tensor = axes.split(), tensors[name]
        _require(tensor.dtype == dtype and tensor.ndim == len(shape), name)
        for axis, size in zip(shape, tensor.shape):
            wanted = int(axis) if axis.isdigit() else size if axis == "any" else sizes.setdefault(axis, size)
            _require(size == wanted, name)


def _require(fine: bool | Tensor, what: str) -> None:
    if not fine:
        raise ValueError(what)


def _settings(pipeline: HMD2) -> dict[str, float | str]:
    """The settings of a pipeline that the state depends on."""
    net = pipeline.net
    return {
        "window": net.window,
        "stride": pipeline.advance,
        "steps": pipeline.steps,
        "fps": pipeline.fps,
        "inpaint": pipeline.inpaint,
        "fade": pipeline.fade,
        "lookahead": pipeline.lookahead_frames,
        "eta": pipeline.eta,
        "spacing": pipeline.spacing,
        "motion_size": net.motion_size,
        "points_size": net.points_size,
        "image_size": net.image_size,
        "features": str(pipeline.features),
    }
