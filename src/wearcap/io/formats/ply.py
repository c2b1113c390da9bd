"""PLY files (ASCII, binary little and big endian): points with colours, and triangle meshes.

trimesh, which shows them, takes a file that was cut short for a whole one, and no binary file of several kinds of polygons.
"""

import io
import warnings
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from wearcap.boundary.limits import LIMITS
from wearcap.boundary.opening import read_bytes, understood
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.mesh import Mesh

_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_C_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_TYPES = {np.dtype(code).name: code for code in _CODES} | dict(zip(_C_NAMES, _CODES))
_BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
GREY = np.array([0.7, 0.7, 0.7], np.float32)
"""Colour of meshes without one."""
_HEADER = LIMITS["header"]
_MAX_EVEN_BYTES = 1 << 28
"""Largest row (bytes) that is read as one NumPy field, whose sizes are 32 bits."""


@dataclass(frozen=True)
class Ply:
    """Vertices (in the file's unit and axes) with their colours, and faces."""

    points: Float32[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"] | None = None
    faces: Int32[np.ndarray, "face 3"] | None = None
    """Triangles; polygons with more corners are split into fans."""

    @property
    def mesh(self) -> Mesh:
        """The surface, or points without faces; grey where the file has no colours."""
        color = GREY if self.colors is None else self.colors.astype(np.float32) / 255
        return Mesh(self.points, np.zeros((0, 3), np.int32) if self.faces is None else self.faces, color)

    @classmethod
    def of(cls, mesh: Mesh) -> "Ply":
        """The mesh with a colour per vertex: faces with their own colour get their own vertices."""
        vertices, faces, color = mesh.vertices, mesh.faces, mesh.color
        if color.ndim == 2 and len(color) != len(vertices):
            vertices, color = vertices[faces.ravel()], np.repeat(color, 3, axis=0)
            faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        colors = np.broadcast_to(np.clip(np.rint(color * 255), 0, 255).astype(np.uint8), vertices.shape)
        return cls(np.ascontiguousarray(vertices), np.ascontiguousarray(colors), faces if len(faces) else None)


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


def read_ply(path: str | Path, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> Ply:
    """Read a PLY file, `origin` taken off its vertices before they become float32.

    Raises WearcapError when it is no PLY, cut short, without x y z, or its numbers are NaN.
    """
    data = read_bytes(path)
    byte_order, elements, body = _parse_header(data, path)
    if byte_order == "=":
        text = io.TextIOWrapper(io.BytesIO(memoryview(data)[body:]), "ascii", errors="replace", newline="\n")
        lines = (line for line in text if line.strip())
        tables = {}
        for element in elements:
            if element.count == 0:
                tables[element.name] = {}
                continue
            with understood(f"a {element.name} row does not match the header", path):
                if any(p.count_dtype for p in element.properties):
                    table, rows = _ascii_lists(element, lines)
                else:
                    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
                        warnings.simplefilter("ignore", UserWarning)  # numpy warns about a file that ends here
                        values = np.loadtxt(islice(lines, element.count), ndmin=2, comments=None)
                        rows, kept = len(values), element.properties if len(values) else []
                        table = {p.name: values[:, i].astype(p.dtype) for i, p in enumerate(kept)}
            if rows < element.count:
                raise _cut_short(path, element)
            tables[element.name] = table
    else:
        tables = {}
        for element in elements:
            tables[element.name], body = _read_binary(element, data, body, byte_order, path)
    vertex = {name: column for name, column in tables.get("vertex", {}).items() if isinstance(column, np.ndarray)}
    if not {"x", "y", "z"} <= set(vertex):
        raise WearcapError("no vertices with x, y, z", path, "a PLY with `element vertex`")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite and is refused below
        points = np.stack([(vertex[axis] - off).astype(np.float32) for axis, off in zip("xyz", origin)], 1)
    if not np.isfinite(points).all():
        what = f"{int((~np.isfinite(points)).any(1).sum())} points are NaN or infinite"
        raise WearcapError(what, path, "finite coordinates")
    return Ply(points, _colors(vertex), _triangles(tables.get("face", {}), len(points), path))


def write_ply(ply: Ply, path: str | Path) -> None:
    """Write a binary little-endian PLY atomically."""
    columns = [(axis, "float", "<f4", values) for axis, values in zip("xyz", ply.points.T)]
    if ply.colors is not None:
        columns += [(name, "uchar", "u1", values) for name, values in zip(("red", "green", "blue"), ply.colors.T)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(ply.points)}"]
    lines += [f"property {kind} {name}" for name, kind, _, _ in columns]
    vertices = np.empty(len(ply.points), dtype=[(name, dtype) for name, _, dtype, _ in columns])
    for name, _, _, values in columns:
        vertices[name] = values
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
        raise WearcapError("not a PLY file", path, "a file that begins with `ply`")
    stop = data.find(b"end_header", 0, _HEADER.bytes)
    newline = data.find(b"\n", stop)
    if stop < 0 or newline < 0:
        raise WearcapError("its header has no end", path, "`end_header`", "The file was cut short: copy it again.")
    byte_order, elements = "", []
    with understood("its header cannot be understood", path, "a PLY 1.0 header"):
        for line in data[:stop].decode("ascii").splitlines()[1:]:
            words = line.split()
            if words[:1] == ["format"]:
                byte_order = _known(_BYTE_ORDER, words[1])
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                count_dtype = _known(_TYPES, words[2])
                if count_dtype[0] == "f":
                    raise ValueError(f"a list whose length is a {words[2]}")
                elements[-1].properties.append(_Property(words[4], _known(_TYPES, words[3]), count_dtype))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], _known(_TYPES, words[1])))
    names = [[element.name for element in elements], *([p.name for p in element.properties] for element in elements)]
    if any(len(set(group)) < len(group) or any(name.startswith("#") for name in group) for group in names):
        raise WearcapError("its header names a part twice", path, "a PLY 1.0 header")
    if not byte_order or any(not 0 <= element.count < 1 << 48 for element in elements):
        raise WearcapError("its header names no format, or an impossible or negative count", path, "a PLY 1.0 header")
    return byte_order, elements, newline + 1


def _known(table: dict[str, str], word: str) -> str:
    if word not in table:
        raise ValueError(f"unknown word {word!r}")
    return table[word]


def _cut_short(path: str | Path, element: _Element) -> WearcapError:
    what = f"it ends inside its {element.count} {element.name} rows"
    return WearcapError(what, path, "as many rows as the header states", "The file was cut short: copy it again.")


def _read_binary(element: _Element, data: bytes, start: int, order: str, path) -> tuple[dict, int]:
    """Columns of an element's rows: read at once if all lists are as long as the first row's, else row by row."""
    table, stop = _read_even_rows(element, data, start, order)
    if table is not None:
        return table, stop
    if not any(p.count_dtype for p in element.properties):
        raise _cut_short(path, element)
    columns = [(bytearray(), array("q")) for _ in element.properties]
    plan = [
        (*column, np.dtype(order + p.count_dtype) if p.count_dtype else None, np.dtype(p.dtype).itemsize)
        for p, column in zip(element.properties, columns)
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
    found = [np.frombuffer(values, order + p.dtype) for p, (values, _) in zip(element.properties, columns)]
    return _with_lists(element, found, [lengths for _, lengths in columns]), start


def _with_lists(element: _Element, columns: list[np.ndarray], lengths: "list[array[int]]") -> dict:
    """Columns by name, of which those of list properties are `_Lists`."""
    parts = zip(element.properties, columns, lengths)
    return {p.name: _Lists(values, np.array(each, np.int64)) if p.count_dtype else values for p, values, each in parts}


def _length(data: bytes, place: int, dtype: np.dtype) -> int:
    """Length of the list that begins here; -1 where the data ends."""
    if place + dtype.itemsize > len(data):
        return -1
    return int(np.frombuffer(data, dtype, 1, place)[0])


def _read_even_rows(element: _Element, data: bytes, start: int, order: str) -> tuple[dict | None, int]:
    """Rows as one NumPy array and where they end; None where lists differ in length or the data is too short."""
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
    if not dtype.itemsize:
        return {}, start
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


def _ascii_lists(element: _Element, lines: Iterator[str]) -> tuple[dict, int]:
    columns = [(array("d"), array("q")) for _ in element.properties]
    rows = 0
    for line in islice(lines, element.count):
        words, place = line.split(), 0
        for p, (values, lengths) in zip(element.properties, columns):
            length = 1
            if p.count_dtype:
                length, place = int(words[place]), place + 1
                lengths.append(length)
            if not 0 <= length <= len(words) - place:
                raise ValueError(f"{length} values announced, {len(words) - place} there")
            values.extend(map(float, words[place : place + length]))
            place += length
        rows += 1
    found = [np.array(values, np.float64) for values, _ in columns]
    return _with_lists(element, found, [lengths for _, lengths in columns]), rows


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
        raise WearcapError(f"a face names vertex {high if low >= 0 else low:g}, there are {vertices}", path)
    return faces.astype(np.int32)
