"""Texts of strangers, plain, .gz or .xz: whole, line by line, JSON by a declared schema, YAML, XML. Errors name the line."""

import codecs
import io
import json
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, overload
from xml.etree.ElementTree import Element, ParseError

import msgspec
import numpy as np
import yaml
from defusedxml.common import DefusedXmlException

from wearcap.boundary.limits import LIMITS, Budget
from wearcap.boundary.opening import open_bytes, read_bytes, understood
from wearcap.errors import WearcapError

Content = TypeVar("Content")

# Bytes that are no UTF-8 are read as Latin-1.
codecs.register_error("wearcap.latin1", lambda e: (e.object[e.start : e.end].decode("latin-1"), e.end))  # pyright: ignore


def read_text(path: str | Path, kind: str = "text") -> str:
    """Text of a file (UTF-8, else Latin-1). Raises WearcapError as `read_bytes` does, and for binary content."""
    content = read_bytes(path, kind)
    if b"\0" in content:
        raise WearcapError("binary content", path, "a text file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def bounded_lines(file: io.TextIOBase, path: str | Path, kind: str = "lines") -> Iterator[tuple[int, str]]:
    """Lines with their numbers, counted from 1. Raises WearcapError for one that is longer than its kind's may be."""
    number, longest = 0, LIMITS[kind].line
    while line := file.readline(longest):
        number += 1
        if len(line) == longest and not line.endswith("\n"):
            raise WearcapError(f"a line longer than {longest} characters", at_line(path, number), "a text file")
        yield number, line


def numbered_lines(path: str | Path, kind: str = "lines") -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, counted from 1 (UTF-8; other bytes are taken as Latin-1).

    Raises WearcapError as `open_bytes` does, for an empty file, binary content and lines that are too long.
    """
    number = 0
    with open_bytes(path, kind) as source:
        file = io.TextIOWrapper(source, "utf-8-sig", errors="wearcap.latin1")
        for number, line in bounded_lines(file, path, kind):
            if "\0" in line:
                raise WearcapError("binary content", at_line(path, number), "a text file")
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


@overload
def parse_json(text: str | bytes, where: str | Path, kind: str = "json") -> Any: ...
@overload
def parse_json(text: str | bytes, where: str | Path, kind: str = "json", *, schema: type[Content]) -> Content: ...
def parse_json(text: str | bytes, where: str | Path, kind: str = "json", *, schema: Any = Any) -> Any:
    """Content of JSON text, laid out as a schema (a class of fields or a type as msgspec takes them) declares.

    Raises WearcapError for text that is no JSON, not UTF-8, beyond the limits of its kind, with whole numbers beyond 64
    bits, or not of the schema: the place in the text is named.
    """

    def whole_number(digits: str) -> int:
        value = int(digits)
        if not -(1 << 63) <= value < 1 << 64:
            raise ValueError(f"the whole number {digits[:30]}… has more than 64 bits")
        return value

    budget = Budget(where, kind)
    budget.spend(len(text))
    begins, halves = ("[{", ("\\ud", "\\uD")) if isinstance(text, str) else ((b"[", b"{"), (b"\\ud", b"\\uD"))
    budget.count(sum(map(text.count, begins)), "lists and objects")  # pyright: ignore[reportArgumentType]
    try:
        content = json.loads(text, parse_int=whole_number)
        if any(map(text.count, halves)):  # pyright: ignore[reportArgumentType]
            json.dumps(content, ensure_ascii=False).encode()  # halves of characters, which no text can be written with
        level, depth = [content], 0
        while level := [inner for outer in level for inner in _parts(outer) if isinstance(inner, dict | list)]:
            depth += 1
            if depth >= budget.limits.depth:
                raise RecursionError
        return require_layout(content, schema, where)
    except RecursionError as error:
        expected = f"at most {budget.limits.depth} levels"
        raise WearcapError("JSON that is nested too deeply", where, expected) from error
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise WearcapError(f"not readable JSON ({error})"[:300], where, "a whole JSON text") from error


def require_layout(content: Any, schema: type[Content], where: str | Path) -> Content:
    """Plain content as a schema declares it. Raises WearcapError naming the first place where it is something else."""
    try:
        return msgspec.convert(content, schema)
    except msgspec.ValidationError as error:
        raise WearcapError(f"content of another layout ({error})"[:300], where) from error


def _parts(content: Any) -> Iterable[Any]:
    return content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()


def read_json(path: str | Path) -> Any:
    """Content of a JSON file. Raises WearcapError as `read_text` and `parse_json` do."""
    return parse_json(read_text(path, "json"), path)


def read_json_object(path: str | Path) -> dict[str, Any]:
    """A JSON file's object. Raises WearcapError as `read_json` does, and for a file that holds something else."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise WearcapError(f"it holds a {type(content).__name__}", path, "a JSON object")
    return content


def read_yaml_object(path: str | Path) -> dict[str, Any]:
    """Keys and values of a small YAML file. Raises WearcapError for anything else, and for references in it."""
    damage = (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError)
    text, budget = read_text(path, "yaml"), Budget(path, "yaml")
    with understood("not readable YAML", path, errors=damage):
        # Aliases and deep nesting take quadratic time to parse.
        depth = 0
        for number, event in enumerate(yaml.parse(text, yaml.SafeLoader)):
            if isinstance(event, yaml.AliasEvent):
                fix = "Write them out: such references can blow up."
                raise WearcapError("it refers to its own parts (&name, *name)", path, "plain keys with values", fix)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > budget.limits.depth:
                raise WearcapError("YAML that is nested too deeply", path, f"at most {budget.limits.depth} levels")
            budget.count(number, "values")
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
