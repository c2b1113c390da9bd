"""Shared parts of the commands that run exported models: the argument parser and one-line errors."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from wearcap.errors import WearcapError


def parser(name: str, about: str | None, recording: str, output: str) -> argparse.ArgumentParser:
    """Parser for the paths of an exported model, an input recording and the output.

    `name` is the module's name in `wearcap.export`, `about` the docstring of its `main`; `recording` and `output`
    describe the required inputs and the result in the help text.
    """
    found = argparse.ArgumentParser(prog=f"python -m wearcap.export.{name}", description=about)
    found.add_argument("model", type=Path, help="exported .onnx or .pt2 file, with the files written beside it")
    found.add_argument("recording", type=Path, help=f"recording (.safetensors) with {recording}")
    found.add_argument("output", type=Path, help=f"where to write {output}")
    return found


def run(main: Callable[[list[str]], None]) -> None:
    """Run a command with the process's arguments."""
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
