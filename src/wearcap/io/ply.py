"""PLY files (ASCII, binary little and big endian): points with colours, and triangle meshes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from wearcap.errors import WearcapError
from wearcap.files import atomic_path

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class Ply:
    """Vertices (in the file's unit and axes), and what comes with them."""

    points: Float32[np.ndarray, "point 3"]
    colors: UInt8[np.ndarray, "point 3"] | None = None
    faces: Int32[np.ndarray, "face 3"] | None = None
    """Triangles; polygons with more corners are cut into fans."""


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None
    """Set for a list: the type of its length."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


def read_ply(path: str | Path) -> Ply:
    """Read a PLY file. Raises WearcapError when it is no PLY, cut short, without x y z, or its numbers are NaN."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise WearcapError(f"cannot be read ({error.strerror or error})", where=path) from error
    byte_order, elements, body = _parse_header(data, path)
    if byte_order == "=":
        tables = _read_ascii(elements, data[body:], path)
    else:
        tables = _read_binary(elements, data, body, byte_order, path)
    vertex = tables.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise WearcapError("no vertices with x, y, z", where=path, expected="a PLY with `element vertex`")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is refused below
        points = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float32)
    if not np.isfinite(points).all():
        raise WearcapError(f"{int((~np.isfinite(points)).any(1).sum())} points are NaN or infinite", where=path,
                           expected="finite coordinates")  # fmt: skip
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
        raise WearcapError("its header has no end", where=path, expected="`end_header`",
                           fix="The file was cut short: copy it again.")  # fmt: skip
    byte_order, elements = "", []
    try:
        for line in data[:stop].decode("ascii").splitlines()[1:]:
            words = line.split()
            if words[:1] == ["format"]:
                byte_order = _BYTE_ORDER[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
    except (KeyError, IndexError, ValueError) as error:
        raise WearcapError(
            f"its header cannot be understood ({error})", where=path, expected="a PLY 1.0 header"
        ) from error
    if not byte_order or any(element.count < 0 for element in elements):
        raise WearcapError(
            "its header names no format, or a negative count", where=path, expected="a PLY 1.0 header"
        )
    return byte_order, elements, newline + 1


def _cut_short(path: str | Path, element: _Element) -> WearcapError:
    return WearcapError(f"it ends inside its {element.count} {element.name} rows", where=path,
                        expected="as many rows as the header says", fix="The file was cut short: copy it again.")  # fmt: skip


def _read_binary(elements: list[_Element], data: bytes, start: int, order: str, path) -> dict[str, dict]:
    tables = {}
    for element in elements:
        lists = [p for p in element.properties if p.count_dtype]
        read = _read_list_rows if lists else _read_fixed_rows
        tables[element.name], start = read(element, data, start, order, path)
    return tables


def _read_fixed_rows(element: _Element, data: bytes, start: int, order: str, path) -> tuple[dict, int]:
    dtype = np.dtype([(p.name, order + p.dtype) for p in element.properties])
    stop = start + element.count * dtype.itemsize
    if stop > len(data):
        raise _cut_short(path, element)
    rows = (
        np.frombuffer(data, dtype, element.count, start) if dtype.itemsize else np.empty(element.count, dtype)
    )
    return {p.name: rows[p.name] for p in element.properties}, stop


def _read_list_rows(element: _Element, data: bytes, start: int, order: str, path) -> tuple[dict, int]:
    """Rows with lists: at once where every list is as long as the first row's, row by row where not."""
    table, stop = _read_even_lists(element, data, start, order)
    if table is not None:
        return table, stop
    columns: dict[str, list] = {p.name: [] for p in element.properties}
    try:
        for _ in range(element.count):
            for p in element.properties:
                length = 1
                if p.count_dtype:
                    length = int(np.frombuffer(data, order + p.count_dtype, 1, start)[0])
                    start += np.dtype(p.count_dtype).itemsize
                columns[p.name].append(np.frombuffer(data, order + p.dtype, length, start))
                start += length * np.dtype(p.dtype).itemsize
    except ValueError as error:
        raise _cut_short(path, element) from error
    return columns, start


def _read_even_lists(element: _Element, data: bytes, start: int, order: str) -> tuple[dict | None, int]:
    fields, position = [], start
    for p in element.properties:
        if p.count_dtype:
            if position + np.dtype(p.count_dtype).itemsize > len(data) or not element.count:
                return None, start
            length = int(np.frombuffer(data, order + p.count_dtype, 1, position)[0])
            fields += [(f"#{p.name}", order + p.count_dtype), (p.name, order + p.dtype, (length,))]
        else:
            fields.append((p.name, order + p.dtype))
        position = start + np.dtype(fields).itemsize
    dtype = np.dtype(fields)
    stop = start + element.count * dtype.itemsize
    if stop > len(data):
        return None, start
    rows = np.frombuffer(data, dtype, element.count, start)
    even = all(
        (rows[f"#{p.name}"] == dtype[p.name].shape[0]).all() for p in element.properties if p.count_dtype
    )
    return ({p.name: rows[p.name] for p in element.properties}, stop) if even else (None, start)


def _read_ascii(elements: list[_Element], body: bytes, path) -> dict[str, dict]:
    lines = body.decode("ascii", errors="replace").split("\n")
    lines = [line for line in lines if line.strip()]
    tables, start = {}, 0
    for element in elements:
        rows = lines[start : start + element.count]
        start += element.count
        if len(rows) < element.count:
            raise _cut_short(path, element)
        try:
            tables[element.name] = _ascii_table(element, rows)
        except (ValueError, IndexError) as error:
            raise WearcapError(
                f"a {element.name} row is not as the header says ({error})", where=path
            ) from error
    return tables


def _ascii_table(element: _Element, rows: list[str]) -> dict:
    if not any(p.count_dtype for p in element.properties):
        values = np.array([row.split() for row in rows], dtype=np.float64).reshape(len(rows), -1)
        return {p.name: values[:, i].astype(p.dtype) for i, p in enumerate(element.properties)}
    columns: dict[str, list] = {p.name: [] for p in element.properties}
    for row in rows:
        words = row.split()
        for p in element.properties:
            length = int(words.pop(0)) if p.count_dtype else 1
            if length > len(words):
                raise ValueError(f"{length} values announced, {len(words)} there")
            columns[p.name].append(np.array(words[:length], dtype=np.float64))
            del words[:length]
    return columns


def _colors(vertex: dict) -> np.ndarray | None:
    for names in (
        ("red", "green", "blue"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
    ):
        if set(names) <= set(vertex):
            colors = np.stack([vertex[name] for name in names], 1)
            scale = 255 if colors.dtype.kind == "f" and colors.max(initial=0) <= 1 else 1
            return np.clip(colors * scale, 0, 255).astype(np.uint8)
    return None


def _triangles(face: dict, vertices: int, path) -> np.ndarray | None:
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if corners is None or not len(corners):
        return None
    if isinstance(corners, np.ndarray):
        fans = [
            np.stack([corners[:, 0], corners[:, i], corners[:, i + 1]], 1)
            for i in range(1, corners.shape[1] - 1)
        ]
    else:
        fans = [np.array([[polygon[0], polygon[i], polygon[i + 1]] for i in range(1, len(polygon) - 1)]).reshape(-1, 3)
                for polygon in corners]  # fmt: skip
    faces = np.concatenate([np.empty((0, 3)), *fans]).astype(np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= vertices):
        raise WearcapError(f"a face names vertex {faces.max()}, there are {vertices}", where=path)
    return faces.astype(np.int32)
