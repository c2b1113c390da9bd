"""What a verb that reads lets the user state of a file's conventions, as settings of a config or options of a parser."""

import argparse
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from wearcap.io.conventions import CHOICES, UNITS_M, Conventions

NAMES = tuple(field.name for field in fields(Conventions))


def stated(values: Mapping[str, Any]) -> Conventions:
    """The conventions among a config's or a parser's values; those that are absent follow from the content."""
    return Conventions(**{name: values[name] for name in NAMES if name in values})


def add_conventions(parser: argparse.ArgumentParser) -> None:
    """Add an option for each convention."""
    group = parser.add_argument_group("what the file's content decides, unless it is stated")
    for name in NAMES:
        choices = CHOICES.get(name) or (tuple(UNITS_M) if name == "unit" else ())
        text = ", ".join(choices) or "of the pictures, for files with frame numbers"
        group.add_argument(f"--{name.replace('_', '-')}", default="auto", type=_value, help=text, metavar=name.upper())


def _value(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text
