"""Untrusted JSON files."""

from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.files import parse_json
from wearcap.io.formats.text import read_text

MAX_BYTES = 1 << 28
"""Largest JSON file that is read (256 MiB): as Python objects it takes up to twenty times as much."""


def read_json(path: str | Path, max_bytes: int | None = None) -> Any:
    """Content of a JSON file. Raises WearcapError as `read_text` does, and when it is no JSON or nested too deeply."""
    return parse_json(read_text(path, max_bytes, MAX_BYTES), path)


def read_json_object(path: str | Path) -> dict[str, Any]:
    """A JSON file's object. Raises WearcapError as `read_json` does, and for a file that holds something else."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", where=path, expected="a JSON object")
    return content
