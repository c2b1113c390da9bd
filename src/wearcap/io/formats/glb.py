"""Surfaces in glTF 2.0 binary files (.glb): triangles with their places and colours; textures and animations are skipped.

What the file takes and holds follows from its own bytes: nothing beside it is read, and no extension is used. trimesh, which
shows the surfaces, makes an empty scene of many a damaged file.
"""

import struct
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from wearcap.boundary.limits import Budget
from wearcap.boundary.opening import read_bytes, understood
from wearcap.boundary.texts import parse_json
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.ply import GREY

_TRIANGLES = 4
_COMPONENTS = {5121: np.dtype("u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_SHAPES = {"SCALAR": (), "VEC3": (3,), "VEC4": (4,), "MAT4": (16,)}


class View(msgspec.Struct):
    byteLength: int
    buffer: int = 0
    byteOffset: int = 0
    byteStride: int | None = None


class Accessor(msgspec.Struct):
    componentType: int
    count: int
    type: str
    bufferView: int | None = None
    byteOffset: int = 0
    sparse: dict | None = None
    min: list[float] = []
    max: list[float] = []


class _Primitive(msgspec.Struct):
    attributes: dict[str, int]
    indices: int | None = None
    mode: int = _TRIANGLES


class _Surface(msgspec.Struct):
    primitives: list[_Primitive]


class Node(msgspec.Struct):
    mesh: int | None = None
    children: list[int] = []
    matrix: list[float] | None = None
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def transform(self) -> Float[np.ndarray, "4 4"]:
        """T_parent_node."""
        if self.matrix is not None:
            return np.array(self.matrix, np.float64).reshape(4, 4).T
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(self.rotation).as_matrix() * self.scale
        T[:3, 3] = self.translation
        return T


class Buffer(msgspec.Struct):
    uri: str | None = None


class _Gltf(msgspec.Struct):
    meshes: list[_Surface]
    nodes: list[Node]
    accessors: list[Accessor]
    bufferViews: list[View]
    buffers: list[Buffer]
    extensionsRequired: list[str] = []


def read_glb(path: str | Path) -> Mesh:
    """All triangles in the file's unit and axes (y up by glTF's rule), coloured per vertex where it has `COLOR_0`, else grey.

    Raises WearcapError for a file that is no .glb, is damaged, needs an extension, holds no triangles, or whose nodes
    repeat more than its bytes explain.
    """
    data = read_bytes(path, "mesh")
    with understood("not a readable glTF file", path, "a whole .glb file of triangles", errors=DAMAGE):
        text, binary = glb_chunks(data)
        tree = parse_json(text, path, "mesh", schema=_Gltf)
        if tree.extensionsRequired:
            raise ValueError(f"it needs {tree.extensionsRequired[0][:40]}")
        parts = _Parts(tree, binary, Budget(path, "mesh"))
        parts.budget.spend(len(data))
        children = {child for node in tree.nodes for child in node.children}
        for root in set(range(len(tree.nodes))) - children:
            parts.add(root, np.eye(4), 0)
        return parts.mesh()


DAMAGE = (struct.error, LookupError, ValueError, TypeError, OverflowError, RecursionError, MemoryError)


def glb_chunks(data: bytes) -> tuple[bytes, bytes]:
    """The JSON of a .glb file, and its binary chunk with what follows it. Raises ValueError for another file."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, length, kind) != (b"glTF", 2, len(data), b"JSON"):
        raise ValueError("no header of glTF 2.0 binary")
    return data[20 : 20 + size], data[28 + size :]


def accessor_values(tree: Any, binary: bytes, number: int, *kinds: str) -> np.ndarray:
    """An accessor's values, a view of the file's bytes; `tree` has `accessors`, `bufferViews` and `buffers`.

    Raises ValueError or LookupError for values of other kinds, that lie elsewhere, and that are compressed.
    """
    accessor = tree.accessors[number]
    if accessor.sparse or accessor.bufferView is None:
        raise ValueError("values that are sparse, or elsewhere than in the file's own buffer")
    view, dtype, shape = (
        tree.bufferViews[accessor.bufferView],
        _COMPONENTS[accessor.componentType],
        _SHAPES[accessor.type],
    )
    row = dtype.itemsize * (shape[0] if shape else 1)
    stride = view.byteStride or row
    if view.buffer or tree.buffers[0].uri is not None:
        raise ValueError("values that are sparse, or elsewhere than in the file's own buffer")
    offset = view.byteOffset + accessor.byteOffset
    stop = offset + (accessor.count - 1) * stride + row  # NumPy compares it with no buffer that is empty
    inside = accessor.byteOffset >= 0 and view.byteOffset >= 0 and stop <= len(binary)
    if accessor.type not in kinds or stride < row or accessor.count < 1 or not inside:
        raise ValueError(f"an accessor of {accessor.count} {accessor.type}")
    strides = (stride, dtype.itemsize)[: 1 + len(shape)]
    return np.ndarray((accessor.count, *shape), dtype, binary, offset, strides)


class _Parts:
    """The surfaces of a file's nodes."""

    def __init__(self, tree: _Gltf, binary: bytes, budget: Budget):
        self.tree, self.binary, self.budget = tree, binary, budget
        self.nodes = self.points = self.count = 0
        self.vertices: list[np.ndarray] = []
        self.faces: list[np.ndarray] = []
        self.colors: list[np.ndarray] = []

    def add(self, number: int, T_world_parent: Float[np.ndarray, "4 4"], depth: int) -> None:
        """Add a node and its children."""
        self.nodes += 1
        if depth > self.budget.limits.depth or self.nodes > len(self.tree.nodes):
            raise ValueError("nodes within nodes without end")
        node = self.tree.nodes[number]
        T_world_node = T_world_parent @ node.transform()
        for part in [] if node.mesh is None else self.tree.meshes[node.mesh].primitives:
            if part.mode == _TRIANGLES:
                self._add(part, T_world_node)
        for child in node.children:
            self.add(child, T_world_node, depth + 1)

    def _add(self, part: _Primitive, T_world_node: Float[np.ndarray, "4 4"]) -> None:
        vertices = self._array(part.attributes["POSITION"], "VEC3")
        corners = np.arange(len(vertices)) if part.indices is None else self._array(part.indices, "SCALAR")
        self.budget.count(self.count + len(vertices) + len(corners), "vertices and corners")
        vertices = vertices.astype(np.float64)
        if len(corners) % 3 or (len(corners) and corners.max() >= len(vertices)):
            raise ValueError("corners of vertices that are not there")
        color = part.attributes.get("COLOR_0")
        colors = np.broadcast_to(GREY, vertices.shape)
        if color is not None and len(found := self._array(color, "VEC3", "VEC4")) == len(vertices):
            whole = 1.0 if found.dtype.kind == "f" else np.iinfo(found.dtype).max
            colors = np.clip(found[:, :3] / whole, 0, 1)
        faces = corners.reshape(-1, 3).astype(np.int64) + self.points
        with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused below
            mirrored = np.linalg.det(T_world_node[:3, :3]) < 0
            self.vertices.append((vertices @ T_world_node[:3, :3].T + T_world_node[:3, 3]).astype(np.float32))
        self.faces.append(faces[:, ::-1] if mirrored else faces)
        self.colors.append(colors)
        self.points += len(vertices)
        self.count += len(vertices) + len(corners)

    def _array(self, number: int, *kinds: str) -> np.ndarray:
        return accessor_values(self.tree, self.binary, number, *kinds)

    def mesh(self) -> Mesh:
        if not self.faces:
            raise ValueError("no triangles")
        vertices, faces, colors = (np.concatenate(each) for each in (self.vertices, self.faces, self.colors))
        if not np.isfinite(vertices).all() or not np.isfinite(colors).all():
            raise ValueError("numbers that are not finite")
        return Mesh(vertices, faces.astype(np.int32), colors.astype(np.float32))
