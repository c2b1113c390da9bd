"""Checks of `.pt2` archives before loading: PyTorch runs some strings as Python, so only known forms are allowed."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from wearcap.errors import WearcapError
from wearcap.files import parse_json

_SYMBOL = r"Symbol\('[su]\d{1,6}'(?:, \w{1,20}=(?:True|False))*\)"
_EXPRESSION = re.compile(
    rf"(?:{_SYMBOL}|Integer\(-?\d{{1,18}}\)|[su]\d{{1,6}}|-?\d{{1,18}}"
    r"|(?:Mul|Add|Pow|Min|Max|Mod|PythonMod|FloorDiv|CleanDiv|CeilDiv|ModularIndexing)\(|[(), ])+"
)
"""Allowed symbolic sizes, which SymPy evaluates."""
_SIZE = r"L\['\w{1,60}'\]\.size\(\)\[\d{1,2}\]"
_GUARD = re.compile(rf"{_SIZE} (?:==|!=|<=|>=|<|>) (?:{_SIZE}|\d{{1,18}})")
"""Allowed comparisons of input sizes, which PyTorch compiles into a function."""
_TARGET = re.compile(
    r"torch\.ops\.aten\.\w+\.\w+|_operator\.(?:add|sub|mul|floordiv|mod|neg|eq|ne|ge|gt|le|lt|getitem)"
)
"""Operations that a graph may call."""
_METADATA = ("stack_trace", "nn_module_stack", "torch_fn")
MAX_JSON_BYTES = 1 << 26
"""Largest allowed JSON description of a graph (64 MiB); exported ones have about 1 MiB."""


def check_archive(path: str | Path) -> None:
    """Raise WearcapError unless an archive has only tensors and a graph of tensor operations.

    Refused are pickled objects, compressed parts, guards and sizes other than arithmetic, and calls of functions that
    are not ATen operations. Raises zipfile.BadZipFile for a file that is no archive or is damaged.
    """
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        if len(set(names)) < len(names):
            raise _refused("two parts of one name", path)
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:
                raise _refused("compressed parts", path)
            if "/sample_inputs/" in entry.filename and entry.file_size > 0:
                raise _refused("pickled objects", path)
            if entry.filename.endswith(".json"):
                if entry.file_size > MAX_JSON_BYTES:
                    raise _refused(f"a description of {entry.file_size} bytes", path)
                content = parse_json(archive.read(entry), path)
                for key, value in _members(content):
                    if key == "use_pickle" and value:
                        raise _refused("pickled objects", path)
                    if key == "expr_str" and not (isinstance(value, str) and _EXPRESSION.fullmatch(value)):
                        raise _refused(f"the size {str(value)[:80]!r}", path)
                    if key == "guards_code" and not (
                        isinstance(value, list)
                        and all((isinstance(guard, str) and _GUARD.fullmatch(guard) is not None) for guard in value)
                    ):
                        raise _refused(f"the guards {str(value)[:80]!r}", path)
                    if key == "nodes" and not (
                        isinstance(value, list)
                        and all(
                            (
                                isinstance(node, dict)
                                and isinstance(node.get("target"), str)
                                and _TARGET.fullmatch(node["target"]) is not None
                                and set(node.get("metadata") or {}) <= set(_METADATA)
                            )
                            for node in value
                        )
                    ):
                        raise _refused("calls of other functions than tensor operations", path)
        if (damaged := archive.testzip()) is not None:
            raise zipfile.BadZipFile(f"{damaged} is damaged")


def _members(content: Any) -> Iterator[tuple[str, Any]]:
    """Every key and value of a JSON tree."""
    rest = [content]
    while rest:
        part = rest.pop()
        if isinstance(part, dict):
            yield from part.items()
            rest += part.values()
        elif isinstance(part, list):
            rest += part


def _refused(what: str, path: str | Path) -> WearcapError:
    return WearcapError(f"the archive holds {what}", where=path, expected="one that `wearcap export` wrote")
