"""Wavefront .obj files: the triangles alone, without materials and textures."""

from array import array
from pathlib import Path

import numpy as np

from wearcap.boundary.texts import at_line, numbered_lines
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.ply import GREY

_LARGEST = float(np.finfo(np.float32).max)


def read_obj(path: str | Path) -> Mesh:
    """Vertices (in the file's unit and axes) and faces; polygons with more corners are cut into fans.

    Everything else in the file (normals, texture, groups, materials) is skipped. Raises WearcapError for a missing or
    binary file, lines that are no vertex or face, coordinates that are no finite numbers, faces of vertices that are
    not there, and a file without vertices.
    """
    vertices, faces = array("d"), array("q")
    for number, line in numbered_lines(path):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                values = [float(word) for word in words[1:4]]
                if len(values) < 3 or not all(abs(value) < _LARGEST for value in values):
                    raise ValueError(f"{' '.join(words[1:4])!r} are no three finite numbers")
                vertices.extend(values)
            elif words[:1] == ["f"]:
                # Corners count from 1, or backwards from the newest vertex; `a/texture/normal` names vertex a.
                known = len(vertices) // 3
                named = [int(word.split("/")[0]) for word in words[1:]]
                if len(named) < 3:
                    raise ValueError(f"{len(named)} corners")
                face = [index - 1 if index > 0 else known + index for index in named]
                if min(face) < 0 or 0 in named or max(named) > 1 << 30:
                    raise ValueError(f"corner {min(named)}")
                faces.extend([corner for k in range(1, len(face) - 1) for corner in (face[0], face[k], face[k + 1])])
        except ValueError as error:
            what = f"not a readable {'vertex' if words[0] == 'v' else 'face'} ({error})"[:300]
            fix = "The file was damaged: copy it again."
            raise WearcapError(what, at_line(path, number), "v x y z, or f a b c …", fix) from error
    if not vertices:
        raise WearcapError("no vertices", path, "a Wavefront .obj with lines `v x y z`")
    points = np.array(vertices, np.float32).reshape(-1, 3)
    corners = np.array(faces, np.int32).reshape(-1, 3)
    if len(corners) and corners.max() >= len(points):
        what = f"a face names vertex {corners.max() + 1}, there are {len(points)}"
        raise WearcapError(what, path, "faces of its own vertices", "The file was cut short: copy it again.")
    return Mesh(points, corners, GREY)
