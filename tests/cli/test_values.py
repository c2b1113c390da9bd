"""A value has one home: what a config sets and a default in Python agree, or Python requires the value."""

import ast
import inspect
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.utils import get_object

CONF = Path(__file__).parents[2] / "conf"
NEUTRAL = (None, False, 0, 1, "", (), True)
"""Defaults that leave something out, which a config may turn on."""


def nodes(tree: Any) -> list[dict]:
    """Every part of a config that names a class or function of this package."""
    if isinstance(tree, list):
        return [node for part in tree for node in nodes(part)]
    if not isinstance(tree, dict):
        return []
    own = [tree] if str(tree.get("_target_", "")).startswith("wearcap.") else []
    return own + [node for part in tree.values() for node in nodes(part)]


def comparable(value: Any) -> Any:
    return [comparable(part) for part in value] if isinstance(value, list | tuple) else value


def values() -> dict[str, dict[str, list]]:
    """Plain values that configs set, by target and argument; interpolations and nested targets are left out."""
    found: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for path in sorted(CONF.rglob("*.yaml")):
        for node in nodes(yaml.safe_load(path.read_text(encoding="utf-8"))):
            for name, value in node.items():
                text = str(value)
                if not name.startswith("_") and "${" not in text and "_target_" not in text:
                    found[node["_target_"]][name].append(comparable(value))
    return found


VALUES = values()


@pytest.mark.parametrize("target", sorted(VALUES))
def test_python_and_yaml_agree(target):
    parameters = inspect.signature(get_object(target)).parameters
    for name, given in VALUES[target].items():
        parameter = parameters.get(name)
        if parameter is None or parameter.default is inspect.Parameter.empty:
            continue
        default = comparable(parameter.default)
        neutral = any(default is value or (default == value and type(default) is not bool) for value in NEUTRAL)
        assert neutral or default == [] or default in given, f"{name}: {default!r} in Python, {given} in conf/"


def test_the_comparison_finds_a_difference():
    assert any(len(names) > 3 for names in VALUES.values())
    assert ast.literal_eval("0.35") in VALUES["wearcap.systems.hps.pipeline.Evidence"]["max_contact_speed"]
