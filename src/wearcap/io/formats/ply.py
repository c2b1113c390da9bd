"""PLY files (ASCII, binary little and big endian): points with colours, and triangle meshes."""

import io
import warnings
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.io.formats.bounded import read_bytes

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 16
_MAX_EVEN_BYTES = 1 << 28
"""Largest row (bytes) that is read as one NumPy field, whose sizes are 32 bits."""


@dataclass(frozen=True)
class Ply:
    """Vertices (in the file's unit and axes) with their colours, and faces."""

    points: Float32[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"] | None = None
    faces: Int32[np.ndarray, "face 3"] | None = None
    """Triangles; polygons with more corners are split into fans."""


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None
    """Type of a list's length; None for a scalar."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True)
class _Lists:
    """The lists of a property one after another."""

    values: np.ndarray
    lengths: np.ndarray


def read_ply(path: str | Path) -> Ply:
    """Read a PLY file. Raises WearcapError when it is no PLY, cut short, without x y z, or its numbers are NaN."""
    data = read_bytes(path)
    byte_order, elements, body = _parse_header(data, path)
    if byte_order == "=":
        tables = _read_ascii(elements, memoryview(data)[body:], path)
    else:
        tables = _read_binary(elements, data, body, byte_order, path)
    vertex = {name: column for name, column in tables.get("vertex", {}).items() if isinstance(column, np.ndarray)}
    if not {"x", "y", "z"} <= set(vertex):
        raise WearcapError("no vertices with x, y, z", where=path, expected="a PLY with `element vertex`")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is refused below
        points = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float32)
    if not np.isfinite(points).all():
        raise WearcapError(
            f"{int((~np.isfinite(points)).any(1).sum())} points are NaN or infinite",
            where=path,
            expected="finite coordinates",
        )
    return Ply(points, _colors(vertex), _triangles(tables.get("face", {}), len(points), path))


def write_ply(ply: Ply, path: str | Path) -> None:
    """Write a binary little-endian PLY atomically."""
    fields = [(axis, "<f4") for axis in "xyz"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(ply.points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    if ply.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    vertices = np.empty(len(ply.points), dtype=fields)
    for column, axis in enumerate("xyz"):
        vertices[axis] = ply.points[:, column]
        if ply.colors is not None:
            vertices[("red", "green", "blue")[column]] = ply.colors[:, column]
    faces = np.empty(0 if ply.faces is None else len(ply.faces), dtype=[("n", "u1"), ("corner", "<i4", 3)])
    if ply.faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        faces["n"], faces["corner"] = 3, ply.faces
    header = "\n".join([*lines, "end_header"]) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + vertices.tobytes() + faces.tobytes())


def _parse_header(data: bytes, path: str | Path) -> tuple[str, list[_Element], int]:
    """Byte order, elements, and where the body begins."""
    if not data.startswith(b"ply"):
        raise WearcapError("not a PLY file", where=path, expected="a file that begins with `ply`")
    stop = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    newline = data.find(b"\n", stop)
    if stop < 0 or newline < 0:
        raise WearcapError(
            "its header has no end", where=path, expected="`end_header`", fix="The file was cut short: copy it again."
        )
    byte_order, elements = "", []
    try:
        for line in data[:stop].decode("ascii").splitlines()[1:]:
            words = line.split()
            if words[:1] == ["format"]:
                byte_order = _BYTE_ORDER[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                if _TYPES[words[2]][0] == "f":
                    raise ValueError(f"a list whose length is a {words[2]}")
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
    except (KeyError, IndexError, ValueError) as error:
        raise WearcapError(
            f"its header cannot be understood ({error})"[:200], where=path, expected="a PLY 1.0 header"
        ) from error
    names = [[element.name for element in elements], *([p.name for p in element.properties] for element in elements)]
    if any(len(set(group)) < len(group) or any(name.startswith("#") for name in group) for group in names):
        raise WearcapError("its header names a part twice", where=path, expected="a PLY 1.0 header")
    if not byte_order or any(not 0 <= element.count < 1 << 48 for element in elements):
        raise WearcapError(
            "its header names no format, or an impossible or negative count", where=path, expected="a PLY 1.0 header"
        )
    return byte_order, elements, newline + 1


def _cut_short(path: str | Path, element: _Element) -> WearcapError:
    return WearcapError(
        f"it ends inside its {element.count} {element.name} rows",
        where=path,
        expected="as many rows as the header states",
        fix="The file was cut short: copy it again.",
    )


def _read_binary(elements: list[_Element], data: bytes, start: int, order: str, path) -> dict[str, dict]:
    tables = {}
    for element in elements:
        lists = [p for p in element.properties if p.count_dtype]
        read = _read_list_rows if lists else _read_fixed_rows
        tables[element.name], start = read(element, data, start, order, path)
    return tables


def _read_fixed_rows(element: _Element, data: bytes, start: int, order: str, path) -> tuple[dict, int]:
    dtype = np.dtype([(p.name, order + p.dtype) for p in element.properties])
    if not dtype.itemsize:
        return {}, start
    stop = start + element.count * dtype.itemsize
    if stop > len(data):
        raise _cut_short(path, element)
    rows = np.frombuffer(data, dtype, element.count, start)
    return {p.name: rows[p.name] for p in element.properties}, stop


def _read_list_rows(element: _Element, data: bytes, start: int, order: str, path) -> tuple[dict, int]:
    """Rows with lists: read at once if all lists are as long as the first row's, else row by row."""
    table, stop = _read_even_lists(element, data, start, order)
    if table is not None:
        return table, stop
    columns = {p.name: (bytearray(), array("q")) for p in element.properties}
    plan = [
        (*columns[p.name], np.dtype(order + p.count_dtype) if p.count_dtype else None, np.dtype(p.dtype).itemsize)
        for p in element.properties
    ]
    for _ in range(element.count):
        for values, lengths, count_dtype, width in plan:
            length = 1
            if count_dtype:
                length = _length(data, start, count_dtype)
                start += count_dtype.itemsize
                lengths.append(length)
            stop = start + length * width
            if length < 0 or stop > len(data):
                raise _cut_short(path, element)
            values += data[start:stop]
            start = stop
    table = {}
    for p in element.properties:
        values, lengths = columns[p.name]
        found = np.frombuffer(values, order + p.dtype)
        table[p.name] = _Lists(found, np.array(lengths, np.int64)) if p.count_dtype else found
    return table, start


def _length(data: bytes, place: int, dtype: np.dtype) -> int:
    """Length of the list that begins here; -1 where the data ends."""
    if place + dtype.itemsize > len(data):
        return -1
    return int(np.frombuffer(data, dtype, 1, place)[0])


def _read_even_lists(element: _Element, data: bytes, start: int, order: str) -> tuple[dict | None, int]:
    fields, position = [], start
    for p in element.properties:
        if p.count_dtype:
            count_dtype = np.dtype(order + p.count_dtype)
            length = _length(data, position, count_dtype)
            position += count_dtype.itemsize + length * np.dtype(p.dtype).itemsize
            if length < 0 or position > min(len(data), start + _MAX_EVEN_BYTES):
                return None, start
            fields += [(f"#{p.name}", count_dtype), (p.name, order + p.dtype, (length,))]
        else:
            position += np.dtype(p.dtype).itemsize
            fields.append((p.name, order + p.dtype))
    dtype = np.dtype(fields)
    stop = start + element.count * dtype.itemsize
    if stop > len(data):
        return None, start
    rows = np.frombuffer(data, dtype, element.count, start)
    table = {}
    for p in element.properties:
        table[p.name] = values = rows[p.name]
        if p.count_dtype:
            if (rows[f"#{p.name}"] != values.shape[1]).any():
                return None, start
            table[p.name] = _Lists(values.reshape(-1), np.full(len(rows), values.shape[1]))
    return table, stop


def _read_ascii(elements: list[_Element], body: memoryview, path) -> dict[str, dict]:
    text = io.TextIOWrapper(io.BytesIO(body), "ascii", errors="replace", newline="\n")
    lines = (line for line in text if line.strip())
    tables = {}
    for element in elements:
        if element.count == 0:
            tables[element.name] = {}
            continue
        listed = any(p.count_dtype for p in element.properties)
        try:
            table, rows = (_ascii_lists if listed else _ascii_table)(element, lines)
        except (ValueError, IndexError, OverflowError) as error:
            raise WearcapError(f"a {element.name} row does not match the header ({error})"[:200], where=path) from error
        if rows < element.count:
            raise _cut_short(path, element)
        tables[element.name] = table
    return tables


def _ascii_table(element: _Element, lines: Iterator[str]) -> tuple[dict, int]:
    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
        warnings.simplefilter("ignore", UserWarning)  # numpy warns about a file that ends here
        values = np.loadtxt(islice(lines, element.count), ndmin=2, comments=None)
        return {p.name: values[:, i].astype(p.dtype) for i, p in enumerate(element.properties) if len(values)}, len(
            values
        )


def _ascii_lists(element: _Element, lines: Iterator[str]) -> tuple[dict, int]:
    columns = {p.name: (array("d"), array("q")) for p in element.properties}
    rows = 0
    for line in islice(lines, element.count):
        words, place = line.split(), 0
        for p in element.properties:
            values, lengths = columns[p.name]
            length = 1
            if p.count_dtype:
                length, place = int(words[place]), place + 1
                lengths.append(length)
            if not 0 <= length <= len(words) - place:
                raise ValueError(f"{length} values announced, {len(words) - place} there")
            values.extend(map(float, words[place : place + length]))
            place += length
        rows += 1
    table = {}
    for p in element.properties:
        values, lengths = columns[p.name]
        found = np.array(values, np.float64)
        table[p.name] = _Lists(found, np.array(lengths, np.int64)) if p.count_dtype else found
    return table, rows


def _colors(vertex: dict) -> np.ndarray | None:
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if set(names) <= set(vertex):
            colors = np.stack([vertex[name] for name in names], 1)
            scale = 255 if colors.dtype.kind == "f" and colors.max(initial=0) <= 1 else 1
            with np.errstate(over="ignore"):
                return np.clip(np.nan_to_num(colors * scale), 0, 255).astype(np.uint8)
    return None


def _triangles(face: dict, vertices: int, path) -> np.ndarray | None:
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(corners, _Lists) or not len(corners.lengths):
        return None
    triangles = np.maximum(corners.lengths - 2, 0)
    first = np.repeat(np.cumsum(corners.lengths) - corners.lengths, triangles)
    k = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles) + 1
    faces = np.stack([corners.values[first], corners.values[first + k], corners.values[first + k + 1]], 1)
    if len(faces) and not (faces.min() >= 0 and faces.max() < vertices):
        low, high = faces.min(), faces.max()
        raise WearcapError(f"a face names vertex {high if low >= 0 else low:g}, there are {vertices}", where=path)
    return faces.astype(np.int32)
