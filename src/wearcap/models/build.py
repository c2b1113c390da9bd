"""Builds networks from a checkpoint's config, which is plain, untrusted data.

Nothing in the config is resolved or imported: `_target_` is a key of a closed table of classes, `${` is refused, and the
model is first rehearsed on PyTorch's meta device, where tensors have shapes and no memory. Only a model whose weights
have the names and shapes of the file's tensors is then built.
"""

import importlib
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from wearcap.errors import WearcapError
from wearcap.models.weights import check_weights

_OPTIMIZERS = "ASGD Adadelta Adagrad Adam AdamW Adamax LBFGS NAdam RAdam RMSprop SGD"
_SCHEDULERS = (
    "ConstantLR CosineAnnealingLR CosineAnnealingWarmRestarts CyclicLR ExponentialLR LinearLR MultiStepLR OneCycleLR "
    "PolynomialLR StepLR"
)
TARGETS: dict[str, tuple[str, ...]] = {
    "wearcap.body.skeleton": ("xsens23",),
    "wearcap.systems.ireplica.features": ("HandViews", "SmplAngles"),
    "wearcap.systems.echo.features": ("EchoFeatures",),
    "wearcap.systems.hmd2.features": ("HeadFeatures",),
    "wearcap.data.motion_features": ("MotionFeatures",),
    "wearcap.systems.mocap_every.features": ("WatchFeatures",),
    "wearcap.diffusion.levels": ("LevelMix",),
    "wearcap.diffusion.schedule": ("CosineSchedule",),
    "wearcap.systems.ireplica.contact_sequence": ("ContactSequence",),
    "wearcap.systems.ireplica.contact_transformer": ("ContactTransformer",),
    "wearcap.systems.hmd2.model": ("MotionDenoiser",),
    "wearcap.systems.echo.model": ("EchoDenoiser",),
    "wearcap.models.image_encoder": ("EgoViewEncoder",),
    "wearcap.models.layers": ("TransformerSize",),
    "wearcap.models.motion_autoencoder": ("MotionAutoencoder",),
    "wearcap.systems.mocap_every.manifold": ("MotionManifold",),
    "wearcap.models.point_encoder": ("ObjectNetwork", "PointNeXt"),
    "wearcap.models.voxel_autoencoder": ("VoxelAutoencoder",),
    "wearcap.systems.mocap_every.model": ("MLPEstimator", "TwoStageEstimator"),
    "wearcap.systems.ireplica.training": ("ContactDetection",),
    "wearcap.systems.echo.training": ("EchoDiffusion",),
    "wearcap.systems.hmd2.egoview_training": ("EgoView",),
    "wearcap.training.base": ("Optimization",),
    "wearcap.training.motion_autoencoder": ("MotionEncoding",),
    "wearcap.systems.hmd2.training": ("Levels", "Loss", "MotionDiffusion"),
    "wearcap.systems.mocap_every.manifold_training": ("ManifoldTraining",),
    "wearcap.systems.echo.object_training": ("ObjectEncoding",),
    "wearcap.training.schedules": ("warmup_cosine",),
    "wearcap.systems.hmd2.voxel_autoencoder_training": ("VoxelReconstruction",),
    "wearcap.systems.mocap_every.training": ("WatchRegression",),
    "prodigyopt": ("Prodigy",),
    "torch.optim": tuple(_OPTIMIZERS.split()),
    "torch.optim.lr_scheduler": tuple(_SCHEDULERS.split()),
}
"""Classes (and functions that return plain objects) that a model's config may name, by their modules."""

MOVED = {
    "wearcap.systems.hmd2.point_codes_training.VoxelReconstruction": "wearcap.systems.hmd2.voxel_autoencoder_training.VoxelReconstruction"
}
"""Targets that files of before name, and where they are now."""
_DIFFUSION = "wearcap.systems.hmd2.training.MotionDiffusion"
RENAMED = {
    "wearcap.diffusion.levels.LevelMix": {"whole": "fully_observed"},
    _DIFFUSION: {"level_tilt": "tilt", "loss_weights": "weights"},
}
"""Settings that files of before have under another name, by target."""
STRUCK = {"object_in_wrists": False}
"""Settings that went, with the value at which files of before have them and do without."""

_NETWORKS = ("hmd2.model.MotionDenoiser", "echo.model.EchoDenoiser", "mocap_every.model.TwoStageEstimator")
_TRANSFORMER = {"transformer": ("wearcap.models.layers.TransformerSize", "width layers heads feedforward dropout")}
GROUPED: dict[str, dict[str, tuple[str, str]]] = {
    **{f"wearcap.systems.{name}": _TRANSFORMER for name in _NETWORKS},
    _DIFFUSION: {
        "levels": ("wearcap.systems.hmd2.training.Levels", "tilt pure"),
        "loss": ("wearcap.systems.hmd2.training.Loss", "weights tail contact_share"),
    },
}
"""Settings that files of before have side by side: by target and group, the group's class and their names."""
_OPTIMIZATION = {"optimization": ("wearcap.training.base.Optimization", "optimizer scheduler seed")}

_TARGET, _PARTIAL = "_target_", "_partial_"
MAX_VALUES, MAX_TEXT = 10_000, 1000
"""Largest number of values in a model's config, and longest string in it; our checkpoints have at most 150 values."""
MAX_SIZE = 1 << 20
"""Largest integer in a config: widths, windows, numbers of layers."""
_ANY_SIZE = ("seed", "optimizer", "scheduler")
"""Parts of a config whose numbers do not affect memory: seeds, numbers of steps."""
MAX_CALLS = 20_000
"""Largest number of tensor operations for building a model; our largest takes 400."""
ALLOWANCE = 1 << 26
"""Bytes (64 MiB) that building may take beyond what follows from the size of the file's weights."""
TIMES_WEIGHTS = 8
"""Limit of the memory that building writes, as a multiple of the weights' size; ours write 2.5 times it."""


def brought_up_to_date(config: Any) -> None:
    """Give, in place, a model's config today's names of targets and settings, and leave out settings that went and were off."""
    for part in _parts(config):
        if isinstance(target := part.get(_TARGET), str):
            target = part[_TARGET] = MOVED.get(target, target)
            for old, new in RENAMED.get(target, {}).items():
                if old in part:
                    part[new] = part.pop(old)
            if target == _DIFFUSION and "place_encoder" in part:
                part["conditions"] = _conditions(*(part.pop(old) for old in _CONDITIONS))
            trains = "optimizer" in part and not target.endswith(".Optimization")
            for group, (kind, names) in (GROUPED.get(target, {}) | (_OPTIMIZATION if trains else {})).items():
                if found := {old: part.pop(old) for old in names.split() if old in part}:
                    part[group] = {_TARGET: kind} | found
        for name in [name for name, off in STRUCK.items() if name in part and part[name] is off]:
            del part[name]


def _parts(config: Any) -> Iterator[dict[str, Any]]:
    """All dictionaries in a config."""
    rest = [config]
    while rest:
        value = rest.pop()
        if isinstance(value, dict):
            yield value
        rest += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()


_CONDITIONS = ("place_encoder", "image_encoder", "image_size", "drop")


def _conditions(places: Any, images: Any, size: Any, drop: Any) -> dict[str, Any]:
    """HMD²'s conditions beside the head from the settings that it had for points and images."""
    points = {"points": {"encoder": places, "drop": drop}} if places else {}
    return points | ({"image": {"encoder": images, "size": size, "drop": drop}} if images else {})


def check_config(config: Any, where: str | Path) -> None:
    """Raise WearcapError unless a model's config is plain data: no interpolation, known targets, sizes within limits."""
    count, rest = 0, [("model", config)]
    while rest:
        key, value = rest.pop()
        count += 1
        if count > MAX_VALUES:
            raise _refused(f"more than {MAX_VALUES} values", where)
        if isinstance(value, dict):
            for name in value:
                if "${" in name or (name.startswith("_") and name not in (_TARGET, _PARTIAL)):
                    raise _refused(f"the key {name[:80]!r}", where)
            if _PARTIAL in value and not (isinstance(value[_PARTIAL], bool) and _TARGET in value):
                raise _refused(f"{_PARTIAL}: {str(value[_PARTIAL])[:80]!r}", where)
            target = value.get(_TARGET)
            if _TARGET in value and not (isinstance(target, str) and _is_known(target)):
                what = f"the model is to be made of {str(target)[:80]!r}, which is no part of wearcap's models"
                expected = "networks, features and optimisers of wearcap and PyTorch alone"
                raise WearcapError(what, where=where, expected=expected)
            rest += [(key if key in _ANY_SIZE else inner, item) for inner, item in value.items()]
        elif isinstance(value, list):
            rest += [(key, item) for item in value]
        elif isinstance(value, str) and ("${" in value or len(value) > MAX_TEXT):
            raise _refused(f"{key}: {value[:80]!r}", where)
        elif isinstance(value, int) and abs(value) > (1 << 63 if key in _ANY_SIZE else MAX_SIZE):
            raise _refused(f"{key}: {str(value)[:80]}", where)
        elif isinstance(value, float) and not math.isfinite(value):
            raise _refused(f"{key}: {value}", where)


def _is_known(target: str) -> bool:
    module, _, name = target.rpartition(".")
    return name in TARGETS.get(module, ())


def _refused(what: str, where: str | Path) -> WearcapError:
    return WearcapError(
        f"the model's config has {what}",
        where=where,
        expected="plain values: numbers, text without ${…}, lists, and parts of wearcap's models",
    )


def build(config: dict[str, Any], state: Mapping[str, Tensor], where: str | Path, *, prefix: str = "") -> nn.Module:
    """The module that a config describes, with the weights of a file, in evaluation mode.

    `prefix`: only weights whose names start with it belong to the module ("net."). Raises WearcapError for a config that
    `check_config` refuses, that cannot be built or takes more memory than the file's weights explain, and for weights
    of other names or shapes.
    """
    check_config(config, where)
    own = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    needed = sum(value.numel() * value.element_size() for value in own.values())
    try:
        with torch.device("meta"), _Rehearsal(ALLOWANCE + TIMES_WEIGHTS * needed):
            rehearsed = _made(config)
        if not isinstance(rehearsed, nn.Module):
            raise TypeError(f"a {type(rehearsed).__name__}, no network")
        check_weights(rehearsed.state_dict(), own, "this model", where)
        module: nn.Module = _made(config)
    except Exception as error:  # constructors may raise anything for arguments that no release of ours wrote
        if isinstance(error, WearcapError) and error.where:
            raise
        what = f"its model cannot be built ({' '.join(str(error).split())[:200] or type(error).__name__})"
        raise WearcapError(what, where=where, expected="a checkpoint of this version of wearcap") from error
    module.load_state_dict(own)
    return module.eval()


def target_of(name: str) -> Callable[..., Any]:
    """The class or function of a `_target_` of `TARGETS`."""
    if not _is_known(name):
        raise KeyError(name)
    module, _, attribute = name.rpartition(".")
    with torch.device("cpu"):  # constants of a module that is imported in a rehearsal have values
        return getattr(importlib.import_module(module), attribute)


def _made(value: Any) -> Any:
    """Instantiates every part of a config that has a target, inner parts first."""
    if isinstance(value, list):
        return [_made(item) for item in value]
    if not isinstance(value, dict):
        return value
    arguments = {key: _made(item) for key, item in value.items() if key not in (_TARGET, _PARTIAL)}
    if _TARGET not in value:
        return arguments
    target = target_of(value[_TARGET])
    return partial(target, **arguments) if value.get(_PARTIAL, False) else target(**arguments)


class _Rehearsal(TorchDispatchMode):
    """Counts the bytes that tensor operations write, and stops beyond a number of bytes or of calls."""

    def __init__(self, max_bytes: int):
        super().__init__()
        self.bytes_left, self.calls_left = max_bytes, MAX_CALLS

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        self.calls_left -= 1
        for tensor in made if isinstance(made, tuple | list) else (made,):
            if isinstance(tensor, Tensor):
                self.bytes_left -= tensor.numel() * tensor.element_size()
        if self.bytes_left < 0 or self.calls_left < 0:
            raise WearcapError("a model that is much larger than its weights")
        return made
