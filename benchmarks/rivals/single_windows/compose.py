"""The data of an experiment of today, drawn as before: the same config with other classes."""

import math
from dataclasses import fields
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from benchmarks.rivals.single_windows.datamodule import Loading, WindowsModule
from wearcap.cli.conf import compose
from wearcap.cli.train import _name_embeddings
from wearcap.training.base import Training

MOVED = {
    "wearcap.data.datamodule": "datamodule",
    "wearcap.data.windows": "windows",
    "wearcap.data.transforms": "transforms",
    "wearcap.data.bodies": "bodies",
    "wearcap.data.surroundings": "surroundings",
    "wearcap.data.motion_features.MovementContent": "movement_windows.MovementContent",
    "wearcap.systems.hmd2.training_windows": "head_windows",
    "wearcap.systems.mocap_every.training_windows": "watch_windows",
    "wearcap.systems.echo.training_windows": "echo_windows",
    "wearcap.systems.ireplica.training_windows": "contact_windows",
}
"""Where the classes of a config are in this package, by module or name."""

OTHERS = 0.875
"""Share of windows in which somebody else does the motion, where a config does not give it."""


def compose_old(experiment: str, overrides: list[str] | tuple[str, ...] = ()) -> tuple[WindowsModule, Training]:
    """Data and module of an experiment of `conf/`; the data is drawn window by window, the module is today's."""
    config = training_config(experiment, overrides)
    return data_before(config), instantiate(config.model, _convert_="all")


def training_config(experiment: str, overrides: list[str] | tuple[str, ...] = ()) -> DictConfig:
    """What `wearcap train` composes of an experiment."""
    config = compose("train", [f"experiment={experiment}", *overrides])
    _name_embeddings(config)
    return config


def data_before(config: DictConfig) -> WindowsModule:
    """The data of a training's config, drawn window by window."""
    return instantiate(_as_before(OmegaConf.to_container(config.data, resolve=True)), _convert_="all")


def _as_before(part: Any) -> Any:
    """A part of a config with the classes of this package, and their settings."""
    if isinstance(part, list):
        return [_as_before(each) for each in part]
    if not isinstance(part, dict):
        return part
    part = {name: _as_before(value) for name, value in part.items()}
    target = part.get("_target_", "")
    found = next((there for there in MOVED if target == there or target.startswith(f"{there}.")), None)
    if found is not None:
        part["_target_"] = f"{__package__}.{MOVED[found]}{target.removeprefix(found)}"
        part = _settings_before(part, target.rpartition(".")[2])
    return part


def _settings_before(part: dict[str, Any], name: str) -> dict[str, Any]:
    """A class's settings as they were before."""
    if name == "Loading":
        return {key: part[key] for key in ("_target_", *(field.name for field in fields(Loading))) if key in part}
    if name == "SensorErrors":  # of all axes alike
        alike = {key: value for key, value in part.items() if isinstance(value, list)}
        return part | {key: math.hypot(*value) / len(value) ** 0.5 for key, value in alike.items()}
    if name in ("HeadContent", "EchoContent"):  # hands that come and go were not drawn
        part.get("conditions", {}).pop("hands", None)
        return {key: value for key, value in part.items() if key != "view"}
    if name == "OtherBodies" and "count" not in part:
        share = part.pop("share", OTHERS)
        return part | {"count": round(share / (1 - share))}
    if name == "Windows" and part["content"]["_target_"].endswith("MovementContent"):
        every = part.get("every", 1)
        return part | {key: every * part[key] for key in ("window", "stride", "fps")} | {"every": 1}
    return part
