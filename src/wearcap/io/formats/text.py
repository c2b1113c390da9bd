"""Reading untrusted text files, plain, .gz or .xz and of bounded size: whole, line by line, JSON, XML.

Errors name the line.
"""

import codecs
import io
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import yaml
from defusedxml.common import DefusedXmlException

from wearcap.errors import WearcapError
from wearcap.files import MAX_JSON_DEPTH, parse_json
from wearcap.io.formats.bounded import open_bytes, read_bytes, understood

MAX_BYTES = 1 << 29
"""Largest text that is taken into memory as a whole (512 MiB: over an hour of 120 Hz motion)."""
MAX_JSON_BYTES = 1 << 28
"""Largest JSON file that is read (256 MiB): as Python objects it takes up to twenty times as much."""
MAX_YAML_BYTES = 1 << 16
"""Largest YAML file that is read: a page of settings."""
MAX_STREAMED_BYTES = 1 << 32
"""Largest text that is read line by line (4 GiB)."""
MAX_LINE = 1 << 24
"""Longest line (characters): COLMAP lists all points of a picture in one line."""


# Bytes that are no UTF-8 are read as Latin-1.
codecs.register_error("wearcap.latin1", lambda e: (e.object[e.start : e.end].decode("latin-1"), e.end))  # pyright: ignore


def read_text(path: str | Path, max_bytes: int | None = None, usual: int = MAX_BYTES) -> str:
    """Text of a file (UTF-8, else Latin-1). Raises WearcapError as `read_bytes` does, and for binary content."""
    content = read_bytes(path, max_bytes, usual)
    if b"\0" in content:
        raise WearcapError("binary content", path, "a text file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def numbered_lines(path: str | Path, usual: int = MAX_STREAMED_BYTES) -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, counted from 1 (UTF-8; other bytes are taken as Latin-1).

    Raises WearcapError as `open_bytes` does, for an empty file, binary content and lines longer than `MAX_LINE`.
    """
    number = 0
    with open_bytes(path, usual=usual) as source:
        file = io.TextIOWrapper(source, "utf-8-sig", errors="wearcap.latin1")
        while line := file.readline(MAX_LINE):
            number += 1
            if "\0" in line:
                raise WearcapError("binary content", at_line(path, number), "a text file")
            if len(line) == MAX_LINE and not line.endswith("\n"):
                raise WearcapError(f"a line longer than {MAX_LINE} characters", at_line(path, number), "a text file")
            yield number, line
    if not number:
        raise WearcapError("the file is empty", path)


def at_line(path: str | Path, line: int) -> str:
    """Position of an error: file and line, counted from 1."""
    return f"{path}, line {line}"


def finite_floats(tokens: Iterable[str], where: str | None = None) -> np.ndarray:
    """All tokens as float64. Raises ValueError (WearcapError, if `where` is given) naming the first that is no finite number."""
    tokens = tokens if isinstance(tokens, list) else list(tokens)
    try:
        values = list(map(float, tokens))
    except ValueError:
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        what = f"{next(filter(_no_finite_number, tokens))[:30]!r} is no finite number"
        raise WearcapError(what, where) if where else ValueError(what)
    return np.array(values, np.float64)


def _no_finite_number(token: str) -> bool:
    try:
        return not math.isfinite(float(token))
    except ValueError:
        return True


def read_json(path: str | Path, max_bytes: int | None = None) -> Any:
    """Content of a JSON file. Raises WearcapError as `read_text` does, and when it is no JSON or nested too deeply."""
    return parse_json(read_text(path, max_bytes, MAX_JSON_BYTES), path)


def read_json_object(path: str | Path) -> dict[str, Any]:
    """A JSON file's object. Raises WearcapError as `read_json` does, and for a file that holds something else."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", path, "a JSON object")
    return content


def read_yaml_object(path: str | Path) -> dict[str, Any]:
    """Keys and values of a small YAML file. Raises WearcapError for anything else, and for references in it."""
    damage = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)
    with understood("not readable YAML", path, errors=damage):
        text = read_text(path, usual=MAX_YAML_BYTES)
        # Aliases and deep nesting take quadratic time to parse.
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                fix = "Write them out: such references can blow up."
                raise WearcapError("it refers to its own parts (&name, *name)", path, "plain keys with values", fix)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_JSON_DEPTH:
                raise WearcapError("YAML that is nested too deeply", path, f"at most {MAX_JSON_DEPTH} levels")
        content = yaml.safe_load(text)
    if not isinstance(content, dict | None):
        raise WearcapError(f"it holds a {type(content).__name__}", path, "keys with values")
    return content or {}


@contextmanager
def plain_xml(path: str | Path, kind: str) -> Iterator[None]:
    """Turn the errors of parsing XML into WearcapError, also for document types and entities; `kind` names the file."""
    try:
        yield
    except DefusedXmlException as error:
        fix = "Such declarations can blow up or fetch other files, and are never read."
        raise WearcapError("it declares a document type or entities", path, f"a plain {kind}", fix) from error
    except ParseError as error:
        raise WearcapError(f"broken XML ({error.msg})", path, f"a whole {kind}", "Export or copy it again.") from error


def tag_of(element: Element) -> str:
    """An element's tag without its namespace; "" for comments."""
    return element.tag.rsplit("}", 1)[-1] if isinstance(element.tag, str) else ""
