"""Configs of `wearcap prepare SOURCE`: what the signature of a source's function in `data_prep/` says."""

import dataclasses
import importlib
import inspect
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore

from wearcap.cli.verbs import GIVEN, sources


def register(overrides: Iterable[str], splits: Path) -> None:
    """Let Hydra find the config of the source that `prepare=SOURCE` names, where there is one.

    `splits` is the folder of the split lists.
    """
    for key, _, source in (override.partition("=") for override in overrides):
        if key == "prepare" and source in sources():
            ConfigStore.instance().store(source, config_of(source, splits), group="prepare", package="_global_")


def config_of(source: str, splits: Path) -> dict[str, Any]:
    """Settings of a source with their defaults at the top, and under `tasks` or `rework` the call that takes them.

    Settings named in the module's PRESETS have the values of the preset that is chosen. The split list is the
    source's own, or that of what its name begins with: those of simulated_hps are of simulated people.
    """
    file, entry, _, defaults = sources()[source]
    module = importlib.import_module(f"data_prep.{file.stem}")
    presets: dict[str, dict[str, Any]] = getattr(module, "PRESETS", {})
    lists = [path.stem for path in splits.glob("*.csv") if source.startswith(path.stem)]
    config: dict[str, Any] = {"name": source, **({"splits": f"{max(lists, key=len)}.csv"} if lists else {})}
    config |= {"presets": presets, "preset": "standard"} if presets else {}
    call = {"_target_": f"data_prep.{file.stem}.{entry.name}"}
    for setting, parameter in inspect.signature(getattr(module, entry.name)).parameters.items():
        default = defaults.get(setting, parameter.default)
        if setting != "splits":
            call[setting] = f"${{{setting}}}"
        if setting in next(iter(presets.values()), {}):
            config[setting] = f"${{presets.${{preset}}.{setting}}}"
        elif setting not in ("splits", *GIVEN):
            config[setting] = "???" if default is parameter.empty else _plain(default)
    kind = entry.name.removeprefix(f"{file.stem}_")
    if kind == "rework" and "output" not in call:
        config["output"] = "${dataset}"
    return config | {kind: call}


def _plain(value: Any) -> Any:
    """A default as a config holds it: of an object its class and fields."""
    if dataclasses.is_dataclass(value):
        kind = type(value)
        fields = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"_target_": f"{kind.__module__}.{kind.__qualname__}", **fields}
    return list(value) if isinstance(value, tuple) else value
