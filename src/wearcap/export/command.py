"""What the commands that run exported models have in common: three paths, and an error that ends them in one line."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from wearcap.errors import WearcapError


def parser(name: str, about: str | None, recording: str, output: str) -> argparse.ArgumentParser:
    """Takes an exported model, a recording (that has what is told) and where the output goes.

    `name` is the module's below `wearcap.export`, `about` the docstring of its `main`.
    """
    found = argparse.ArgumentParser(prog=f"python -m wearcap.export.{name}", description=about)
    found.add_argument("model", type=Path, help="exported .onnx or .pt2 file, what was written beside it")
    found.add_argument("recording", type=Path, help=f"recording (.safetensors) with {recording}")
    found.add_argument("output", type=Path, help=f"where to write {output}")
    return found


def run(main: Callable[[list[str]], None]) -> None:
    """Run a command on what was typed."""
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
